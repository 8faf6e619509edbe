"""Hollow things, such as a bowl, a mug or a box without a lid, are treated as if they had one.

A camera sees the rim of a hollow thing, inner walls behind it and a floor far below: pieces that jumps of depth divide. What makes
them one thing is that the rim encloses them. Where the highest points of a patch of object pixels enclose lower ones, each line of
sight through the opening is cut off in the plane of the rim; segments and outlines then come from a thing with a flat top.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.perception.frame.view import OBJECT, ROBOT, FrameView
from push_ident.perception.known_object import NOISE_STEP, TOP_QUANTILE, TracedObject
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import BoolArray, Float64Array

_CELL_FROM_ABOVE: Final = 0.002
"""Edge of a cell of the view from above [m]."""
_BESIDE_OPENING: Final = np.ones((7, 7), np.uint8)
"""Window in which the cells beside an opening give the height of its rim [cells]."""
_TORN: Final = np.ones((7, 7), np.uint8)
"""Pieces of a patch so near to each other belong together [px]."""
_TRIPLES: Final = 100
"""Of cells, by which circles are drawn through a rim: of 100 all miss one that is half of the cells once in 6e5 [-]."""
_MOST_CELLS: Final = 300
"""Of a rim by which circles are compared: more do not change which one most of them lie on."""
_DIRECTIONS: Final = 72
"""In which a round rim is looked for from its middle."""
_SEEN_RIM: Final = 0.75
"""Least fraction of them in which it is seen [-]: a hook or a bracket is open for more."""
_INSIDE_RIM: Final = 1.5
"""Lines of sight that enter or end so far inside the outer edge of the rim have passed it [cells]: points of the outer wall scatter about
the edge."""


@dataclass(frozen=True, slots=True)
class Covered:
    """A frame in which every hollow thing has a lid."""

    view: FrameView
    """The labels of lids are OBJECT."""
    lid: BoolArray | None
    """Which pixels are lids, shape (height, width); None where there is none."""


@dataclass(frozen=True, slots=True)
class _Opening:
    """A rim and what it encloses, seen from above."""

    within: Float64Array
    """Distance from the outer edge of the rim [cells], 0 outside of it, shape (rows, columns)."""
    origin: Float64Array
    """Low corner of the first cell [m], shape (2,)."""
    rim: float
    """Height of the rim [m]."""

    def depth_within(self, points: NDArray[np.float32]) -> Float64Array:
        """`within` at points [m], shape (n, 2); those not measured are outside."""
        rows, columns = self.within.shape
        with np.errstate(invalid="ignore"):
            x, y = ((points[:, k] - np.float32(self.origin[k])) / np.float32(_CELL_FROM_ABOVE) for k in (0, 1))
            inside = np.flatnonzero((x >= 0) & (x < columns) & (y >= 0) & (y < rows))
        depth = np.zeros(len(points))
        depth[inside] = self.within[y[inside].astype(np.intp), x[inside].astype(np.intp)]
        return depth


def cover_hollows(view: FrameView) -> Covered:
    """Put a lid on everything deeper than `min_step` that a rim encloses; the view itself where nothing is hollow."""
    frame, points, labels, settings = view.frame, view.points, view.labels, view.settings
    on_object = labels == OBJECT
    if not on_object.any():
        return Covered(view, None)
    lid = np.zeros(labels.shape, dtype=bool)
    depth, closed = frame.depth, points
    centre, rays = view.rays
    # A rim of two pixels is torn where the labels are smooth: its pieces are joined, and its points taken whatever their labels.
    joined = cv2.dilate(on_object.view(np.uint8), _TORN)
    u, v, width, height = cv2.boundingRect(joined)
    joined = joined[v : v + height, u : u + width]
    n, patches, boxes, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    for index in range(1, n):
        left, top, columns, rows, size = (int(value) for value in boxes[index])
        if size < 100:
            continue  # a rim has more pixels
        box, part = (slice(v + top, v + top + rows), slice(u + left, u + left + columns)), np.s_[top : top + rows, left : left + columns]
        with np.errstate(invalid="ignore"):
            raised = (points[box][..., 2] > settings.min_object_height) & (patches[part] == index) & (labels[box] != ROBOT)
        on_patch = points[box][raised]
        pixel = float(np.median(frame.depth[box][raised])) / frame.intrinsics.fx if len(on_patch) else 0.0
        for opening in _openings(on_patch, pixel, settings):
            reach = (opening.rim - centre[2]) / rays[box][..., 2]
            crossing = (centre[:2] + rays[box][..., :2] * reach[..., None]).astype(np.float32)
            measured = points[box].reshape(-1, 3)
            entry, end = opening.depth_within(crossing.reshape(-1, 2)), opening.depth_within(measured[:, :2])
            # A line of sight that enters inside the rim ends in the hollow; just at the rim, only where its end shows that.
            below = measured[:, 2] < opening.rim - NOISE_STEP
            ends_inside = below & ((entry > _INSIDE_RIM) | ((entry > 0) & (end > _INSIDE_RIM)))
            unmeasured = ~np.isfinite(measured[:, 2]) & (entry > _INSIDE_RIM)
            robot = labels[box].ravel() == ROBOT
            if np.count_nonzero(ends_inside) < 0.5 * np.count_nonzero(ends_inside | unmeasured):
                continue  # an unmeasured spot is no hollow
            covered = ((ends_inside | unmeasured) & ~robot).reshape(rows, columns)
            if not lid.any():
                depth, closed, labels = frame.depth.copy(), points.copy(), labels.copy()
            lid[box] |= covered
            depth[box][covered] = reach[covered]
            closed[box][covered] = np.dstack([crossing, np.full(reach.shape, opening.rim, np.float32)])[covered]
            labels[box][covered] = OBJECT
    return Covered(view.with_pixels(depth, closed, labels), lid) if lid.any() else Covered(view, None)


def _openings(points: NDArray[np.float32], pixel: float, settings: PerceptionSettings) -> Iterator[_Opening]:
    """Rims among the points of a patch, shape (n, 3), the highest first; `pixel`: the size of a pixel there [m].

    A rim may have gaps of two pixels; wider ones, as between the handles of pliers, are no part of a rim, unless it is round: where a rim
    runs along the line of sight, it is a pixel wide and torn.
    """
    highest = float(np.quantile(points[:, 2], TOP_QUANTILE)) if len(points) else 0.0
    if highest < settings.min_step:
        return
    reach = round(pixel / _CELL_FROM_ABOVE)
    gap = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    origin, far_corner = (np.array([end(points[:, 0]), end(points[:, 1])], dtype=np.float64) for end in (np.min, np.max))
    origin -= len(gap) * _CELL_FROM_ABOVE
    columns, rows = (int(n) for n in np.floor((far_corner - origin) / _CELL_FROM_ABOVE) + len(gap) + 1)
    column, row = ((points[:, :2] - origin) / _CELL_FROM_ABOVE).astype(np.int64).T
    heights = np.full((rows, columns), np.float32(-np.inf))
    np.maximum.at(heights, (row, column), points[:, 2])
    known = np.zeros((rows, columns), dtype=bool)
    for level in np.arange(highest - NOISE_STEP, settings.min_step, -0.01):
        high = _closed_where_round(cv2.morphologyEx((heights > level).astype(np.uint8), cv2.MORPH_CLOSE, gap), 1 + reach, settings)
        contours, tree = cv2.findContours(high, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        for i, contour in enumerate(contours):
            outer = int(tree[0, i, 3])
            if outer < 0 or cv2.contourArea(contour) * _CELL_FROM_ABOVE**2 < settings.min_object_area:
                continue
            hole, filled = (cv2.drawContours(np.zeros(high.shape, np.uint8), contours, k, 1, cv2.FILLED) for k in (i, outer))
            hole = (hole > 0) & (high == 0)
            # Where nothing raised is measured, the table or a shadow is.
            floor = float(np.median(np.maximum(heights[hole], 0.0)))
            if (known & hole).any() or level - floor < settings.min_step - NOISE_STEP:
                continue
            beside = (cv2.dilate(hole.astype(np.uint8), _BESIDE_OPENING) > 0) & (heights > level)
            known |= hole
            yield _Opening(cv2.distanceTransform(filled, cv2.DIST_L2, 3), origin, float(np.median(heights[beside])))


def _closed_where_round(high: NDArray[np.uint8], width: int, settings: PerceptionSettings) -> NDArray[np.uint8]:
    """The cells of a rim, with the whole circle on which most of it lies, if there is one and the rim does not fill it.

    Args:
        high: 1 in the cells of the rim, shape (rows, columns).
        width: Of the circle, and largest distance from it of a cell on it [cells].
    """
    least = settings.min_object_area / _CELL_FROM_ABOVE**2
    contours, _ = cv2.findContours(high, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not contours or cv2.contourArea(cv2.convexHull(np.vstack(contours))) - np.count_nonzero(high) < least:
        return high
    cells = np.argwhere(high)[:, ::-1].astype(np.float64)
    some = cells[:: 1 + len(cells) // _MOST_CELLS]
    middles, radii = _circles_through(some[np.random.default_rng(0).integers(len(some), size=(_TRIPLES, 3))])
    if len(radii) == 0:
        return high
    distance = np.abs(np.linalg.norm(some - middles[:, None], axis=2) - radii[:, None])
    near = distance[np.argmax(np.count_nonzero(distance < width, axis=1))] < width
    if np.count_nonzero(near) < 0.5 * len(some):
        return high
    middle, radius = _circle(some[near])
    if np.pi * radius**2 < least or _seen(cells, middle, radius, width) < _SEEN_RIM:
        return high
    x, y = (round(float(value)) for value in middle)
    return cv2.circle(high, (x, y), round(radius), 1, width)


def _circles_through(triples: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Middles, shape (n, 2), and radii, shape (n,), of the circles through triples of points (m, 3, 2), without those on a line."""
    a, b = triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    a, b, area, origin = (values[np.abs(area) > 0] for values in (a, b, area, triples[:, 0]))
    square_a, square_b = np.sum(a * a, axis=1), np.sum(b * b, axis=1)
    away = np.column_stack([b[:, 1] * square_a - a[:, 1] * square_b, a[:, 0] * square_b - b[:, 0] * square_a]) / (2.0 * area[:, None])
    return origin + away, np.linalg.norm(away, axis=1)


def _circle(points: Float64Array) -> tuple[Float64Array, float]:
    """Middle, shape (2,), and radius of the circle nearest to points (n, 2) by least squares (Kasa, 1976)."""
    design = np.column_stack([points, np.ones(len(points))])
    a, b, c = np.linalg.lstsq(design, np.sum(np.square(points), axis=1), rcond=None)[0]
    return np.array([a, b]) / 2.0, float(np.sqrt(max(c + (a * a + b * b) / 4.0, 0.0)))


def _seen(cells: Float64Array, middle: Float64Array, radius: float, width: int) -> float:
    """In which fraction of the directions from its middle cells (n, 2) lie on a circle, give or take `width`."""
    away = cells - middle
    on_it = away[np.abs(np.hypot(*away.T) - radius) < width]
    direction = np.floor((np.arctan2(on_it[:, 1], on_it[:, 0]) / (2.0 * np.pi) + 0.5) * _DIRECTIONS)
    return len(np.unique(direction)) / _DIRECTIONS


def with_hollow(traced: TracedObject, lid: Float64Array) -> TracedObject:
    """The object with the cells of its upper side that are a hollow; `lid` holds points of its lid [m], shape (n, 2), table frame."""
    size = traced.top_resolution
    cell = np.rint((lid - traced.pose[:2] - traced.top_origin) / size).astype(np.int64)
    hollow = np.zeros(traced.top.shape, dtype=np.uint8)
    inside = np.all((cell >= 0) & (cell < hollow.shape[::-1]), axis=1)
    hollow[cell[inside, 1], cell[inside, 0]] = 1
    # Pixels are up to two cells apart.
    return replace(traced, hollow=cv2.morphologyEx(hollow, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0)
