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
from push_ident.geometry.se2 import transform_points
from push_ident.perception.labels import RobotPart
from push_ident.perception.shape import TracedObject
from push_ident.perception.shape_kernels import edges_nearest
from push_ident.perception.straighten import straighten
from push_ident.perception.tracking import Scene, Template, TrackStatus, fit_pose, lines_of_sight
from push_ident.types import BoolArray, DepthFrame, Float64Array, ObjectShape

__all__ = ["View", "fuse_views", "relative_size"]

_BAND: Final = 0.005
"""Lines of sight within this distance of an edge are used [m]."""
_WIDTH: Final = 0.0015
"""Width of the step from stopped to passing [m], as in the tracker."""
_CORNER: Final = 0.004
"""Lines of sight within this distance of the end of an edge are left out, as they depend on both edges of the corner [m]."""
_PRIOR: Final = 0.001
"""Prior standard deviation of the offset of an edge [m]."""
_VARIANCE: Final = 0.05
"""Variance of the measured (stopped 1, passing 0) about the expected near an edge."""
_LARGEST: Final = 0.003
"""Largest offset of an edge over all passes [m]."""
_SAME_CURVE: Final = 0.35
"""Neighbouring edges whose headings differ by less belong to one curve and share their lines of sight [rad]."""
_REACH: Final = 0.008
"""Largest distance along a curve between edges that share their lines of sight [m]."""
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
        template = Template(replace(traced, shape=ObjectShape(traced.shape.cells, outline, traced_by_camera=True)))
        gradient, curvature = np.zeros(len(outline)), np.full(len(outline), _VARIANCE / _PRIOR**2)
        n_found = 0
        for number, view in enumerate(views):
            pose = view.pose
            if not (pose_known and number == 0):
                fit = fit_pose(template, view.scene, view.pose)
                if fit.status is not TrackStatus.TRACKED:
                    continue
                pose = fit.pose
            n_found += 1
            g, c = _edge_derivatives(template, outline, view, pose)
            gradient += g
            curvature += c
        if n_found == 0:
            raise PerceptionError(f"The object is found in none of {len(views)} views; give poses near the true ones.")
        shared = _same_curve(outline)
        step = np.clip(moved + (shared @ gradient) / (shared @ curvature), -_LARGEST, _LARGEST) - moved
        outline, moved = _without_reversed(outline, _with_edges_moved(outline, step), moved + step)
    straight = straighten(_dense(outline))
    outline = straight if len(straight) >= 3 else outline
    x, y = polygon_centroid(outline)
    shape = ObjectShape(cells_in_outline(outline - (x, y), traced.shape.cells.size), outline - (x, y), traced_by_camera=True)
    return replace(traced, shape=shape, pose=_shifted_frame(traced.pose, (x, y)), top_origin=traced.top_origin - (x, y))


def relative_size(view: View, traced: TracedObject) -> float:
    """Size of the object in a view at its fitted pose, divided by the size of `traced`: not 1 with a wrong focal length or depth unit."""
    outline = traced.shape.outline
    gradient, curvature = _edge_derivatives(Template(traced), outline, view, view.pose)
    # An edge moves by its distance from the origin times the relative growth.
    lever = np.sum(outline * edge_normals(outline), axis=1)
    return 1.0 + float(np.sum(gradient * lever) / max(float(np.sum(curvature * lever**2)), 1e-9))


def _edge_derivatives(template: Template, outline: Float64Array, view: View, pose: Float64Array) -> tuple[Float64Array, Float64Array]:
    """J'r and the diagonal of J'J, J the derivative of the expected by the offset of each edge, shapes (n_edges,)."""
    lines = lines_of_sight(template, view.scene, pose, _BAND, 1)
    gradient, curvature = np.zeros(len(outline)), np.zeros(len(outline))
    if lines is None:
        return gradient, curvature
    points = lines.innermost_points(template, pose)
    distance, _ = template.distance(points)
    expected = 1.0 / (1.0 + np.exp(np.clip(distance / _WIDTH, -30.0, 30.0)))
    slope = expected * (1.0 - expected) / _WIDTH
    edge, clear = _nearest_edge(points, outline)
    clear &= np.abs(distance) < _BAND
    np.add.at(gradient, edge[clear], (slope * (lines.stopped - expected))[clear])
    np.add.at(curvature, edge[clear], np.square(slope[clear]))
    return gradient, curvature


def _nearest_edge(points: Float64Array, outline: Float64Array) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], BoolArray]:
    """Index of the edge nearest to each point, and whether the point is clear of the corners of a long edge."""
    index, position = edges_nearest(points, np.ascontiguousarray(outline))
    own = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)[index]
    # A short edge of a curve has no corners of its own.
    margin = np.minimum(_CORNER, 0.25 * own)
    return index, (position > margin) & (position < own - margin)


def _same_curve(outline: Float64Array) -> Float64Array:
    """Which edges share their lines of sight, shape (n_edges, n_edges): nearby pieces of one curve."""
    n = len(outline)
    edge = np.roll(outline, -1, axis=0) - outline
    length, heading = np.linalg.norm(edge, axis=1), np.arctan2(edge[:, 1], edge[:, 0])
    shared = np.eye(n)
    for i in range(n):
        for step in (1, -1):
            j, travel = i, 0.0
            while True:
                j = (j + step) % n
                turned = abs((heading[j] - heading[i] + np.pi) % (2 * np.pi) - np.pi)
                if j == i or turned > _SAME_CURVE or travel > _REACH:
                    break
                shared[i, j] = 1.0
                travel += length[j]
    return shared


def _with_edges_moved(outline: Float64Array, offset: Float64Array) -> Float64Array:
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


def _without_reversed(before: Float64Array, after: Float64Array, moved: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The moved outline and the offsets of its edges, without the short edges whose direction the moves reversed."""
    kept = np.sum((np.roll(after, -1, axis=0) - after) * (np.roll(before, -1, axis=0) - before), axis=1) > 0
    if np.count_nonzero(kept) < 3:
        return before, np.zeros(len(before))
    # The midpoint of a dropped edge replaces its two ends.
    merged = np.where(kept[:, None], after, 0.5 * (after + np.roll(after, -1, axis=0)))
    corner = np.where(np.roll(kept, 1)[:, None], after, np.roll(merged, 1, axis=0))
    return corner[kept], moved[kept]


def _dense(outline: Float64Array) -> Float64Array:
    """Points along the outline every quarter of a millimetre, as in a traced contour."""
    ends = np.roll(outline, -1, axis=0)
    counts = np.maximum(np.linalg.norm(ends - outline, axis=1) / 2.5e-4, 1.0).astype(np.int64)
    return np.concatenate(
        [a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a) for a, b, n in zip(outline, ends, counts, strict=True)]
    )


def _shifted_frame(pose: Float64Array, origin: tuple[float, float]) -> Float64Array:
    """The frame `pose`, (x, y, yaw), moved to a point given in it [m]."""
    return np.array([*transform_points(pose, [origin])[0], pose[2]])
