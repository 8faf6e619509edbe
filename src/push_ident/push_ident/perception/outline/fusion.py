"""Refinement of a traced outline: every edge is moved to fit the lines of sight of one or several views.

Tracing (`shape`) finds form and corners from one view; its edges have errors of a few tenths of a millimetre that differ between the near
and the far side. Here each edge gets one unknown, its offset along its normal, estimated from the same comparison of stopped and passing
lines of sight as the poses. Views of the object in other poses, or by a second camera, add their lines of sight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.errors import InputError, PerceptionError
from push_ident.geometry.outline import cells_in_outline, edge_normals, polygon_centroid
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.perception.frame.view import FrameView
from push_ident.perception.known_object import Template, TracedObject, TrackStatus
from push_ident.perception.outline.edges import (
    EdgeLines,
    displaced_std,
    edge_std,
    lines_near_edges,
    prior_curvature,
    same_curve,
    without_teeth,
)
from push_ident.perception.outline.straighten import straighten
from push_ident.perception.tracking.pose_fit import fit_pose
from push_ident.types import Float64Array, ObjectShape

__all__ = ["PosedView", "dense", "fuse_views", "relative_size", "with_edges_moved", "without_reversed"]

_LARGEST: Final = 0.003
"""Largest offset of an edge over all passes [m]."""
_LEAST_SINE2: Final = 0.12
"""Two edges whose angle has a smaller squared sine meet too far away: their corner moves by the mean offset."""
_PASSES: Final = 3
"""Iterations of pose fit and edge fit."""


PosedView = tuple[FrameView, Float64Array]
"""A view of an object at rest, preferably of the `median_frame` of several frames, and its pose (x, y, yaw) there [m, m, rad], table
frame."""


def fuse_views(traced: TracedObject, views: Sequence[PosedView], *, pose_known: bool = False) -> TracedObject:
    """Outline and cells that fit all views best.

    The object frame and `traced.pose` follow the centroid of the outline where that moves.

    Args:
        traced: The object from one view.
        views: All views, that one included; with poses to about a centimetre and ten degrees.
        pose_known: Whether the first view is the one in which the object was traced, so that its pose is not fitted.

    Raises:
        InputError: There are no views.
        PerceptionError: The object is found in none of them.
    """
    if not views:
        raise InputError("There are no views to fuse, expected at least the one in which the object was traced.")
    moved = np.zeros(len(traced.shape.outline))
    outline = np.array(traced.shape.outline)
    for _ in range(_PASSES):
        template = Template(replace(traced, shape=ObjectShape(traced.shape.cells, outline)))
        fitted = _fitted(template, views, pose_known)
        gradient, curvature = _derivatives(template, outline, fitted)
        shared = same_curve(outline)
        step = np.clip(moved + (shared @ gradient) / (shared @ curvature), -_LARGEST, _LARGEST) - moved
        outline, moved = without_reversed(outline, with_edges_moved(outline, step), moved + step)
    straight = straighten(dense(outline))
    outline = straight if len(straight) >= 3 else outline
    cameras = np.array([transform_points(inverse(pose), view.camera_in_table[None, :2, 3])[0] for view, pose in fitted])
    used = [view for view, _ in fitted]
    simple = without_teeth(outline, min(_pixel_width(view, pose) for view, pose in views if view in used))
    lines, simple_lines = (_lines_of(traced, edges, fitted) for edges in (outline, simple))
    std = edge_std(outline, lines, simple, simple_lines, cameras)
    x, y = polygon_centroid(outline)
    shape = ObjectShape(cells_in_outline(outline - (x, y), traced.shape.cells.size), outline - (x, y), std)
    fused = replace(traced, shape=shape, pose=_shifted_frame(traced.pose, (x, y)), top_origin=traced.top_origin - (x, y))
    return replace(fused, camera_positions=(cameras - (x, y),), displaced_std=displaced_std(simple, cameras, simple_lines))


def _fitted(template: Template, views: Sequence[PosedView], pose_known: bool) -> list[PosedView]:
    """The views in which a pose of the object fits, with that pose. Raises PerceptionError where there are none."""
    fitted = []
    for number, (view, pose) in enumerate(views):
        if pose_known and number == 0:
            fitted.append((view, pose))
            continue
        fit = fit_pose(template, view, pose)
        if fit.status is TrackStatus.TRACKED:
            fitted.append((view, fit.pose))
    if not fitted:
        raise PerceptionError(f"The object is found in none of {len(views)} views; give poses near the true ones.")
    return fitted


def _pixel_width(view: FrameView, pose: Float64Array) -> float:
    """Width of a pixel on the object [m]."""
    to_camera = view.camera_in_table[:3, 3] - (*pose[:2], 0.0)
    return float(np.linalg.norm(to_camera)) / view.frame.intrinsics.fx


def _lines_of(traced: TracedObject, outline: Float64Array, fitted: Sequence[PosedView]) -> list[EdgeLines]:
    """Lines of sight near the edges of an outline, of each view."""
    template = Template(replace(traced, shape=ObjectShape(traced.shape.cells, outline)))
    return [lines_near_edges(template, outline, view, pose) for view, pose in fitted]


def _derivatives(template: Template, outline: Float64Array, fitted: Sequence[PosedView]) -> tuple[Float64Array, Float64Array]:
    """J'r and the diagonal of J'J of the offsets of the edges, with their prior, shapes (n_edges,)."""
    gradient, curvature = np.zeros(len(outline)), prior_curvature(len(outline))
    for view, pose in fitted:
        g, c = lines_near_edges(template, outline, view, pose).derivatives(len(outline))
        gradient += g
        curvature += c
    return gradient, curvature


def relative_size(view: FrameView, traced: TracedObject) -> float:
    """Size of the object in a view at `traced.pose`, divided by the size of `traced`: not 1 with a wrong focal length or depth unit."""
    outline = traced.shape.outline
    gradient, curvature = lines_near_edges(Template(traced), outline, view, traced.pose).derivatives(len(outline))
    # An edge moves by its distance from the origin times the relative growth.
    lever = np.sum(outline * edge_normals(outline), axis=1)
    return 1.0 + float(np.sum(gradient * lever) / max(float(np.sum(curvature * lever**2)), 1e-9))


def with_edges_moved(outline: Float64Array, offset: Float64Array) -> Float64Array:
    """Every edge moved outwards by its offset; corners where the moved edges meet."""
    normal = edge_normals(outline)
    before, offset_before = np.roll(normal, 1, axis=0), np.roll(offset, 1)
    cosine = np.sum(normal * before, axis=1)
    mean = 0.5 * (offset + offset_before)[:, None] * (normal + before) / np.maximum(1.0 + cosine, 0.5)[:, None]
    # Nearly parallel edges meet far away; there the corner moves by the mean.
    sine2 = np.maximum(1.0 - cosine**2, _LEAST_SINE2)
    a, b = (offset_before - cosine * offset) / sine2, (offset - cosine * offset_before) / sine2
    meeting = a[:, None] * before + b[:, None] * normal
    return outline + np.where((1.0 - cosine**2 > _LEAST_SINE2)[:, None], meeting, mean)


def without_reversed(before: Float64Array, after: Float64Array, moved: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The moved outline and the offsets of its edges, without the short edges whose direction the moves reversed."""
    kept = np.sum((np.roll(after, -1, axis=0) - after) * (np.roll(before, -1, axis=0) - before), axis=1) > 0
    if np.count_nonzero(kept) < 3:
        return before, np.zeros(len(before))
    # The midpoint of a dropped edge replaces its two ends.
    merged = np.where(kept[:, None], after, 0.5 * (after + np.roll(after, -1, axis=0)))
    corner = np.where(np.roll(kept, 1)[:, None], after, np.roll(merged, 1, axis=0))
    return corner[kept], moved[kept]


def dense(outline: Float64Array, step: float = 2.5e-4) -> Float64Array:
    """Points along the outline every `step` [m], by default as dense as in a traced contour."""
    ends = np.roll(outline, -1, axis=0)
    counts = np.maximum(np.linalg.norm(ends - outline, axis=1) / step, 1.0).astype(np.int64)
    return np.concatenate(
        [a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a) for a, b, n in zip(outline, ends, counts, strict=True)]
    )


def _shifted_frame(pose: Float64Array, origin: tuple[float, float]) -> Float64Array:
    """The frame `pose`, (x, y, yaw), moved to a point given in it [m]."""
    return np.array([*transform_points(pose, [origin])[0], pose[2]])
