"""Outline, cells and heights of an object at rest.

A pixel measures more than one point: its line of sight is empty up to that point. A pixel that measures something below the top of the
object beside it thus proves that its line of sight is empty where it passes the height of that top, also above the shadow behind the
object, where no table is visible. Points on the upper side (full) and points proved empty, about one pixel to either side of the edge,
are spread on a fine grid; the outline is where both have equal weight.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.errors import PerceptionError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import edge_normals, line_crossing, polygon_area, polygon_centroid
from push_ident.geometry.shape_check import crossing_edges
from push_ident.perception.frame.view import unmeasured_areas
from push_ident.perception.kernels import outline_distances
from push_ident.perception.known_object import SegmentedView, TracedObject
from push_ident.types import BoolArray, Float64Array, ObjectShape

_FINE: Final = 0.001
"""Edge of a cell of the fine grid [m]."""
_SPREAD: Final = 0.0015
"""Standard deviation of the Gaussian that spreads one sample [m]: about the distance between pixels on the table."""
_MARGIN: Final = 0.015
"""Width of the fine grid around the object [m]."""
_PIXEL_REACH: Final = 10
"""Lines of sight up to this distance from the upper side are used [px]."""
_COARSE: Final = 0.0016
"""Distance within which a stretch of contour may be straight [m]."""
_NEAR_CONTOUR: Final = 0.0007
"""Largest distance of the result from the contour where it is not straight [m]."""
_RESTORED: Final = 0.004
"""Largest distance of a restored corner from the contour [m]."""


Result = TypeVar("Result")

InParts = Generator[None, None, Result]
"""Work that is done in parts, so that a frame need not wait for all of it: yields after each part but the last one, and returns the result.

Nothing depends on the clock: the same parts give the same result, on a fast machine and on a slow one, live and in a replay."""


def trace_object(views: Sequence[SegmentedView], *, min_height: float, cell_count: int) -> TracedObject:
    """As `trace_in_parts`, all at once."""
    work = trace_in_parts(views, min_height=min_height, cell_count=cell_count)
    while True:
        try:
            next(work)
        except StopIteration as end:
            traced: TracedObject = end.value
            return traced


def trace_in_parts(views: Sequence[SegmentedView], *, min_height: float, cell_count: int) -> InParts[TracedObject]:
    """Shape of an object from the images of one or several cameras, in which it has the same pose.

    Where a taller part hides a spot from one camera, the lines of sight of another may prove it empty or full.

    Args:
        min_height: Anything lower is table [m].
        cell_count: Approximate number of cells.

    Raises PerceptionError: No upper side is visible, or no outline can be traced.
    """
    lines = []
    for segmented in views:
        lines.append(_lines_of_sight(segmented, min_height=min_height))
        yield
    centres = [segmented.view.camera_in_table[:2, 3] for segmented in views]
    outline, inner = None, None
    for _ in range(3):  # The first pass decides for each line of sight which of its ends matters.
        full, empty = _points_of_views(lines, outline)
        yield
        inner = inner or [_inner_walls(walls, points, centre) for (_, _, walls), points, centre in zip(lines, full, centres, strict=True)]
        outline, origin = _balance(np.vstack([*full, *inner]), np.vstack(empty))
        yield
    assert outline is not None
    x, y = polygon_centroid(outline)
    cell_size = float(np.sqrt(abs(polygon_area(outline)) / cell_count))
    shape = ObjectShape(cells_in_outline(outline - (x, y), cell_size), outline - (x, y))
    positions, levels = np.vstack(full), np.concatenate([stopped.level for stopped, _, _ in lines])
    if len(views) > 1:
        # Nearer to the edge than two pixels, what one view takes for the upper side may be the wall that another one sees.
        inside = outline_distances(positions, np.ascontiguousarray(outline)) < -0.003
        positions, levels = (positions[inside], levels[inside]) if inside.any() else (positions, levels)
    grid, grid_origin = _height_grid(positions, levels, origin)
    return TracedObject(shape, np.array([x, y, 0.0]), grid, grid_origin - (x, y), 2 * _FINE)


def _points_of_views(
    lines: Sequence[tuple[_Lines, _Lines, Float64Array]], outline: Float64Array | None
) -> tuple[list[Float64Array], list[Float64Array]]:
    """Per view the points that are full and those that are empty [m], shapes (n, 2), as far as `outline` is known."""
    full = [stopped.points(outline) for stopped, _, _ in lines]
    empty = [passing.points(outline) for _, passing, _ in lines]
    if len(lines) == 1:
        return full, empty
    # What one view does not measure, as in the shadow of a higher part, counts as empty only where no other view measures anything.
    cells = [_cells_of(np.vstack([a, b[passing.measured]])) for a, b, (_, passing, _) in zip(full, empty, lines, strict=True)]
    for i, (_, passing, _) in enumerate(lines):
        elsewhere = np.concatenate(cells[:i] + cells[i + 1 :])
        empty[i] = empty[i][passing.measured | ~np.isin(_cells_of(empty[i]), elsewhere)]
    return full, empty


def _cells_of(points: Float64Array) -> NDArray[np.int64]:
    """Numbers of the cells of 4 mm, two pixels on the table, that hold the points, shape (n,)."""
    cell = np.floor(points / 0.004).astype(np.int64)
    return np.asarray(cell[:, 0] * 2**20 + cell[:, 1])


@dataclass(frozen=True, slots=True)
class _Lines:
    """Lines of sight that the object stops, or that pass it: where they are at the level of its top and a little below."""

    upper: Float64Array
    """[m], shape (n, 2), table frame."""
    lower: Float64Array
    """[m], shape (n, 2), table frame."""
    level: Float64Array
    """Height of the top beside the line [m], shape (n,)."""
    measured: BoolArray
    """Whether anything was measured along it, shape (n,)."""

    def points(self, outline: Float64Array | None) -> Float64Array:
        """Per line the end that decides whether it is stopped: the one further inside `outline`. Without outline: the middle."""
        if outline is None:
            return 0.5 * (self.upper + self.lower)
        outline = np.ascontiguousarray(outline)
        use_upper = outline_distances(self.upper, outline) < outline_distances(self.lower, outline)
        return np.where(use_upper[:, None], self.upper, self.lower)


def _lines_of_sight(segmented: SegmentedView, *, min_height: float) -> tuple[_Lines, _Lines, Float64Array]:
    """Lines of sight stopped by the upper side of the object, those that pass it, and points on walls [m], shape (n, 2)."""
    view, segment = segmented.view, segmented.segment
    pad, level_window = 16, 7  # around the segment; in which levels of the upper side beside a pixel are looked for [px]
    rows = slice(max(0, segment.rows.start - pad), segment.rows.stop + pad)
    columns = slice(max(0, segment.columns.start - pad), segment.columns.stop + pad)
    centre, rays = view.rays
    rays, depth, points = rays[rows, columns], view.frame.depth[rows, columns], view.points[rows, columns]
    body = np.zeros(depth.shape, dtype=bool)
    top, left = segment.rows.start - rows.start, segment.columns.start - columns.start
    body[top : top + segment.mask.shape[0], left : left + segment.mask.shape[1]] = segment.mask
    pixel = float(np.nanmedian(depth)) / view.frame.intrinsics.fx
    z = points[..., 2]
    valid = np.isfinite(z)
    body = body & valid & (z > min_height)
    step = max(3.0 * view.noise, 0.002)
    filled = np.where(valid, z, np.float32(0.0))
    # Upper sides are flat compared with walls: a wall rises by more than a pixel's width from one pixel to the next.
    slope = np.hypot(*(cv2.Sobel(filled, cv2.CV_32F, dx, dy, ksize=3, scale=1 / 8) for dx, dy in ((1, 0), (0, 1))))
    flat = body & (slope < 0.7 * pixel)
    if np.count_nonzero(flat) < 20:
        raise PerceptionError(f"{np.count_nonzero(flat)} of {np.count_nonzero(body)} pixels show an upper side, expected at least 20.")
    smooth = _mean_of(filled, flat, 3)
    window = np.ones((level_window, level_window), np.uint8)
    # Means over the highest and the lowest level nearby: the extremes themselves would be biased by noise.
    at_highest = flat & (smooth > cv2.dilate(np.where(flat, smooth, np.float32(-1.0)), window) - step)
    at_lowest = flat & (smooth < cv2.erode(np.where(flat, smooth, np.float32(1.0)), window) + step)
    highest, lowest = _mean_of(smooth, at_highest, level_window), _mean_of(smooth, at_lowest, level_window, absent=1.0)
    near_highest, near_lowest = np.abs(z - highest) < step, np.abs(z - lowest) < step
    stopped = body & (flat | near_highest | near_lowest)
    # Level of the top beside the other pixels: the highest within the window, else that of the nearest flat pixel.
    distance, nearest = cv2.distanceTransformWithLabels((~flat).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    level_of = np.zeros(int(nearest.max()) + 1, dtype=np.float32)
    level_of[nearest[flat]] = smooth[flat]
    beside = np.where(highest > 0, highest, level_of[nearest])
    # A wall between two levels of the upper side lies inside the outline and does not constrain it.
    foot = cv2.erode(np.where(at_lowest, smooth, np.float32(1.0)), np.ones((2 * _PIXEL_REACH + 1, 2 * _PIXEL_REACH + 1), np.uint8))
    # Beside two levels a line of sight proves only its crossing of the lower one empty: the upper one may end earlier.
    lower = cv2.erode(np.where(at_lowest, smooth, np.float32(1.0)), np.ones((13, 13), np.uint8))
    passing = valid & ~stopped & (z < np.minimum(foot, beside) - step) & (distance < _PIXEL_REACH)
    # The object ends where its shadow begins, since all of its upper side up to the edge is lit.
    passing |= (unmeasured_areas(valid) > 0) & (distance < _PIXEL_REACH)
    beside = np.minimum(lower, beside)

    def lines(chosen: BoolArray, level: NDArray[np.float32]) -> _Lines:
        ray, top = rays[chosen].astype(np.float64), level[chosen].astype(np.float64)
        upper, lower = (centre[:2] + ray[:, :2] * ((height - centre[2]) / ray[:, 2])[:, None] for height in (top, top - step))
        return _Lines(upper, lower, top, valid[chosen])

    return (
        lines(stopped, np.where(flat, smooth, np.where(near_highest, highest, lowest))),
        lines(passing, beside),
        points[body & ~stopped, :2].astype(np.float64),
    )


def _inner_walls(walls: Float64Array, full: Float64Array, camera: Float64Array) -> Float64Array:
    """Points on walls 4 mm in front of which, towards the camera, the object continues at a lower level: they lie inside the outline."""
    to_camera = camera - walls
    before = walls + 0.004 * to_camera / np.linalg.norm(to_camera, axis=1, keepdims=True)
    origin = np.vstack([full, before]).min(axis=0) - _FINE
    columns, rows = (int(n) for n in np.ceil((np.vstack([full, before]).max(axis=0) + _FINE - origin) / _FINE))
    # The object ends beside a wall along the line of sight, so only points well inside count.
    around = np.ones((5, 5), np.uint8)
    covered = cv2.erode(cv2.morphologyEx((_counted(full, origin, rows, columns) > 0).astype(np.uint8), cv2.MORPH_CLOSE, around), around) > 0
    index = ((before - origin) / _FINE).astype(np.int64)
    return walls[covered[index[:, 1], index[:, 0]]]


def _mean_of(values: NDArray[np.float32], chosen: BoolArray, window: int, absent: float = -1.0) -> NDArray[np.float32]:
    """Mean of the chosen values in the window around each pixel; `absent` where there are none."""
    share = cv2.blur(chosen.astype(np.float32), (window, window))
    total = cv2.blur(np.where(chosen, values, np.float32(0.0)), (window, window))
    return np.where(share > 1e-4, total / np.maximum(share, np.float32(1e-4)), np.float32(absent))


def _balance(full: Float64Array, empty: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Outline at which full and empty have equal weight, table frame, and the low corner of the fine grid."""
    origin = full.min(axis=0) - _MARGIN
    columns, rows = (int(n) for n in np.ceil((full.max(axis=0) + _MARGIN - origin) / _FINE))
    counted_full, counted_empty = (_counted(samples, origin, rows, columns) for samples in (full, empty))
    # Deep inside, empty points come only from steps of the upper side and do not constrain the outline.
    reach = lambda n: cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * n + 1, 2 * n + 1))  # noqa: E731
    core = cv2.erode(cv2.dilate((counted_full > 0).astype(np.uint8), reach(3)), reach(6)) > 0
    counted_empty[core] = 0.0
    share = np.zeros((rows, columns), dtype=np.float32)
    for spread in (8.0 * _SPREAD, 3.0 * _SPREAD, _SPREAD):
        a, b = (cv2.GaussianBlur(counted, (0, 0), spread / _FINE) for counted in (counted_full, counted_empty))
        known = a + b > 0.02
        share[known] = a[known] / (a + b)[known]
    finer = 4
    fine = cv2.resize(share, None, fx=finer, fy=finer, interpolation=cv2.INTER_LINEAR)
    contours, _ = cv2.findContours((fine > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        raise PerceptionError("The outline of the object cannot be traced: no point of it is full.")
    contour = max(contours, key=cv2.contourArea)
    if len(contour) < 40:  # a square of 2.5 mm
        raise PerceptionError(f"The outline of the object is {len(contour)} points long; it is too small for this camera.")
    pixel = _FINE / finer
    # findContours walks through the centres of the outermost pixels, half a pixel inside the edge.
    outline = _grown(straighten(contour[:, 0].astype(np.float64) * pixel), 0.5 * pixel)
    return origin + outline + 0.5 * pixel, origin


def _counted(samples: Float64Array, origin: Float64Array, rows: int, columns: int) -> NDArray[np.float32]:
    """Samples per cell of the fine grid, each distributed over the four nearest cells."""
    position = (samples - origin) / _FINE - 0.5
    low = np.floor(position).astype(np.int64)
    part = position - low
    counted = np.zeros(rows * columns)
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = low[:, 0] + dx, low[:, 1] + dy
            weight = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            counted += np.bincount((y * columns + x)[inside], weights=weight[inside], minlength=rows * columns)
    return counted.reshape(rows, columns).astype(np.float32)


def _grown(polygon: Float64Array, distance: float) -> Float64Array:
    """Every edge moved outwards by `distance`; counter-clockwise result."""
    if polygon_area(polygon) < 0:
        polygon = polygon[::-1]
    normal = edge_normals(polygon)
    before = np.roll(normal, 1, axis=0)
    # The corner moves along the sum of both normals, at sharp corners by at most twice the distance.
    return polygon + distance * (normal + before) / np.maximum(1.0 + np.sum(normal * before, axis=1, keepdims=True), 0.5)


def _height_grid(points: Float64Array, heights: Float64Array, origin: Float64Array) -> tuple[NDArray[np.float32], Float64Array]:
    """Mean height per cell of twice the fine grid, gaps and surroundings filled from the nearest cell; centre of the first cell."""
    size = 2 * _FINE
    index = np.floor((points - origin) / size).astype(np.int64)
    columns, rows = (int(n) for n in index.max(axis=0) + 1 + int(np.ceil(_MARGIN / size)))
    flat = index[:, 1] * columns + index[:, 0]
    count = np.bincount(flat, minlength=rows * columns)
    total = np.bincount(flat, weights=heights, minlength=rows * columns)
    known = (count > 0).reshape(rows, columns)
    mean = (total / np.maximum(count, 1)).reshape(rows, columns)
    _, nearest = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    level_of = np.zeros(int(nearest.max()) + 1)
    level_of[nearest[known]] = mean[known]
    return level_of[nearest].astype(np.float32), origin + 0.5 * size


@dataclass(frozen=True, slots=True)
class _Straight:
    point: Float64Array
    direction: Float64Array

    def nearest(self, points: Float64Array) -> Float64Array:
        """Feet of the perpendiculars from one point, shape (2,), or several, shape (n, 2)."""
        return np.asarray(self.point + np.multiply.outer((points - self.point) @ self.direction, self.direction))


@dataclass(frozen=True, slots=True)
class _Stretch:
    """A run of contour points between two corners of the coarse outline."""

    points: Float64Array
    line: _Straight | None


def straighten(contour: Float64Array) -> Float64Array:
    """Outline with straight edges where the contour is straight.

    Args:
        contour: closed, dense (points well below a millimetre apart) [m], shape (n, 2); either orientation, kept.

    Returns:
        Polygon, shape (n_vertices, 2), without edges of no length. Where straight edges would cross each other, it follows the contour.
    """
    corners = _simplified(contour, _COARSE)
    if len(corners) < 3:
        return contour[_simplified(contour, _NEAR_CONTOUR)]
    ends = np.append(corners[1:], corners[0] + len(contour))
    inwards = 1.0 if polygon_area(contour) > 0.0 else -1.0
    runs = [np.take(contour, np.arange(a, b + 1), axis=0, mode="wrap") for a, b in zip(corners, ends, strict=True)]
    stretches = _without_chamfers(_merged([_stretch(run, inwards) for run in runs], inwards))
    vertices: list[Float64Array] = []
    for here, following in zip(stretches, stretches[1:] + stretches[:1], strict=True):
        if here.line is None:
            inner = here.points[_open_simplified(here.points)]
            vertices.extend(inner[1:-1])
        vertices.extend(_joint(here, following))
    outline = _with_lengths(np.array(vertices))
    is_simple = len(outline) >= 3 and crossing_edges(outline) is None
    return outline if is_simple else _with_lengths(contour[_simplified(contour, _NEAR_CONTOUR)])


def _with_lengths(outline: Float64Array) -> Float64Array:
    """Without edges of no length, which have no normal: two stretches may end in the same point, or, by rounding, next to it."""
    return np.asarray(outline[np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1) > 1e-6])


def _simplified(contour: Float64Array, tolerance: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Indices of the corners that are kept, ascending."""
    # approxPolyDP returns points, not indices; a unique index is found again by the point itself.
    kept = cv2.approxPolyDP(contour.astype(np.float32)[:, None], tolerance, True)[:, 0]
    index = {tuple(point): number for number, point in enumerate(contour.astype(np.float32).tolist())}
    return np.array(sorted(index[tuple(point)] for point in kept.tolist()), dtype=np.int64)


def _open_simplified(points: Float64Array) -> list[int]:
    """Indices of the corners that are kept of an open run, both ends included, ascending."""
    kept = cv2.approxPolyDP(points.astype(np.float32)[:, None], _NEAR_CONTOUR, False)[:, 0]
    index = {tuple(point): number for number, point in enumerate(points.astype(np.float32).tolist())}
    return sorted({0, len(points) - 1} | {index[tuple(point)] for point in kept.tolist()})


def _stretch(points: Float64Array, inwards: float) -> _Stretch:
    """Fit a line to a run of points of 8 mm or more that is straight. `inwards` is 1 where the inside lies to the left, else -1.

    Its 2.5 mm beside the corners, which tracing rounds off, do not count. Its arc is at most 0.6 mm high, `_COARSE` where it bends inwards:
    an edge traced in two parts at an angle has a dent there, in which a simulated pusher gets caught.
    """
    arc_length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    inner = points[(arc_length >= 0.0025) & (arc_length <= arc_length[-1] - 0.0025)]
    if arc_length[-1] < 0.008 or len(inner) < 5:
        return _Stretch(points, None)
    middle = inner.mean(axis=0)
    direction = np.linalg.svd(inner - middle, full_matrices=False)[2][0]
    direction = direction if direction @ (points[-1] - points[0]) > 0 else -direction
    along = (inner - middle) @ direction
    across = (inner - middle) @ np.array([-direction[1], direction[0]])
    half = 0.5 * float(np.ptp(along))
    bow = inwards * float(np.polyfit(along / half, across, 2)[0])
    return _Stretch(points, _Straight(middle, direction) if -_COARSE <= bow <= 0.0006 else None)


def _merged(stretches: list[_Stretch], inwards: float) -> list[_Stretch]:
    """Join neighbours that form one straight stretch: the coarse outline may break an edge where the contour is noisiest."""
    i = 0
    while len(stretches) > 3 and i < len(stretches):
        here, following = stretches[i], stretches[(i + 1) % len(stretches)]
        joined = _stretch(np.concatenate([here.points, following.points[1:]]), inwards)
        if joined.line is None or np.max(np.linalg.norm(joined.points - joined.line.nearest(joined.points), axis=1)) > _COARSE:
            i += 1
        elif i + 1 < len(stretches):
            stretches = [*stretches[:i], joined, *stretches[i + 2 :]]
        else:
            stretches = [joined, *stretches[1:-1]]
    return stretches


def _without_chamfers(stretches: list[_Stretch]) -> list[_Stretch]:
    """Drop short stretches between two lines whose corner lies beside them: tracing rounded that corner off."""
    n = len(stretches)
    kept = []
    for i, here in enumerate(stretches):
        before, after = stretches[i - 1].line, stretches[(i + 1) % n].line
        corner = _crossing(before, after) if here.line is None and before is not None and after is not None else None
        if corner is None or np.min(np.linalg.norm(here.points - corner, axis=1)) > _RESTORED:
            kept.append(here)
    return kept if len(kept) >= 3 else stretches


def _joint(here: _Stretch, following: _Stretch) -> list[Float64Array]:
    """Vertices where one stretch ends and the next begins."""
    end, begin = here.points[-1], following.points[0]
    if here.line is None and following.line is None:
        return [end]
    if here.line is None or following.line is None:
        line = here.line or following.line
        assert line is not None
        return [line.nearest(end if here.line is not None else begin)]
    corner = _crossing(here.line, following.line)
    if corner is not None and min(np.linalg.norm(corner - end), np.linalg.norm(corner - begin)) <= _RESTORED:
        return [corner]
    return [here.line.nearest(end), following.line.nearest(begin)]


def _crossing(a: _Straight | None, b: _Straight | None) -> Float64Array | None:
    """Where two lines cross; None where they are nearly parallel."""
    if a is None or b is None:
        return None
    return line_crossing(a.point, a.direction, b.point, b.direction)
