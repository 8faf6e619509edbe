"""Candidate objects: connected pixels above the table, divided into the surfaces of different objects where objects touch.

Two criteria separate objects that touch in the image, both known from the segmentation of convex parts (Stein et al., "Object partitioning
using local convexity", 2014): the depth jumps, or two surfaces meet in a fold, as where a wall rises from a lower object beside it. The
inverse depth of a plane is linear in the image, so the chord between two pixels of one plane passes through the pixel midway between
them, whatever the view; in a fold that pixel lies behind the chord. Objects themselves have steps and folds (the head of a
hammer is higher than its handle), so both count only above a size. Objects of the same height side by side are not separated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import permutations
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from push_ident.geometry.outline import points_in_polygon, signed_distance
from push_ident.perception.frame.view import DEVIATIONS, OBJECT, ROBOT, TABLE, UNKNOWN, FrameView
from push_ident.perception.kernels import grow_surfaces, mark_folds, mark_jumps
from push_ident.perception.known_object import ON_OBJECT, TOP_QUANTILE, Segment, area_from_above
from push_ident.perception.refusals import Reason
from push_ident.types import BoolArray, Float64Array

_NEAR: Final = 4
"""Distance at which a robot pixel or the image border counts as touching [px]."""
_SEES_WALLS: Final = 0.5
"""Sine of the least angle between line of sight and vertical at which walls, and so the lower border of a thing, are seen well [-]: 30
degrees, where a wall covers half as many pixels as from the side."""
_OWN_SHADOW: Final = 1.0 / 3.0
"""Width of the shadow that a step of an object leaves on the object itself over the height of the step [-]: a baseline of a third of the
distance, that of a structured-light scanner near its object; other depth cameras have a tenth or less."""
_SMALLEST_PATCH: Final = 12
"""Patches with fewer pixels are noise."""
_ACROSS: Final = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Directions (rows, columns) in which chords are drawn."""


def find_segments(view: FrameView) -> tuple[list[Segment], dict[str, int]]:
    """Surfaces among the object pixels, largest first.

    Returns:
        The segments, those that cannot be objects included, and the counts `object_pixels` and `segments`, which leaves out the small.
    """
    depth, labels, settings, focal = view.frame.depth, view.labels, view.settings, view.frame.intrinsics.fx
    on_object = labels == OBJECT
    region = _region(on_object)
    surfaces = np.zeros(labels.shape, dtype=np.int32)
    shadowed, bridged = _bridged(depth[region], labels[region], focal, settings.min_step)
    surfaces[region] = _surfaces(bridged, on_object[region] | shadowed, focal, settings.min_step)
    surfaces[region][shadowed] = 0
    surfaces[region] = _divided_by_tops(surfaces[region], view.points[region], focal / _median_depth(depth, surfaces), settings.min_step)
    counts = {"object_pixels": int(np.count_nonzero(on_object)), "segments": 0}
    segments, noise_by_depth = dict[int, Segment](), _noise_by_depth(view)
    for index, box in enumerate(_boxes(surfaces, region), start=1):
        if box is None:
            continue
        mask = surfaces[box] == index
        points = view.points[box][mask].astype(np.float64)
        area = area_from_above(points)
        noise = noise_by_depth * float(np.nanmedian(depth[box][mask])) ** 2
        fault = _no_thing(points, area, settings.min_object_area, noise)
        counts["segments"] += fault is None
        fault = fault or _fault(view, surfaces, index, box, points)
        segments[index] = Segment(*box, mask, points[:, :2].mean(axis=0), area, fault)
    stacked = set[int]()
    for pair in permutations([i for i, one in segments.items() if one.fault not in (Reason.TOO_SMALL, Reason.TOO_LOW)], 2):
        if _carries(view, surfaces, segments, *pair):
            stacked.update(pair)
    for index in stacked:
        if segments[index].whole:
            segments[index] = replace(segments[index], fault=Reason.STACKED)
    return sorted(segments.values(), key=lambda segment: -segment.area), counts


def _noise_by_depth(view: FrameView) -> float:
    """Noise of the height of a point over the square of its depth [1/m], as triangulation has it; `view.noise` is that in the middle of the
    table."""
    of_table = view.frame.depth[::8, ::8][view.labels[::8, ::8] == TABLE]  # one pixel of 64 is enough for a median
    return view.noise / float(np.median(of_table)) ** 2 if len(of_table) else 0.0


def _no_thing(points: Float64Array, area: float, least_area: float, noise: float) -> Reason | None:
    """Why a surface with points (n, 3) and an area [m^2] may be nothing at all, with a noise of heights [m]; None where it is something."""
    if area < least_area:
        return Reason.TOO_SMALL
    return Reason.TOO_LOW if np.nanquantile(points[:, 2], TOP_QUANTILE) < DEVIATIONS * noise else None


def _fault(view: FrameView, surfaces: NDArray[np.int32], index: int, box: tuple[slice, slice], points: Float64Array) -> Reason | None:
    """Why a surface, number `index` in `box` with points (n, 3), is not visible as a whole; None where it is."""
    (rows, columns), labels, settings = box, view.labels, view.settings
    height, width = labels.shape
    if min(rows.start, columns.start) < _NEAR or rows.stop > height - _NEAR or columns.stop > width - _NEAR:
        return Reason.AT_IMAGE_BORDER
    low, high = np.array(settings.workspace_low) + 0.004, np.array(settings.workspace_high) - 0.004  # nearer is cut by it
    if any(points[:, k].min() <= low[k] or points[:, k].max() >= high[k] for k in (0, 1)):
        return Reason.AT_WORKSPACE_BORDER
    reach = _NEAR + int(np.ceil(settings.segments.shadow / _pixel(view, box)))
    wide = (slice(max(0, rows.start - reach), rows.stop + reach), slice(max(0, columns.start - reach), columns.stop + reach))
    inside, others, at = surfaces[wide] == index, surfaces[wide] > 0, labels[wide]
    others &= ~inside
    around = _grown(inside, _NEAR) & ~inside
    if np.any(around & (at == ROBOT)):
        return Reason.BESIDE_ROBOT
    if others.any():
        hiding = others & nearer_than_border(view.frame.depth[wide], inside, settings.min_step)
        across_shadow = others & _grown(with_shadow(inside, at == UNKNOWN, reach), _NEAR)
        is_hidden_across = _has_most_of_one(hiding & across_shadow, np.where(across_shadow, surfaces[wide], 0))
        is_hidden = np.count_nonzero(hiding & around) >= _SMALLEST_PATCH or is_hidden_across
        # What hides it is below its border in the image, too, and hides where it ends.
        not_hiding = others & ~hiding if is_hidden else others
        on_others = np.count_nonzero(around & others) > settings.segments.on_another * np.count_nonzero(around)
        ends_on_another = not is_hidden and (on_others or _ends_where_another_goes_on(view, wide, points, surfaces, index))
        if ends_on_another or _is_above_another(view, wide, points, inside, not_hiding):
            return Reason.STACKED
        if is_hidden:
            return Reason.BEHIND_ANOTHER
    if _beside_unmeasured(view, box, inside, around, at != UNKNOWN):
        return Reason.BESIDE_UNMEASURED
    return None


def _carries(view: FrameView, surfaces: NDArray[np.int32], segments: Mapping[int, Segment], number: int, other_number: int) -> bool:
    """Whether another segment rests on this one: where this one ends, it begins beside it, within its convex outline.

    One that stands behind it, so that it hides its foot, is outside. `surfaces`: of each pixel, shape (height, width).
    """
    segment, other = segments[number], segments[other_number]
    reach = 3 * _NEAR
    if any(one.start >= two.stop + reach or two.start >= one.stop + reach for one, two in zip(segment.box, other.box, strict=True)):
        return False
    box = tuple(slice(max(0, one.start - reach), one.stop + reach) for one in segment.box)
    on_segment, on_other = surfaces[box] == number, surfaces[box] == other_number
    near = on_other & _grown(on_segment, reach)
    if not near.any():
        return False
    contact = view.points[box][near & ~_grown(on_segment, _NEAR)].astype(np.float64)  # nearer, edges are smeared
    ends, step = segment.measured_in(view.points), view.settings.min_step
    top = float(np.quantile(ends[:, 2], TOP_QUANTILE))
    foot = contact[np.abs(contact[:, 2] - top) < step]
    low, high = np.quantile(other.measured_in(view.points)[:, 2], [1.0 - TOP_QUANTILE, TOP_QUANTILE])
    if len(foot) < _SMALLEST_PATCH or high < top + step:
        return False
    outline = cv2.convexHull(ends[:, :2].astype(np.float32))[:, 0].astype(np.float64)
    # One of which a wall reaches the table may stand beside it: noise of walls is less than a step.
    within = ON_OBJECT if low > top - step else step
    return bool(np.count_nonzero(signed_distance(foot[:, :2], outline) < -within) >= _SMALLEST_PATCH)


def _pixel(view: FrameView, box: tuple[slice, slice]) -> float:
    """Width of a pixel at the distance of what is in a box [m]."""
    return float(np.nanmedian(view.frame.depth[box])) / view.frame.intrinsics.fx


def _grown(mask: BoolArray, by: int) -> BoolArray:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1, 2 * by + 1), np.uint8)) > 0)


def with_shadow(inside: BoolArray, unmeasured: BoolArray, reach: int) -> BoolArray:
    """The pixels of a segment, and the unmeasured ones connected with it, up to `reach` pixels away."""
    grown, allowed = inside.astype(np.uint8), (inside | unmeasured).astype(np.uint8)
    for _ in range(reach):
        grown = cv2.dilate(grown, np.ones((3, 3), np.uint8)) & allowed
    return np.asarray(grown > 0)


def _ends_where_another_goes_on(
    view: FrameView, box: tuple[slice, slice], points: Float64Array, surfaces: NDArray[np.int32], index: int
) -> bool:
    """Whether surface number `index`, with points (n, 3), in a box ends above the table where a thing that touches it in the image goes on
    further out. False where the camera looks down so steeply that it sees no walls."""
    inside, others = surfaces[box] == index, (surfaces[box] > 0) & (surfaces[box] != index)
    if np.count_nonzero(points[:, 2] < view.settings.min_step) >= _SMALLEST_PATCH or _downwards(view, points)[1] < _SEES_WALLS:
        return False
    of_touching = np.isin(surfaces[box], surfaces[box][others & _grown(inside, _NEAR)])
    outline = cv2.convexHull(points[:, :2].astype(np.float32))[:, 0].astype(np.float64)
    further_out = ~points_in_polygon(view.points[box][of_touching][:, :2].astype(np.float64), outline)
    return bool(np.count_nonzero(further_out) >= _SMALLEST_PATCH)  # else it may be a foot of its own


def _is_above_another(view: FrameView, box: tuple[slice, slice], points: Float64Array, inside: BoolArray, others: BoolArray) -> bool:
    """Whether other things, rather than the table, are below the lower border of a surface with points (n, 3) in the image. False where the
    camera looks down so steeply that it sees no walls.

    `inside`, `others`: pixels of the surface and of others, of the shape of the box.
    """
    (right, down), sine = _downwards(view, points)
    if sine < _SEES_WALLS:
        return False
    intrinsics = view.frame.intrinsics
    columns, rows = np.rint(_NEAR * np.array([right, down * intrinsics.fy / intrinsics.fx]) / sine).astype(int)
    height, width = inside.shape
    shift = np.array([[1, 0, -columns], [0, 1, -rows]], dtype=np.float32)
    table = view.labels[box] == TABLE
    below_others, below_table = (cv2.warpAffine(mask.astype(np.uint8), shift, (width, height)) > 0 for mask in (others, table))
    return bool(np.count_nonzero(inside & below_others) > np.count_nonzero(inside & below_table))


def _downwards(view: FrameView, points: Float64Array) -> tuple[Float64Array, float]:
    """Where down is in the image at the middle of points (n, 3): displacement across the line of sight for a metre downwards, to the right
    and down, shape (2,), and its length, the sine of the angle between down and the line of sight."""
    camera, middle = view.camera_in_table, np.median(points, axis=0)
    in_camera = (np.array([middle, middle - (0.0, 0.0, 1e-3)]) - camera[:3, 3]) @ camera[:3, :3]
    across = np.diff(in_camera[:, :2] / in_camera[:, 2:], axis=0)[0] * in_camera[0, 2] / 1e-3
    return across, float(np.hypot(*across))


def _beside_unmeasured(view: FrameView, box: tuple[slice, slice], inside: BoolArray, around: BoolArray, measured: BoolArray) -> bool:
    """Whether nothing is measured over a wide strip along much of the border of a segment, so that it may be larger than it seems.

    `inside`, `around`, `measured`: the pixels of the segment, those around it and those that are measured, over its box and more.
    """
    settings = view.settings.segments
    enough = settings.unmeasured * np.count_nonzero(around)
    if np.count_nonzero(around & ~measured) <= enough:
        return False
    # A line of single pixels is the foot of a wall of the segment itself.
    areas = cv2.morphologyEx((measured & ~inside).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    to_others = cv2.distanceTransform(1 - areas, cv2.DIST_L2, 3)
    return bool(np.count_nonzero(around & (to_others * _pixel(view, box) > settings.shadow)) > enough)


def _bridged(depth: NDArray[np.float32], labels: NDArray[np.int8], focal: float, step: float) -> tuple[BoolArray, NDArray[np.float32]]:
    """Unmeasured pixels between object pixels that a step of one object may shadow, and the depth image with the lower surface there.

    An object divided by its own shadow is one patch with them; steps that divide objects still do.
    """
    on_object, unmeasured = (labels == OBJECT).astype(np.uint8), labels == UNKNOWN
    none = np.zeros(labels.shape, dtype=bool)
    if not unmeasured.any() or not on_object.any():
        return none, depth
    width = _OWN_SHADOW * step * focal / float(np.median(depth[on_object > 0]))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(np.ceil(width / 2)) + 1,) * 2)
    between = (cv2.morphologyEx(on_object, cv2.MORPH_CLOSE, kernel) > 0) & unmeasured
    if not between.any():
        return none, depth
    behind = cv2.dilate(np.where(on_object > 0, depth, np.float32(0.0)), kernel)
    return between, np.where(between, behind, depth)


def _median_depth(depth: NDArray[np.float32], surfaces: NDArray[np.int32]) -> float:
    """Median depth of all surfaces [m]; infinite where there are none."""
    return float(np.median(depth[surfaces > 0])) if surfaces.any() else np.inf


def _divided_by_tops(surfaces: NDArray[np.int32], points: NDArray[np.float32], pixels: float, step: float) -> NDArray[np.int32]:
    """The surfaces, divided where their level parts differ in height by more than a step: walls in one plane may join things side by side.

    Args:
        surfaces: numbered from 1 on, 0 for none, shape (rows, columns).
        points: [m], shape (rows, columns, 3), table frame.
        pixels: for a metre across the line of sight [1/m].
        step: height of the smallest step that divides [m].
    """
    # A wall rises by a step within the window, which a wrong unit would make of any size.
    reach = int(np.ceil(min(0.5 * step * pixels, max(surfaces.shape))))
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    divided, count = surfaces.copy(), int(surfaces.max())
    for index, box in enumerate(ndimage.find_objects(surfaces), start=1):
        if box is None:
            continue
        inside = surfaces[box] == index
        heights = cv2.medianBlur(np.where(inside, points[box][..., 2], np.float32(0.0)), 5)
        tops = _tops(inside & (cv2.dilate(heights, window) - cv2.erode(heights, window) < 0.5 * step), heights, step)
        if tops.max() < 2:
            continue
        of_top = _nearest_top(points[box][inside].astype(np.float64), points[box].astype(np.float64), tops, heights, step)
        divided[box][inside] = np.where(of_top == 1, index, count + of_top - 1)
        count += int(tops.max()) - 1
    return divided


def _tops(level: BoolArray, heights: NDArray[np.float32], step: float) -> NDArray[np.int32]:
    """Level parts of a surface, those of about one height with the same number from 1 on, lowest first; 0 elsewhere."""
    parts = _cores(level)
    if parts.max() < 2:
        return parts
    height = (np.bincount(parts.ravel(), heights.ravel()) / np.bincount(parts.ravel()))[1:]
    order = np.argsort(height)
    number = np.zeros(len(height) + 1, dtype=np.int32)
    number[1 + order] = 1 + np.concatenate([[0], np.cumsum(np.diff(height[order]) > step)])
    return number[parts]


def _nearest_top(
    measured: Float64Array, points: Float64Array, tops: NDArray[np.int32], heights: NDArray[np.float32], step: float
) -> NDArray[np.int32]:
    """Number of the top, of those that are not below it, to which each measured point (n, 3) is nearest from above, shape (n,)."""
    numbers = np.arange(1, int(tops.max()) + 1)
    distance = np.stack([cKDTree(points[tops == number][:, :2]).query(measured[:, :2])[0] for number in numbers])
    too_low = np.stack([measured[:, 2] > float(np.median(heights[tops == number])) + 0.5 * step for number in numbers])
    too_low[-1] = False  # the highest
    return np.asarray(numbers[np.argmin(np.where(too_low, np.inf, distance), axis=0)], dtype=np.int32)


def _region(mask: BoolArray) -> tuple[slice, slice]:
    """Rows and columns that hold all pixels of the mask; one pixel where there are none."""
    left, top, columns, rows = cv2.boundingRect(mask.view(np.uint8))
    # OpenCV numbers patches in blocks of 2 x 2 pixels: blocks at even places keep the numbers of the whole image.
    return slice(top - top % 2, top + max(rows, 1)), slice(left - left % 2, left + max(columns, 1))


def _surfaces(depth: NDArray[np.float32], mask: BoolArray, focal: float, step: float) -> NDArray[np.int32]:
    """Number of the surface of each pixel, 0 for none. Connected patches are divided one by one."""
    surfaces = np.zeros(mask.shape, dtype=np.int32)
    n, components, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    count = 0
    for index in range(1, n):
        left, top, columns, rows, size = (int(value) for value in boxes[index])
        if size < _SMALLEST_PATCH:
            continue
        box = (slice(top, top + rows), slice(left, left + columns))
        divided = split_surfaces(depth[box], components[box] == index, focal, step)
        surfaces[box][divided > 0] = count + divided[divided > 0]
        count += int(divided.max())
    return surfaces


def _boxes(surfaces: NDArray[np.int32], region: tuple[slice, slice]) -> list[tuple[slice, slice] | None]:
    """Rows and columns of surface 1, 2, ..., all of which lie in the region; None for one without pixels."""
    top, left = region[0].start, region[1].start
    return [
        None if box is None else (slice(top + box[0].start, top + box[0].stop), slice(left + box[1].start, left + box[1].stop))
        for box in ndimage.find_objects(surfaces[region])
    ]


def nearer_than_border(depth: NDArray[np.float32], inside: BoolArray, step: float) -> BoolArray:
    """Which pixels are nearer to the camera by more than `step` [m] than the border pixel of a segment nearest to them.

    `depth` [m] and `inside`, the pixels of the segment, have shape (rows, columns), as the result.
    """
    _, nearest = cv2.distanceTransformWithLabels((~inside).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    depth_of = np.zeros(int(nearest.max()) + 1, dtype=np.float32)
    depth_of[nearest[inside]] = depth[inside]
    with np.errstate(invalid="ignore"):
        return np.asarray(depth < depth_of[nearest] - step)


def _has_most_of_one(mask: BoolArray, surfaces: NDArray[np.int32]) -> bool:
    """Whether more than half of the pixels of one surface, of those numbered from 1 on, are in the mask."""
    n_pixels = np.bincount(surfaces.ravel())
    n_masked = np.bincount(surfaces[mask], minlength=len(n_pixels))
    return bool(np.any((n_masked[1:] >= _SMALLEST_PATCH) & (2 * n_masked[1:] > n_pixels[1:])))


def split_surfaces(depth: NDArray[np.float32], mask: BoolArray, focal: float, step: float) -> NDArray[np.int32]:
    """Number the surfaces of `mask`, which jumps of depth and folds divide.

    Args:
        depth: [m], shape (rows, columns); NaN where nothing was measured.
        mask: Pixels to divide, same shape.
        focal: Focal length [px].
        step: Height of the smallest step that divides [m].

    Returns:
        1, 2, ... for the surfaces and 0 outside the mask, shape (rows, columns).
    """
    known = np.where(np.isfinite(depth), depth, np.float32(0.0))
    smooth = cv2.medianBlur(known, 5)
    smooth = np.where(mask & (smooth > 0), smooth, known)
    mask = mask & (smooth > 0)
    if not mask.any():
        return np.zeros(mask.shape, dtype=np.int32)
    cut = mark_jumps(smooth, mask, step)
    patches = _cores(mask & ~cut)
    # Half of a chord is 0.8 of each side of a fold of a right angle, across the line of sight; the fold lies half a step behind it.
    leg = 0.8 * step * focal / float(np.median(smooth[mask]))
    folded = _folds(smooth, patches, leg, 0.5 * step)
    surfaces = _cores((patches > 0) & ~(cv2.dilate(folded.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0))
    return np.asarray(grow_surfaces(surfaces, smooth, mask, step))


def _folds(depth: NDArray[np.float32], patches: NDArray[np.int32], leg: float, sag: float) -> BoolArray:
    """Pixels that lie behind a chord whose two ends are on the same patch as the pixel."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = _averaged(np.reciprocal(depth), patches > 0)
    furthest = max(depth.shape)  # a longer chord ends outside; a wrong unit would make one of any length
    lags = [max(2, round(min(leg / float(np.hypot(rows, columns)), furthest))) for rows, columns in _ACROSS]
    legs = tuple((lag * rows, lag * columns) for lag, (rows, columns) in zip(lags, _ACROSS, strict=True))
    return np.asarray(mark_folds(inverse, patches, legs, sag))


def _averaged(values: NDArray[np.float32], mask: BoolArray) -> NDArray[np.float32]:
    """Mean over 3 x 3 pixels of the mask; NaN outside."""
    fraction = cv2.blur(mask.astype(np.float32), (3, 3))
    total = cv2.blur(np.where(mask, values, np.float32(0.0)), (3, 3))
    return np.where(mask, total / np.maximum(fraction, np.float32(0.1)), np.float32(np.nan))


def _cores(mask: BoolArray) -> NDArray[np.int32]:
    """Connected patches of at least 60 pixels of the mask, numbered 1, 2, ...: smaller ones are merged into their neighbours."""
    n, components, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    large = np.flatnonzero(boxes[:, cv2.CC_STAT_AREA] >= 60)
    number = np.zeros(n, dtype=np.int32)
    kept = large[large > 0]
    number[kept] = np.arange(1, len(kept) + 1)
    return number[components]
