"""Candidate objects: connected pixels that stand off the table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.perception.labels import OBJECT, ROBOT, UNKNOWN
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import BoolArray, Float64Array

__all__ = ["Segment", "find_segments"]

_NEAR: Final = 4
"""Pixels within which a robot pixel or the image border counts as touching."""


@dataclass(frozen=True, slots=True)
class Segment:
    """One connected patch of object pixels."""

    rows: slice
    columns: slice
    """Its box in the image."""
    mask: BoolArray
    """Its pixels inside the box."""
    centre: Float64Array
    """Mean of its points [m], shape (2,), table frame."""
    area: float
    """About what it covers, seen from above [m^2]."""
    whole: bool
    """Neither cut by the image border or the workspace, nor beside robot or unknown pixels."""


def find_segments(
    points: NDArray[np.float32], labels: NDArray[np.int8], settings: PerceptionSettings
) -> tuple[list[Segment], dict[str, int]]:
    """Connected components of the object pixels that are large enough, largest first.

    Returns:
        The segments and the counts `object_pixels`, `segments`, `too_small`, `beside_robot_or_cut`.
    """
    n, components, boxes, _ = cv2.connectedComponentsWithStats((labels == OBJECT).astype(np.uint8), connectivity=8)
    counts = {"object_pixels": int(np.count_nonzero(labels == OBJECT)), "segments": 0, "too_small": 0, "beside_robot_or_cut": 0}
    segments = []
    low, high = np.array(settings.workspace_low), np.array(settings.workspace_high)
    height, width = labels.shape
    for index in range(1, n):
        left, top, columns, rows, size = (int(value) for value in boxes[index])
        if size < 12:
            continue
        box = (slice(top, top + rows), slice(left, left + columns))
        mask = components[box] == index
        seen = points[box][mask].astype(np.float64)
        area = _area_from_above(seen)
        if area < settings.min_object_area:
            counts["too_small"] += 1
            continue
        wide = (slice(max(0, top - _NEAR), top + rows + _NEAR), slice(max(0, left - _NEAR), left + columns + _NEAR))
        near = cv2.dilate((components[wide] == index).astype(np.uint8), np.ones((2 * _NEAR + 1, 2 * _NEAR + 1), np.uint8)) > 0
        beside_robot = bool(np.any(near & (labels[wide] == ROBOT)))
        beside_unknown = np.count_nonzero(near & (labels[wide] == UNKNOWN)) > 0.25 * np.count_nonzero(near & (components[wide] != index))
        in_image = top >= _NEAR and left >= _NEAR and top + rows <= height - _NEAR and left + columns <= width - _NEAR
        in_workspace = bool(np.all(seen[:, :2].min(axis=0) > low + 0.004) and np.all(seen[:, :2].max(axis=0) < high - 0.004))
        whole = in_image and in_workspace and not beside_robot and not beside_unknown
        counts["segments"] += 1
        counts["beside_robot_or_cut"] += not whole
        segments.append(Segment(*box, mask, seen[:, :2].mean(axis=0), area, whole))
    return sorted(segments, key=lambda segment: -segment.area), counts


def _area_from_above(points: Float64Array) -> float:
    """Area of the cells of 4 mm that hold points [m^2]: side walls and the density of the pixels count for nothing."""
    return 1.6e-5 * len(np.unique(np.floor(points[:, :2] / 0.004).astype(np.int64) @ np.array([1, 1 << 20])))
