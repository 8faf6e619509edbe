"""Whether the arm can make a planned push, and nothing is in its way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import compose, transform_points
from push_ident.planning.hold import EdgeHold
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.sampling import check_push
from push_ident.types import Float64Array, ObjectShape

__all__ = ["Surroundings", "is_possible"]

_AGAIN: Final = 0.004
"""A push whose contact is within this distance [m] of one that failed from the same pose is not proposed again."""
_WAY: Final = 4
"""Poses along a push, the first included, at which the object is compared with obstacles."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a push must respect beside the workspace."""

    obstacles: Sequence[Float64Array] = ()
    """Outlines of other objects, table frame [m], each of shape (n_vertices, 2)."""
    failed: Sequence[PushPlan2D] = ()
    """Pushes from this pose that did not move the object, or could not be made."""
    hold: EdgeHold | None = None
    """An edge of the table near the object."""

    def has_failed(self, push: PushPlan2D) -> bool:
        """Whether a push with this contact failed before."""
        return any(bool(np.linalg.norm(push.contact_point - other.contact_point) < _AGAIN) for other in self.failed)


def is_possible(
    shape: ObjectShape, settings: PushSettings, plan: PushPlan2D, pose: Float64Array, motion: Float64Array, around: Surroundings
) -> bool:
    """Whether a push keeps tool and object within the workspace, touches nothing before, and did not fail before.

    `pose`: of the object before it, table frame; `motion`: what the push is expected to do, in the object's frame. Both of shape (3,).
    """
    if around.has_failed(plan):
        return False
    way = np.linspace(0.0, 1.0, _WAY)[1:, None] * motion
    outline, *later = (transform_points(p, shape.outline) for p in (pose, *compose(pose, way)))
    # The tool need not reach what overhangs the table.
    before, after = (p if around.hold is None else p[around.hold.edge.beyond(p) <= 0.0] for p in (outline, later[-1]))
    if settings.excess(after) > settings.excess(before):
        return False
    if any(_gap(own, other) < settings.lowering_gap for own in later for other in around.obstacles):
        return False
    try:
        check_push(plan, outline, settings, around.obstacles)
    except PlanningError:
        return False
    return True


def _gap(outline: Float64Array, other: Float64Array) -> float:
    """Least distance of a vertex of either outline from the other [m]; negative inside."""
    return float(min(np.min(signed_distance(outline, other)), np.min(signed_distance(other, outline))))
