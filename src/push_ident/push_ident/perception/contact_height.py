"""Whether the outline that a camera sees from above is what the tool meets, whose tip is above the table.

A tool that stands upright touches the widest part of an object between its tip and its upper end, and that is what the outline shows. Two
things it misses: parts lower than its tip, over which it passes, and parts above its upper end, below which the object may be narrower.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from push_ident.geometry.outline import polygon_area
from push_ident.geometry.se2 import transform_points
from push_ident.perception.shape import TracedObject
from push_ident.perception.shape_kernels import outline_distances
from push_ident.types import Float64Array

__all__ = ["contact_doubt"]

_STEP: Final = 0.002
"""Distance of the points of the edge that are looked at [m]: a cell of the heights."""
_INSIDE: Final = 0.003
"""So far inside the outline the height of an edge is looked up [m]: nearer to it, heights are those of a wall or of the table."""
_WALL: Final = 0.008
"""A point so near to the outline in the view from above is on the side below the edge [m]."""
_LOW: Final = 0.05
"""Fraction of the edge from which it is reported that the tool passes over it [-]: less may be noise of the heights."""
_SEEN: Final = 0.1
"""Least fraction of a high edge below which the side is seen [-]: a camera sees the sides that face it, at least a quarter of them."""


def contact_doubt(traced: TracedObject, points: Float64Array, tool_reach: tuple[float, float]) -> str:
    """Why contact may not be where the outline is, for people; empty where nothing speaks against it.

    Args:
        points: What was measured of the object [m], shape (n, 3), table frame.
        tool_reach: Heights of the tip and of the upper end of the tool above the table while it pushes [m].
    """
    low, high = tool_reach
    edge = _points_along(traced.shape.outline)
    height = _height_of_edge(traced, edge)
    if float(traced.top.max()) < low:
        return (
            f"it is {1e3 * float(traced.top.max()):.0f} mm high, and the tip of the tool {1e3 * low:.0f} mm above the table: "
            "pushes go over it; lower the tool"
        )
    share = float(np.mean(height < low))
    if share > _LOW:
        return (
            f"{share:.0%} of its edge is lower than the tip of the tool, {1e3 * low:.0f} mm above the table: there the tool touches it "
            "further inside than its outline; lower the tool"
        )
    above = edge[height > high]
    if len(above) == 0:
        return ""
    side = points[(points[:, 2] > low) & (points[:, 2] < high)]
    seen = _is_near(transform_points(traced.pose, above), side[:, :2])
    if float(np.mean(seen)) < _SEEN:
        return (
            f"its edge is up to {1e3 * float(height.max()):.0f} mm high, above the upper end of the tool at {1e3 * high:.0f} mm, and no "
            "side below it is seen: it may be narrower where the tool touches it"
        )
    return ""


def _points_along(outline: Float64Array) -> Float64Array:
    """Points along an outline [m], shape (n, 2)."""
    ends = np.roll(outline, -1, axis=0)
    counts = np.maximum(np.linalg.norm(ends - outline, axis=1) / _STEP, 1.0).astype(np.int64)
    return np.concatenate(
        [a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a) for a, b, n in zip(outline, ends, counts, strict=True)]
    )


def _height_of_edge(traced: TracedObject, edge: Float64Array) -> Float64Array:
    """Height of the upper side just inside each point of the edge [m], shape (n,)."""
    rows, columns = np.indices(traced.top.shape)
    places = traced.top_origin + traced.top_resolution * np.stack([columns.ravel(), rows.ravel()], axis=1)
    outline = np.ascontiguousarray(traced.shape.outline)
    # A thin object has no place that deep inside; half of its width, at the least the middle, will do.
    depth = min(_INSIDE, 0.25 * abs(polygon_area(outline)) / max(float(np.ptp(outline, axis=0).max()), 1e-6))
    inside = outline_distances(np.ascontiguousarray(places), outline) < -depth
    if not inside.any():
        return np.full(len(edge), float(traced.top.max()))
    places, heights = places[inside], traced.top.ravel()[inside]
    nearest = np.array([np.argmin(np.sum(np.square(places - point), axis=1)) for point in edge])
    return np.asarray(heights[nearest], dtype=np.float64)


def _is_near(places: Float64Array, points: Float64Array) -> Float64Array:
    """1 for each place (n, 2) with one of the points nearby, else 0, shape (n,)."""
    if len(points) == 0:
        return np.zeros(len(places))
    some = points[:: 1 + len(points) // 2000]
    return np.array([float(np.min(np.sum(np.square(some - place), axis=1)) < _WALL**2) for place in places])
