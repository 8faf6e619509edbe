"""Random pushes beside an edge of the table, which keep the object on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.geometry.se2 import transform_points
from push_ident.physics.overhang import TableEdge
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.sampling import sample_push
from push_ident.types import Float64Array, ObjectShape

__all__ = ["push_on_table"]

_DRAWS: Final = 200
"""Random pushes that are tried."""
_CLEAR: Final = 0.01
"""Least distance of the outline from the edge after the push [m]: it slides on by up to 2.5 mm, and is seen to a few."""


def push_on_table(
    shape: ObjectShape,
    pose: Float64Array,
    seed: int,
    settings: PushSettings,
    edges: Sequence[TableEdge],
    obstacles: Sequence[Float64Array] = (),
) -> PushPlan2D:
    """A random push after which the object, moved along all of it, is on the table; where it is not now, nearer to that.

    The outline may turn out over the edge; the centre of mass may not: no push moves it further than the tool goes.

    Args:
        shape: of the object.
        pose: of it, shape (3,), table frame.
        seed: of the push.
        settings: limits of pushes.
        edges: of the table.
        obstacles: outlines of other objects, table frame [m], each of shape (n_vertices, 2).

    Raises:
        PlanningError: UNREACHABLE where no such push is found.
    """
    outline, rng = transform_points(pose, shape.outline), np.random.default_rng(seed)
    # Where it overhangs already, the push must lead back by as much as poses may be wrong.
    allowed = [max(-_CLEAR, float(np.max(edge.beyond(outline))) - _CLEAR) for edge in edges]
    for _ in range(_DRAWS):
        push = sample_push(shape, pose, rng, settings, obstacles)
        after = outline + push.distance * push.heading
        if all(float(np.max(edge.beyond(after))) <= most for edge, most in zip(edges, allowed, strict=True)):
            return push
    raise PlanningError(PushCode.UNREACHABLE, f"none of {_DRAWS} random pushes keeps the object on the table; move it away from the edge.")
