"""The first pushes of an object that nobody has pushed: those after which all other pushes would be predicted best.

Each push is the best of random candidates (`next_push`), where the pushes before it are expected to leave the object and under what they
are expected to leave unknown. Maps, pusher friction and the effects of the catalogue are unknown together, so that pushes are worth most
that tell them apart: a greedy A-optimal design (Chaloner & Verdinelli, Bayesian Experimental Design, 1995).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.geometry.se2 import inverse, transform_points, wrap_angle
from push_ident.identification.predicting.next_push import (
    N_CANDIDATES,
    PlannedPush,
    RankingOptions,
    candidate_pushes,
    rank_pushes,
    reference_pushes,
)
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.effects import CAUSES, EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.pushing.push import PUSH_ACCELERATION, PushPlan2D, PushSettings
from push_ident.types import Float64Array, ObjectShape

_N_REFERENCES: Final = 20
"""Random pushes that stand for all that may be predicted."""
_SLOWEST: Final = 0.04
"""Of the candidates [m/s], as in a diagnosis; the fastest are those that a goal may request. Some effects differ only in their dependence
on speed."""


@dataclass(frozen=True, slots=True)
class PushSequence:
    """Pushes to make one after the other, and what is expected of them."""

    shape: ObjectShape
    pushes: tuple[PlannedPush, ...]
    """Each from where the object is expected to lie before it, table frame."""
    ends: Float64Array
    """Where the object is expected to lie after each (x, y, yaw), shape (n_pushes, 3)."""
    errors: Float64Array
    """Expected cell error of other pushes before the first one and after each [m], shape (n_pushes + 1,)."""

    def in_object(self, number: int) -> PushPlan2D:
        """A push in the object frame, where it can be made wherever the object lies."""
        push = self.pushes[number]
        assert push.plan is not None, "candidates have a plan"
        plan, pose = push.plan, push.pose_object_in_table
        contact, tool = transform_points(inverse(pose), np.array([plan.contact_point, plan.tool_at_contact]))
        return replace(plan, contact_point=contact, tool_at_contact=tool, direction=float(wrap_angle(plan.direction - pose[2])))


def unknown_effects() -> tuple[str, ...]:
    """Effects that pushes are planned to tell apart: all that poses show, but those whose trace depends on the order of the pushes, or
    whose derivative where they are absent says nothing of their size."""
    return tuple(name for name in CAUSES if not (EFFECTS[name].follows_order or EFFECTS[name].is_abrupt))


def plan_pushes(
    shape: ObjectShape,
    n: int,
    settings: PushSettings | None = None,
    *,
    prior: Prior | None = None,
    first_pose: ArrayLike = (0.0, 0.0, 0.0),
    seed: int = 0,
    options: RankingOptions | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> PushSequence:
    """`n` pushes of an object of which the outline is known.

    Args:
        shape: its outline and cells.
        n: number of pushes, 1 or more.
        settings: radius of the pusher, workspace, distances and highest speed. By default nothing is in the way.
        prior: of the object.
        first_pose: where it lies (x, y, yaw), table frame.
        seed: of the candidates.
        options: sensor, and how candidates are ranked.
        on_progress: called with what is under way.

    Raises:
        InputError: n < 1, or no push moves the object.
        PlanningError: no push is safe where the object is expected to lie.
    """
    if n < 1:
        raise InputError(f"n is {n}, expected 1 push or more.")
    report = on_progress or (lambda text: None)
    settings = settings or PushSettings(workspace=(-np.inf, np.inf, -np.inf, np.inf))
    settings = replace(settings, speed_range=(min(_SLOWEST, settings.max_speed), settings.max_speed))
    posterior = ModelPosterior.of_prior(UnknownsSpec.of(shape, prior or Prior(), effects=unknown_effects()))
    mechanics, rng = posterior.mechanics, np.random.default_rng(seed)
    reference = reference_pushes(shape, rng, _N_REFERENCES, settings)
    options, pose = options or RankingOptions(), np.array(first_pose, dtype=np.float64)
    pushes: list[PlannedPush] = []
    errors: list[float] = []
    ends: list[Float64Array] = []
    for number in range(n):
        report(f"planning push {number + 1} of {n}")
        candidates = candidate_pushes(shape, pose, rng, N_CANDIDATES, settings, acceleration=PUSH_ACCELERATION)
        ranked = rank_pushes(posterior, candidates, reference=reference, rng=rng, options=options)
        if ranked.best is None:
            raise InputError(f"None of {len(candidates)} candidates for push {number + 1} is expected to move the object.")
        pushes.append(ranked.best)
        errors += [ranked.error_before, ranked.values[0].error_after][bool(errors) :]
        posterior = replace(posterior, covariance=ranked.values[0].covariance)
        path = ranked.best.pusher
        pose = mechanics.simulate(PushScenario(path, pose, path.time[-1:], number), settings=options.numerics).pose[-1]
        ends.append(pose)
    return PushSequence(shape, tuple(pushes), np.array(ends), np.array(errors))
