"""Lines of sight near the edges of an outline: what moves an edge, and how well its position is known.

A line of sight that passes an edge at the distance d outside it is expected to be stopped by the object with the probability
1 / (1 + exp(d / w)). What is measured is 0 or 1. Two errors of an edge follow from that comparison:

- of the number of lines: the curvature of the sum of squares by the offset of the edge;
- of the camera: a matcher of windows makes edges ragged, and displaces those where depth jumps, by about a pixel (Nguyen et al., "Modeling
  Kinect Sensor Noise", 2012: 0.8 px). Depth does not jump where the camera sees the wall below the edge: the upper side only folds there.
  A wall that fills less than half of a window in the image is a jump in part (`depth_jumps`). The lines show how far edges scatter about
  their mean position, not how far the mean is displaced. Matchers widen what is nearer, so the mean is taken to lie outside the surface,
  by about a pixel where neighbouring pixels share their noise, as within one window, and by nothing where each is measured by itself. It
  is taken out of the outline, and is part of what is expected of lines of sight in later frames.

Tracing finds form and corners from one view; its edges have errors of a few tenths of a millimetre that differ between the near and the far
side. `fuse_views` gives each edge one unknown, its offset along its normal, estimated from that comparison in one or several views. Views
of the object in other poses, or by a second camera, add their lines of sight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import dense, edge_normals, polygon_centroid
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.geometry.shape_check import crossing_edges
from push_ident.perception.frame.view import FrameView, pixel_at, wall_visibility, windows_along
from push_ident.perception.kernels import edges_nearest
from push_ident.perception.known_object import Template, TracedObject, TrackStatus
from push_ident.perception.outline.fewest_pieces import with_fewest_pieces
from push_ident.perception.outline.tracing import straighten
from push_ident.perception.tracking.pose_fit import EDGE_WIDTH, fit_pose, lines_of_sight
from push_ident.types import BoolArray, Float64Array, ObjectShape

_BAND: Final = 0.005
"""Lines of sight within this distance of an edge are used [m]."""
_LEAST_SINE2: Final = 0.12
"""Two edges whose angle has a smaller squared sine meet too far away: their corner moves by the mean offset."""
LEAST_SCATTER: Final = 0.00015
"""Least scatter of edges [m]: of an exact camera, from folds and corners that the model of lines of sight does not have."""
_JUMPS: Final = 0.5
"""An edge of which more is a jump of depth counts as one [-]."""
_PRIOR: Final = 0.001
"""Prior standard deviation of the offset of an edge [m]."""
VARIANCE: Final = 0.05
"""Variance of the measured (stopped 1, passing 0) about the expected near an edge."""
SAME_CURVE: Final = 0.35
"""Neighbouring edges whose headings differ by less belong to one curve and share their lines of sight [rad]."""
_DISPLACED: Final = (1.25, 0.5)
"""How far an edge where depth jumps lies outside the surface where pixels share all of their noise, and the deviation of that [px]. Nguyen
et al. have 0.8 px of a Kinect, whose pixels share three quarters; outlines through the models of a D435 and a D415 (0.85 shared) lie 1.0 px
outside, those through the model of a Kinect 1.6 px."""


PosedView = tuple[FrameView, Float64Array]
"""A view of an object at rest, preferably of the `median_frame` of several frames, and its pose (x, y, yaw) there [m, m, rad], table
frame."""


@dataclass(frozen=True, slots=True)
class EdgeLines:
    """Lines of sight near edges, n of them."""

    edge: NDArray[np.int64]
    """Index of the nearest edge, shape (n,)."""
    slope: Float64Array
    """Derivative of the expected by the offset of the edge [1/m], shape (n,)."""
    residual: Float64Array
    """Measured minus expected, shape (n,)."""
    points: Float64Array
    """Where they pass the edge [m], shape (n, 2), object frame."""

    def of_edges(self, chosen: BoolArray) -> EdgeLines:
        """Only the lines near the chosen edges, shape (n_edges,)."""
        near = chosen[self.edge]
        return EdgeLines(self.edge[near], self.slope[near], self.residual[near], self.points[near])

    def derivatives(self, n_edges: int) -> tuple[Float64Array, Float64Array]:
        """J'r and the diagonal of J'J, J the derivative of the expected by the offset of each edge, shapes (n_edges,)."""
        return (
            np.bincount(self.edge, self.slope * self.residual, minlength=n_edges).astype(np.float64),
            np.bincount(self.edge, np.square(self.slope), minlength=n_edges).astype(np.float64),
        )


def lines_near_edges(template: Template, outline: Float64Array, view: FrameView, pose: Float64Array) -> EdgeLines:
    """The lines of sight of a frame that pass an edge closely, with the object of `template` and `outline` at a pose."""
    lines = lines_of_sight(template, view, pose, _BAND, 1)
    if lines is None:
        return EdgeLines(np.empty(0, dtype=np.int64), np.empty(0), np.empty(0), np.empty((0, 2)))
    points = lines.innermost_points(template, pose)
    distance, _ = template.distance(points)
    expected = 1.0 / (1.0 + np.exp(np.clip(distance / EDGE_WIDTH, -30.0, 30.0)))
    edge, clear = _nearest_edge(points, outline)
    if template.traced.displaced > 0.0:
        distance = distance - template.traced.displaced * depth_jumps(outline, cameras_of(template.traced, [(view, pose)]))[edge]
        expected = 1.0 / (1.0 + np.exp(np.clip(distance / EDGE_WIDTH, -30.0, 30.0)))
    clear &= np.abs(distance) < _BAND
    slope = expected * (1.0 - expected) / EDGE_WIDTH
    return EdgeLines(edge[clear], slope[clear], (lines.stopped - expected)[clear], points[clear])


def same_curve(outline: Float64Array) -> Float64Array:
    """Which edges share their lines of sight, shape (n_edges, n_edges): pieces of one curve up to 8 mm apart along it."""
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
                if j == i or turned > SAME_CURVE or travel > 0.008:
                    break
                shared[i, j] = 1.0
                travel += length[j]
    return shared


def without_teeth(outline: Float64Array, pixel: float) -> Float64Array:
    """The outline without teeth up to 1.5 pixels high, as matchers give it; `pixel` is the width of a pixel on the object [m]."""
    simple = cv2.approxPolyDP((outline / pixel).astype(np.float32)[:, None], 1.5, True)[:, 0].astype(np.float64) * pixel
    return simple if len(simple) >= 3 else outline


def cameras_of(traced: TracedObject, views: Sequence[PosedView]) -> Float64Array:
    """Position of the camera of each view, object frame [m, m], and how well it sees walls [1/m] (`wall_visibility`), shape
    (n_views, 3)."""
    height = float(0.5 * (traced.top.min() + traced.top.max()))
    return np.array(
        [
            [*transform_points(inverse(pose), view.camera_in_table[None, :2, 3])[0], wall_visibility(view, pose, height)]
            for view, pose in views
        ]
    )


def depth_jumps(outline: Float64Array, cameras: Float64Array) -> Float64Array:
    """How far each edge is a jump of depth for all cameras, shape (n_edges,): 1 where none sees its wall, 0 where one sees it well.

    Args:
        outline: Counter-clockwise [m], shape (n_edges, 2), object frame.
        cameras: As of `cameras_of`.
    """
    to_camera = cameras[:, None, :2] - 0.5 * (outline + np.roll(outline, -1, axis=0))
    towards = np.sum(to_camera * edge_normals(outline), axis=2)
    return np.asarray(np.min(np.clip(1.0 - cameras[:, 2:] * towards, 0.0, 1.0), axis=0))


def displacement(views: Sequence[PosedView]) -> tuple[float, float]:
    """How far a camera displaces edges where depth jumps, all of them alike, and the standard deviation of that [m]."""
    mean, std = _DISPLACED
    shared = float(np.mean([view.shared_noise * pixel_at(view, pose) for view, pose in views]))
    return mean * shared, std * shared


def edge_std(outline: Float64Array, views: Sequence[EdgeLines], cameras: Float64Array, displaced_std: float) -> Float64Array:
    """Standard deviation of the position of each edge along its normal [m], shape (n_edges,); that of the prior where no line passes it.

    Args:
        outline, views: Outline without teeth, and lines near its edges.
        cameras: As of `cameras_of`.
        displaced_std: Of the displacement of all edges where depth jumps [m].
    """
    n = len(outline)
    curvature = same_curve(outline) @ (np.full(n, VARIANCE / _PRIOR**2) + sum(view.derivatives(n)[1] for view in views))
    displaced = depth_jumps(outline, cameras) * displaced_std
    return np.sqrt(VARIANCE / curvature + _raggedness(outline, outline, views, cameras) ** 2 + displaced**2)


def _raggedness(outline: Float64Array, smooth: Float64Array, views: Sequence[EdgeLines], cameras: Float64Array) -> Float64Array:
    """Scatter of the edges of an outline about another one without teeth [m], shape (n_edges,): that of all where depth jumps, or of all
    others.

    Args:
        smooth, views: The other one, and lines near its edges.
        cameras: As of `cameras_of`.
    """
    jumps = depth_jumps(smooth, cameras) > _JUMPS
    seen, hidden = (scatter_of([view.of_edges(chosen) for view in views]) for chosen in (~jumps, jumps))
    return np.where(depth_jumps(outline, cameras) > _JUMPS, hidden, seen)


def scatter_of(views: Sequence[EdgeLines]) -> float:
    """Standard deviation with which the position of the edges scatters along them [m]."""
    weight = np.concatenate([np.empty(0), *(np.square(view.slope) for view in views)])
    if not np.any(weight > 0):
        return 0.0
    square = np.average(np.square(np.concatenate([view.residual for view in views])), weights=weight)
    scatter, expected = _expected_squares()
    return float(np.interp(square, expected, scatter))


@cache
def _expected_squares() -> tuple[Float64Array, Float64Array]:
    """Scatter of an edge [m], and the mean square of residuals that it causes, weighted by the squared slope; each shape (n,)."""
    scatter = np.linspace(1e-6, _BAND, 200)
    distance = np.linspace(-_BAND, _BAND, 501)
    expected = 1.0 / (1.0 + np.exp(distance / EDGE_WIDTH))
    stopped = ndtr(-distance / scatter[:, None])
    square = stopped * (1.0 - 2.0 * expected) + expected**2
    return scatter, np.average(square, axis=1, weights=(expected * (1.0 - expected)) ** 2)


def _nearest_edge(points: Float64Array, outline: Float64Array) -> tuple[NDArray[np.int64], BoolArray]:
    """Index of the edge nearest to each point, and whether the point is clear of the corners of a long edge."""
    index, position = edges_nearest(points, np.ascontiguousarray(outline))
    length = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)[index]
    # Lines within 4 mm of a corner depend on both of its edges; a short edge of a curve has no corners of its own.
    margin = np.minimum(0.004, 0.25 * length)
    return index, (position > margin) & (position < length - margin)


def fuse_views(traced: TracedObject, views: Sequence[PosedView]) -> TracedObject:
    """Outline and cells that fit all views best.

    The object frame and `traced.pose` follow the centroid of the outline where that moves.

    Args:
        traced: The object from one view.
        views: The view in which the object was traced, then others, with poses to about a centimetre and ten degrees.
    """
    outline, fitted = _fitted_edges(traced, traced.shape.outline, views)
    displaced, displaced_std = displacement(fitted)
    straight = straighten(dense(outline))
    outline, cameras = straight if len(straight) >= 3 else outline, cameras_of(traced, fitted)
    pixel = min(pixel_at(view, pose) for view, pose in fitted)
    smooth = without_teeth(outline, pixel)
    height = float(traced.top.mean())
    windows = np.mean([windows_along(view, pose, outline, height) for view, pose in fitted], axis=0)
    # Once more about the pieces: a polygon without teeth is coarser than a curve.
    for _ in range(2):
        lines = _lines_of(traced, smooth, fitted)
        smooth = with_fewest_pieces(outline, np.maximum(_raggedness(outline, smooth, lines, cameras), LEAST_SCATTER), windows)
    traced = replace(traced, displaced=displaced, displaced_std=displaced_std)
    without, _ = moved_apart(smooth, np.zeros(len(smooth)), -displaced * depth_jumps(smooth, cameras))
    outline, fitted = _fitted_edges(traced, without, views)
    std = edge_std(outline, _lines_of(traced, outline, fitted), cameras, displaced_std)
    x, y = polygon_centroid(outline)
    shape = ObjectShape(cells_in_outline(outline - (x, y), traced.shape.cells.size), outline - (x, y), std)
    pose = np.array([*transform_points(traced.pose, [(x, y)])[0], traced.pose[2]])
    return replace(traced, shape=shape, pose=pose, top_origin=traced.top_origin - (x, y), camera_positions=(cameras[:, :2] - (x, y),))


def _fitted_edges(traced: TracedObject, outline: Float64Array, views: Sequence[PosedView]) -> tuple[Float64Array, list[PosedView]]:
    """The outline whose edges fit all views best, and the views with their poses."""
    outline, moved = np.array(outline), np.zeros(len(outline))
    for _ in range(3):
        template = Template(replace(traced, shape=ObjectShape(traced.shape.cells, outline)))
        fitted = _fitted(template, views)
        gradient, curvature = _derivatives(template, outline, fitted)
        shared = same_curve(outline)
        step = np.clip(moved + (shared @ gradient) / (shared @ curvature), -0.003, 0.003) - moved
        outline, moved = moved_apart(outline, moved, step)
    return outline, fitted


def moved_apart(outline: Float64Array, moved: Float64Array, step: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The outline with its edges moved by a step, shape (n_edges,), and their offsets: by half of it, a quarter or not at all where edges
    would cross each other."""
    for part in (1.0, 0.5, 0.25):
        after, offsets = without_reversed(outline, with_edges_moved(outline, part * step), moved + part * step)
        if crossing_edges(after) is None:
            return after, offsets
    return outline, moved


def _fitted(template: Template, views: Sequence[PosedView]) -> list[PosedView]:
    """The first view, whose pose is known, and the others in which a pose of the object fits, with that pose."""
    fitted = list(views[:1])
    for view, pose in views[1:]:
        fit = fit_pose(template, view, pose)
        if fit.status is TrackStatus.TRACKED:
            fitted.append((view, fit.pose))
    return fitted


def _lines_of(traced: TracedObject, outline: Float64Array, fitted: Sequence[PosedView]) -> list[EdgeLines]:
    template = Template(replace(traced, shape=ObjectShape(traced.shape.cells, outline)))
    return [lines_near_edges(template, outline, view, pose) for view, pose in fitted]


def _derivatives(template: Template, outline: Float64Array, fitted: Sequence[PosedView]) -> tuple[Float64Array, Float64Array]:
    """J'r and the diagonal of J'J of the offsets of the edges, with their prior, shapes (n_edges,)."""
    gradient, curvature = np.zeros(len(outline)), np.full(len(outline), VARIANCE / _PRIOR**2)
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
    """Every edge moved outwards by its offset [m], shape (n_vertices,); corners where the moved edges meet. Linear in the offsets."""
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
