"""Feasibility of a planned push: workspace, obstacles, edge of the table, earlier failures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.errors import PlanningError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import compose, transform_points
from push_ident.planning.goal import EdgeHold
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.sampling import check_push
from push_ident.types import Float64Array, ObjectShape


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Constraints of a push other than the workspace."""

    obstacles: Sequence[Float64Array] = ()
    """Outlines of other objects, table frame [m], each of shape (n_vertices, 2)."""
    failed: Sequence[PushPlan2D] = ()
    """Pushes from this pose that did not move the object, or could not be made."""
    hold: EdgeHold | None = None
    """An edge of the table near the object."""
    same_contact: float = 0.004
    """A push whose contact is within this distance of one that failed from the same pose is not proposed again [m]."""
    n_poses: int = 4
    """Poses along a push, the first included, at which the object is compared with obstacles and edges."""

    def has_failed(self, push: PushPlan2D) -> bool:
        """Whether a push with this contact failed before."""
        return any(bool(np.linalg.norm(push.contact_point - other.contact_point) < self.same_contact) for other in self.failed)


def is_possible(
    shape: ObjectShape, settings: PushSettings, plan: PushPlan2D, pose: Float64Array, motion: Float64Array, around: Surroundings
) -> bool:
    """Whether a push keeps tool and object within the workspace, touches nothing before, and did not fail before.

    `pose`: of the object before it, table frame; `motion`: what the push is expected to do, in the object's frame. Both of shape (3,).
    """
    if around.has_failed(plan):
        return False
    motions = np.linspace(0.0, 1.0, around.n_poses)[1:, None] * motion
    outline, *later = (transform_points(p, shape.outline) for p in (pose, *compose(pose, motions)))
    # The tool need not reach the part that overhangs the table.
    before, after = (p if around.hold is None else p[around.hold.edge.beyond(p) <= 0.0] for p in (outline, later[-1]))
    if settings.excess(after) > settings.excess(before):
        return False
    if any(_gap(one, other) < settings.lowering_gap for one in later for other in around.obstacles):
        return False
    try:
        check_push(plan, outline, settings, around.obstacles)
    except PlanningError:
        return False
    return True


def _gap(outline: Float64Array, other: Float64Array) -> float:
    """Least distance of a vertex of either outline from the other [m]; negative inside."""
    return float(min(np.min(signed_distance(outline, other)), np.min(signed_distance(other, outline))))
