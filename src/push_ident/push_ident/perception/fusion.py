"""Refinement of a traced outline: every edge is moved to fit the lines of sight of one or several views.

Tracing (`shape`) finds form and corners from one view; its edges have errors of a few tenths of a millimetre that differ between the near
and the far side. Here each edge gets one unknown, its offset along its normal, estimated from the same comparison of stopped and passing
lines of sight as the poses. Views of the object in other poses, or by a second camera, add their lines of sight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.errors import InputError, PerceptionError
from push_ident.geometry.outline import cells_in_outline, edge_normals, polygon_centroid
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.perception.edges import EdgeLines, displaced_std, edge_std, lines_near_edges, prior_curvature, same_curve, without_teeth
from push_ident.perception.labels import RobotPart
from push_ident.perception.shape import TracedObject
from push_ident.perception.straighten import straighten
from push_ident.perception.tracking import Scene, Template, TrackStatus, fit_pose
from push_ident.types import DepthFrame, Float64Array, ObjectShape

__all__ = ["View", "dense", "fuse_views", "relative_size", "with_edges_moved", "without_reversed"]

_LARGEST: Final = 0.003
"""Largest offset of an edge over all passes [m]."""
_LEAST_SINE2: Final = 0.12
"""Two edges whose angle has a smaller squared sine meet too far away: their corner moves by the mean offset."""
_PASSES: Final = 3
"""Iterations of pose fit and edge fit."""


@dataclass(frozen=True, slots=True)
class View:
    """An object at rest in one depth image, at an approximate pose."""

    frame: DepthFrame
    """Preferably the `median_depth` of several frames."""
    camera_in_table: Float64Array
    """Shape (4, 4)."""
    pose: Float64Array
    """(x, y, yaw) of the object in `table`, to about a centimetre and ten degrees [m, m, rad]."""
    robot: Sequence[RobotPart] = ()
    """Parts of the robot; their pixels are left out."""

    @property
    def pixel(self) -> float:
        """Width of a pixel on the object [m]."""
        to_camera = self.camera_in_table[:3, 3] - (*self.pose[:2], 0.0)
        return float(np.linalg.norm(to_camera)) / self.frame.intrinsics.fx

    @property
    def scene(self) -> Scene:
        """The same image, as `fit_pose` takes it."""
        return Scene(self.frame, self.camera_in_table, self.robot)


def fuse_views(traced: TracedObject, views: Sequence[View], *, pose_known: bool = False) -> TracedObject:
    """Outline and cells that fit all views best.

    The object frame and `traced.pose` follow the centroid of the outline where that moves.

    Args:
        traced: The object from one view.
        views: All views, that one included.
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
        found = _found_in(template, views, pose_known)
        gradient, curvature = _derivatives(template, outline, found)
        shared = same_curve(outline)
        step = np.clip(moved + (shared @ gradient) / (shared @ curvature), -_LARGEST, _LARGEST) - moved
        outline, moved = without_reversed(outline, with_edges_moved(outline, step), moved + step)
    straight = straighten(dense(outline))
    outline = straight if len(straight) >= 3 else outline
    pixel = min(view.pixel for view, _ in found)
    seen_from = np.array([transform_points(inverse(pose), view.camera_in_table[None, :2, 3])[0] for view, pose in found])
    simple = without_teeth(outline, pixel)
    lines, simple_lines = (_lines_of(traced, edges, found) for edges in (outline, simple))
    std = edge_std(outline, lines, simple, simple_lines, seen_from)
    x, y = polygon_centroid(outline)
    shape = ObjectShape(cells_in_outline(outline - (x, y), traced.shape.cells.size), outline - (x, y), std)
    fused = replace(traced, shape=shape, pose=_shifted_frame(traced.pose, (x, y)), top_origin=traced.top_origin - (x, y))
    return replace(fused, seen_from=(seen_from - (x, y),), displaced_std=displaced_std(simple, seen_from, simple_lines))


def _found_in(template: Template, views: Sequence[View], pose_known: bool) -> list[tuple[View, Float64Array]]:
    """The views in which the object is found, with its pose. Raises PerceptionError where there are none."""
    found = []
    for number, view in enumerate(views):
        if pose_known and number == 0:
            found.append((view, view.pose))
            continue
        fit = fit_pose(template, view.scene, view.pose)
        if fit.status is TrackStatus.TRACKED:
            found.append((view, fit.pose))
    if not found:
        raise PerceptionError(f"The object is found in none of {len(views)} views; give poses near the true ones.")
    return found


def _lines_of(traced: TracedObject, outline: Float64Array, found: Sequence[tuple[View, Float64Array]]) -> list[EdgeLines]:
    """Lines of sight near the edges of an outline, of each view."""
    template = Template(replace(traced, shape=ObjectShape(traced.shape.cells, outline)))
    return [lines_near_edges(template, outline, view.scene, pose) for view, pose in found]


def _derivatives(
    template: Template, outline: Float64Array, found: Sequence[tuple[View, Float64Array]]
) -> tuple[Float64Array, Float64Array]:
    """J'r and the diagonal of J'J of the offsets of the edges, with their prior, shapes (n_edges,)."""
    gradient, curvature = np.zeros(len(outline)), prior_curvature(len(outline))
    for view, pose in found:
        g, c = lines_near_edges(template, outline, view.scene, pose).derivatives(len(outline))
        gradient += g
        curvature += c
    return gradient, curvature


def relative_size(view: View, traced: TracedObject) -> float:
    """Size of the object in a view at its fitted pose, divided by the size of `traced`: not 1 with a wrong focal length or depth unit."""
    outline = traced.shape.outline
    gradient, curvature = lines_near_edges(Template(traced), outline, view.scene, view.pose).derivatives(len(outline))
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


def dense(outline: Float64Array) -> Float64Array:
    """Points along the outline every quarter of a millimetre, as in a traced contour."""
    ends = np.roll(outline, -1, axis=0)
    counts = np.maximum(np.linalg.norm(ends - outline, axis=1) / 2.5e-4, 1.0).astype(np.int64)
    return np.concatenate(
        [a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a) for a, b, n in zip(outline, ends, counts, strict=True)]
    )


def _shifted_frame(pose: Float64Array, origin: tuple[float, float]) -> Float64Array:
    """The frame `pose`, (x, y, yaw), moved to a point given in it [m]."""
    return np.array([*transform_points(pose, [origin])[0], pose[2]])
