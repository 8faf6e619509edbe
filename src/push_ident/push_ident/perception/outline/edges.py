"""Lines of sight near the edges of an outline: what moves an edge, and how well its position is known.

A line of sight that passes an edge at the distance d outside it is expected to be stopped by the object with the probability
1 / (1 + exp(d / w)). What is measured is 0 or 1. Two errors of an edge follow from that comparison:

- of the number of lines: the curvature of the sum of squares by the offset of the edge;
- of the camera: a matcher of windows makes edges ragged, and displaces those where depth jumps, by about a pixel (Nguyen et al., "Modeling
  Kinect Sensor Noise", 2012: 0.8 px). Depth does not jump where the camera sees the wall below the edge: the upper side only folds there.
  The lines show how far edges scatter about their mean position, not how far the mean is displaced. Both have the same cause, so the
  deviation of the mean is taken to be `_DISPLACED` times the scatter about an outline without teeth of about a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from push_ident.geometry.outline import edge_normals
from push_ident.perception.frame.view import FrameView
from push_ident.perception.known_object import Template
from push_ident.perception.shape_kernels import edges_nearest
from push_ident.perception.tracking.pose_fit import lines_of_sight
from push_ident.types import BoolArray, Float64Array

__all__ = [
    "VARIANCE",
    "EdgeLines",
    "displaced_std",
    "edge_std",
    "hidden_walls",
    "lines_near_edges",
    "prior_curvature",
    "same_curve",
    "scatter_of",
    "without_teeth",
]

_BAND: Final = 0.005
"""Lines of sight within this distance of an edge are used [m]."""
_WIDTH: Final = 0.0015
"""Width w of the step from stopped to passing [m], as in the tracker."""
_CORNER: Final = 0.004
"""Lines of sight within this distance of the end of an edge are left out, as they depend on both edges of the corner [m]."""
_PRIOR: Final = 0.001
"""Prior standard deviation of the offset of an edge [m]."""
VARIANCE: Final = 0.05
"""Variance of the measured (stopped 1, passing 0) about the expected near an edge."""
_SAME_CURVE: Final = 0.35
"""Neighbouring edges whose headings differ by less belong to one curve and share their lines of sight [rad]."""
_REACH: Final = 0.008
"""Largest distance along a curve between edges that share their lines of sight [m]."""
_DISPLACED: Final = 1.8
"""Deviation of the mean position of an edge where depth jumps, in units of the scatter about it [-]: the root mean square over the models
of a Kinect (2.3), a D435 (1.3 and 1.5) and a D415 (1.5). The displacement in these models is an estimate itself."""
_TOOTH: Final = 1.5
"""Largest height of a tooth of an outline that is taken for raggedness [px]: matchers displace edges by about one."""
_MOST_SCATTER: Final = 0.005
"""Largest scatter that is told from no edge at all [m]: that of the band."""


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
    expected = 1.0 / (1.0 + np.exp(np.clip(distance / _WIDTH, -30.0, 30.0)))
    edge, clear = _nearest_edge(points, outline)
    clear &= np.abs(distance) < _BAND
    slope = expected * (1.0 - expected) / _WIDTH
    return EdgeLines(edge[clear], slope[clear], (lines.stopped - expected)[clear], points[clear])


def prior_curvature(n_edges: int) -> Float64Array:
    """What the prior of the offsets adds to the diagonal of J'J, shape (n_edges,)."""
    return np.full(n_edges, VARIANCE / _PRIOR**2)


def same_curve(outline: Float64Array) -> Float64Array:
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


def without_teeth(outline: Float64Array, pixel: float) -> Float64Array:
    """The outline without the teeth that the raggedness of edges gives it; `pixel` is the width of a pixel on the object [m]."""
    simple = cv2.approxPolyDP((outline / pixel).astype(np.float32)[:, None], _TOOTH, True)[:, 0].astype(np.float64) * pixel
    return simple if len(simple) >= 3 else outline


def hidden_walls(outline: Float64Array, camera_positions: Float64Array) -> BoolArray:
    """Edges whose wall none of the cameras at these positions sees, so that depth jumps there, shape (n_edges,).

    Args:
        outline: Counter-clockwise [m], shape (n_edges, 2).
        camera_positions: [m], shape (n_cameras, 2), in the same frame.
    """
    to_camera = camera_positions[:, None] - 0.5 * (outline + np.roll(outline, -1, axis=0))
    return np.asarray(np.all(np.sum(to_camera * edge_normals(outline), axis=2) <= 0.0, axis=0))


def displaced_std(outline: Float64Array, camera_positions: Float64Array, lines: Sequence[EdgeLines]) -> float:
    """Standard deviation of how far the camera displaces edges where depth jumps, all of them alike [m].

    Args:
        outline: Without teeth.
        camera_positions: As of `hidden_walls`.
        lines: Lines near its edges.
    """
    return _DISPLACED * scatter_of([view.of_edges(hidden_walls(outline, camera_positions)) for view in lines])


def edge_std(
    outline: Float64Array,
    views: Sequence[EdgeLines],
    simple: Float64Array,
    simple_views: Sequence[EdgeLines],
    camera_positions: Float64Array,
) -> Float64Array:
    """Standard deviation of the position of each edge along its normal [m], shape (n_edges,); that of the prior where no line passes it.

    Args:
        outline: The traced outline.
        views: Lines near its edges.
        simple: The outline without teeth.
        simple_views: Lines near its edges.
        camera_positions: As of `hidden_walls`.
    """
    n = len(outline)
    curvature = same_curve(outline) @ (prior_curvature(n) + sum(view.derivatives(n)[1] for view in views))
    hidden, simple_hidden = hidden_walls(outline, camera_positions), hidden_walls(simple, camera_positions)
    ragged = [scatter_of([view.of_edges(chosen) for view in simple_views]) for chosen in (~simple_hidden, simple_hidden)]
    displaced = np.where(hidden, displaced_std(simple, camera_positions, simple_views), 0.0)
    return np.sqrt(VARIANCE / curvature + np.where(hidden, ragged[1], ragged[0]) ** 2 + displaced**2)


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
    scatter = np.linspace(1e-6, _MOST_SCATTER, 200)
    distance = np.linspace(-_BAND, _BAND, 501)
    expected = 1.0 / (1.0 + np.exp(distance / _WIDTH))
    stopped = ndtr(-distance / scatter[:, None])
    square = stopped * (1.0 - 2.0 * expected) + expected**2
    return scatter, np.average(square, axis=1, weights=(expected * (1.0 - expected)) ** 2)


def _nearest_edge(points: Float64Array, outline: Float64Array) -> tuple[NDArray[np.int64], BoolArray]:
    """Index of the edge nearest to each point, and whether the point is clear of the corners of a long edge."""
    index, position = edges_nearest(points, np.ascontiguousarray(outline))
    length = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)[index]
    # A short edge of a curve has no corners of its own.
    margin = np.minimum(_CORNER, 0.25 * length)
    return index, (position > margin) & (position < length - margin)
