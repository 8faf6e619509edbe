"""Candidate objects: connected pixels above the table, divided where objects touch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from push_ident.perception.labels import OBJECT, ROBOT, UNKNOWN
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.surfaces import split_surfaces
from push_ident.types import BoolArray, DepthFrame, Float64Array

__all__ = ["Segment", "find_segments"]

_NEAR: Final = 4
"""Distance at which a robot pixel or the image border counts as touching [px]."""
_UNKNOWN: Final = 0.5
"""Fraction of the surrounding pixels that may be unknown: structured light leaves a shadow along one side of each object."""
_SMALLEST: Final = 12
"""Patches with fewer pixels are noise."""
_COUNTS: Final = ("segments", "too_small", "beside_robot_or_cut", "behind_another")


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
    whole: bool
    """Whether all of it is visible: not cut by the image border or the workspace, not beside robot or unknown pixels, not behind another
    surface."""


def find_segments(
    frame: DepthFrame, points: NDArray[np.float32], labels: NDArray[np.int8], settings: PerceptionSettings
) -> tuple[list[Segment], dict[str, int]]:
    """Surfaces among the object pixels that are large enough, largest first.

    Args:
        frame: The depth image.
        points: Its points [m], shape (height, width, 3), table frame with the plane at z = 0.
        labels: As `label_pixels` returns them.

    Returns:
        The segments and the counts `object_pixels`, `segments`, `too_small`, `beside_robot_or_cut`, `behind_another`.
    """
    on_object = labels == OBJECT
    region = _region(on_object)
    surfaces = np.zeros(labels.shape, dtype=np.int32)
    surfaces[region] = _surfaces(frame.depth[region], on_object[region], frame.intrinsics.fx, settings.min_step)
    counts = {"object_pixels": int(np.count_nonzero(on_object)), **dict.fromkeys(_COUNTS, 0)}
    segments = []
    low, high = np.array(settings.workspace_low), np.array(settings.workspace_high)
    height, width = labels.shape
    for index, box in enumerate(_boxes(surfaces, region), start=1):
        if box is None:
            continue
        mask = surfaces[box] == index
        own_points = points[box][mask].astype(np.float64)
        area = _area_from_above(own_points)
        if area < settings.min_object_area:
            counts["too_small"] += 1
            continue
        rows, columns = box
        wide = (slice(max(0, rows.start - _NEAR), rows.stop + _NEAR), slice(max(0, columns.start - _NEAR), columns.stop + _NEAR))
        own = surfaces[wide] == index
        near = cv2.dilate(own.astype(np.uint8), np.ones((2 * _NEAR + 1, 2 * _NEAR + 1), np.uint8)) > 0
        beside_robot = bool(np.any(near & (labels[wide] == ROBOT)))
        beside_unknown = np.count_nonzero(near & (labels[wide] == UNKNOWN)) > _UNKNOWN * np.count_nonzero(near & ~own)
        behind = _behind_another(frame.depth[wide], own, near & (surfaces[wide] > 0) & ~own, settings.min_step)
        in_image = min(rows.start, columns.start) >= _NEAR and rows.stop <= height - _NEAR and columns.stop <= width - _NEAR
        in_workspace = bool(np.all(own_points[:, :2].min(axis=0) > low + 0.004) and np.all(own_points[:, :2].max(axis=0) < high - 0.004))
        cut = bool(not in_image or not in_workspace or beside_robot or beside_unknown)
        counts["segments"] += 1
        counts["beside_robot_or_cut"] += cut
        counts["behind_another"] += behind and not cut
        segments.append(Segment(*box, mask, own_points[:, :2].mean(axis=0), area, not cut and not behind))
    return sorted(segments, key=lambda segment: -segment.area), counts


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


def _area_from_above(points: Float64Array) -> float:
    """Area of the 4 mm cells that hold points [m^2]; independent of side walls and of the density of the pixels."""
    return 1.6e-5 * len(np.unique(np.floor(points[:, :2] / 0.004).astype(np.int64) @ np.array([1, 1 << 20])))
