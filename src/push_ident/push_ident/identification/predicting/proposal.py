"""The push to make next of an object whose pose is not known yet: in its own frame, with free space around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError, PlanningError
from push_ident.identification.predicting.next_push import candidate_pushes, rank_pushes, reference_pushes
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.pages.tables import html_table
from push_ident.pushing.push import PushPlan2D, PushSettings

__all__ = ["N_CANDIDATES", "Proposal", "propose_push"]

N_CANDIDATES = 40
"""Random pushes of which the best is proposed: one of the best tenth is among them with a probability of 0.985."""
_N_REFERENCES = 20
"""Random pushes that stand for all that may be predicted."""
_FREE: tuple[float, float, float, float] = (-10.0, 10.0, -10.0, 10.0)
"""Workspace in which nothing is in the way [m]."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """The best of some random pushes."""

    plan: PushPlan2D
    """Object frame."""
    posterior: ModelPosterior
    """Of the object."""
    pusher_radius: float
    """[m]"""
    error_before: float
    """Expected cell error of other pushes now [m]."""
    error_after: float
    """The same after this push [m]."""

    def __repr__(self) -> str:
        return f"Proposal({self.sentence})"

    @property
    def sentence(self) -> str:
        """The push in words; lengths in mm, angles in degrees."""
        (x, y), plan = 1e3 * self.plan.contact_point, self.plan
        return (
            f"touch at ({x:.0f}, {y:.0f}) mm of the object frame, push {1e3 * plan.distance:.0f} mm at {plan.speed:.2f} m/s towards "
            f"{math.degrees(plan.direction):.0f}°; expected cell error {1e3 * self.error_after:.1f} mm after it, "
            f"{1e3 * self.error_before:.1f} mm now"
        )

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html_table(f"Next push: {self.sentence}", (), ())


def propose_push(posterior: ModelPosterior, pusher_radius: float) -> Proposal | None:
    """The push after which other pushes would be predicted best; None where no candidate would add information."""
    rng = np.random.default_rng(0)
    settings = PushSettings(pusher_radius=pusher_radius, workspace=_FREE)
    shape = posterior.unknowns.shape
    try:
        candidates = candidate_pushes(shape, np.zeros(3), rng, N_CANDIDATES, settings)
        ranked = rank_pushes(posterior, candidates, reference=reference_pushes(shape, rng, _N_REFERENCES, settings), rng=rng)
    except (PlanningError, InputError):
        return None
    best = ranked.best
    if best is None or best.plan is None:
        return None
    return Proposal(best.plan, posterior, pusher_radius, ranked.error_before, ranked.values[0].error_after)
