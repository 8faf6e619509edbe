"""Candidate objects: connected pixels above the table, divided where objects touch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from push_ident.perception.labels import OBJECT, ROBOT, UNKNOWN
from push_ident.perception.refusals import Reason
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.surfaces import split_surfaces
from push_ident.types import BoolArray, DepthFrame, Float64Array

__all__ = ["Segment", "area_from_above", "find_segments"]

_NEAR: Final = 4
"""Distance at which a robot pixel or the image border counts as touching [px]."""
_SHADOW: Final = 0.05
"""Width up to which unmeasured pixels may surround an object [m]: the shadow that the projector or the second imager of a depth camera
leaves is baseline * height / (distance - height), 5 cm for an object of 0.4 m seen from 1 m at a baseline of 75 mm."""
_OWN_SHADOW: Final = 1.0 / 3.0
"""Width of the shadow that a step of an object leaves on the object itself over the height of the step [-]: a baseline of a third of the
distance, that of a structured-light scanner near its object; other depth cameras have a tenth or less."""
_UNMEASURED: Final = 0.15
"""Largest fraction of the surrounding pixels beside which nothing is measured for further than that: half of one of four sides."""
_ON_ANOTHER: Final = 0.6
"""Fraction of the surrounding pixels that show other things from which something stands on one of them: things beside it are on one side,
in a corner on two of four."""
_SKIRT: Final = 0.004
"""Distance from the border of the workspace at which a segment counts as cut by it [m]."""
_SMALLEST: Final = 12
"""Patches with fewer pixels are noise."""


@dataclass(frozen=True, slots=True)
class Segment:
    """One connected patch of object pixels."""

    rows: slice
    columns: slice
    """Its box in the image."""
    mask: BoolArray
    """Its pixels in the box."""
    centre: Float64Array
    """Mean of its points [m], shape (2,), table frame."""
    area: float
    """Approximate area that it covers on the table [m^2]."""
    fault: Reason | None
    """Why it cannot be an object as it is seen; None where all of it is visible."""

    @property
    def whole(self) -> bool:
        """Whether all of it is visible."""
        return self.fault is None


def find_segments(
    frame: DepthFrame, points: NDArray[np.float32], labels: NDArray[np.int8], settings: PerceptionSettings
) -> tuple[list[Segment], dict[str, int]]:
    """Surfaces among the object pixels, largest first.

    Args:
        frame: The depth image.
        points: Its points [m], shape (height, width, 3), table frame with the plane at z = 0.
        labels: As `label_pixels` returns them.

    Returns:
        The segments, those that cannot be objects included, and the counts `object_pixels` and `segments`, which leaves out the small.
    """
    on_object = labels == OBJECT
    region = _region(on_object)
    surfaces = np.zeros(labels.shape, dtype=np.int32)
    shadowed, depth = _bridged(frame.depth[region], labels[region], frame.intrinsics.fx, settings.min_step)
    surfaces[region] = _surfaces(depth, on_object[region] | shadowed, frame.intrinsics.fx, settings.min_step)
    surfaces[region][shadowed] = 0
    counts = {"object_pixels": int(np.count_nonzero(on_object)), "segments": 0}
    segments = []
    for index, box in enumerate(_boxes(surfaces, region), start=1):
        if box is None:
            continue
        mask = surfaces[box] == index
        own_points = points[box][mask].astype(np.float64)
        area = area_from_above(own_points)
        small = area < settings.min_object_area
        fault = Reason.TOO_SMALL if small else _fault(frame, labels, surfaces, index, box, own_points, settings)
        counts["segments"] += not small
        segments.append(Segment(*box, mask, own_points[:, :2].mean(axis=0), area, fault))
    return sorted(segments, key=lambda segment: -segment.area), counts


def _fault(
    frame: DepthFrame,
    labels: NDArray[np.int8],
    surfaces: NDArray[np.int32],
    index: int,
    box: tuple[slice, slice],
    own_points: Float64Array,
    settings: PerceptionSettings,
) -> Reason | None:
    """Why a surface, number `index` in `box` with points (n, 3), is not visible as a whole; None where it is."""
    rows, columns = box
    height, width = labels.shape
    if min(rows.start, columns.start) < _NEAR or rows.stop > height - _NEAR or columns.stop > width - _NEAR:
        return Reason.AT_IMAGE_BORDER
    low, high = np.array(settings.workspace_low) + _SKIRT, np.array(settings.workspace_high) - _SKIRT
    if any(own_points[:, k].min() <= low[k] or own_points[:, k].max() >= high[k] for k in (0, 1)):
        return Reason.AT_WORKSPACE_BORDER
    wide = (slice(max(0, rows.start - _NEAR), rows.stop + _NEAR), slice(max(0, columns.start - _NEAR), columns.stop + _NEAR))
    own = surfaces[wide] == index
    near = cv2.dilate(own.astype(np.uint8), np.ones((2 * _NEAR + 1, 2 * _NEAR + 1), np.uint8)) > 0
    if np.any(near & (labels[wide] == ROBOT)):
        return Reason.BESIDE_ROBOT
    if _behind_another(frame.depth[wide], own, near & (surfaces[wide] > 0) & ~own, settings.min_step):
        return Reason.BEHIND_ANOTHER
    around = near & ~own
    if np.count_nonzero(around & (surfaces[wide] > 0)) > _ON_ANOTHER * np.count_nonzero(around):
        return Reason.STACKED
    if _beside_unmeasured(frame, labels, box, own, near & ~own):
        return Reason.BESIDE_UNMEASURED
    return None


def _beside_unmeasured(frame: DepthFrame, labels: NDArray[np.int8], box: tuple[slice, slice], own: BoolArray, around: BoolArray) -> bool:
    """Whether nothing is measured over a wide strip along much of the border of a segment, so that it may be larger than it seems.

    `own`, `around`: the pixels of the segment and those around it, over its box grown by `_NEAR`.
    """
    enough = _UNMEASURED * np.count_nonzero(around)
    rows, columns = box
    pixel = float(np.nanmedian(frame.depth[box])) / frame.intrinsics.fx
    reach = _NEAR + int(np.ceil(_SHADOW / pixel))
    wide = (slice(max(0, rows.start - reach), rows.stop + reach), slice(max(0, columns.start - reach), columns.stop + reach))
    top, left = rows.start - _NEAR - wide[0].start, columns.start - _NEAR - wide[1].start
    inner = (slice(top, top + own.shape[0]), slice(left, left + own.shape[1]))
    others = labels[wide] != UNKNOWN
    if np.count_nonzero(around & ~others[inner]) <= enough:
        return False
    others[inner] &= ~own
    # A line of single pixels is the foot of a wall of the segment itself.
    areas = cv2.morphologyEx(others.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    to_others = cv2.distanceTransform(1 - areas, cv2.DIST_L2, 3)[inner]
    return bool(np.count_nonzero(around & (to_others * pixel > _SHADOW)) > enough)


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
        if size < _SMALLEST:
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


def _behind_another(depth: NDArray[np.float32], own: BoolArray, others: BoolArray, step: float) -> bool:
    """Whether another surface beside this one is nearer to the camera by more than a step and so may hide part of it."""
    if np.count_nonzero(others) < _SMALLEST:
        return False
    distance, nearest = cv2.distanceTransformWithLabels((~own).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    depth_of = np.zeros(int(nearest.max()) + 1, dtype=np.float32)
    depth_of[nearest[own]] = depth[own]
    with np.errstate(invalid="ignore"):
        hides = others & (distance <= _NEAR) & (depth < depth_of[nearest] - step)
    return bool(np.count_nonzero(hides) >= _SMALLEST)


def area_from_above(points: Float64Array) -> float:
    """Area of the 4 mm cells that hold points [m^2]; independent of side walls and of the density of the pixels."""
    return 1.6e-5 * len(np.unique(np.floor(points[:, :2] / 0.004).astype(np.int64) @ np.array([1, 1 << 20])))
