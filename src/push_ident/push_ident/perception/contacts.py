"""Which segments the known objects explain, and what of a segment does not belong to the known object that it touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.se2 import rotation
from push_ident.perception.refusals import Reason
from push_ident.perception.segments import Segment, area_from_above
from push_ident.perception.tracking import Template
from push_ident.types import BoolArray, Float64Array

__all__ = ["area_beyond", "unexplained_segments"]

_ON_OBJECT: Final = 0.008
"""Points within this distance of the outline of an object belong to it [m]."""
_EXPLAINED: Final = 0.1
"""A segment of which less lies on known objects is a thing of its own: things that stand close may overlap at their walls [-]."""
_THIN: Final = np.ones((5, 5), np.uint8)
"""Pixels in strips thinner than this are the smeared border of a known object [px]."""
_RAISED: Final = 0.005
"""Points so far above the upper side of an object are not on it [m]: three times the noise of a height."""

Placed = tuple[Template, Float64Array]
"""A known object and its pose (x, y, yaw) [m, m, rad], table frame."""


def unexplained_segments(
    segments: Sequence[Segment], points: NDArray[np.float32], known: Sequence[Placed], least_area: float
) -> list[Segment]:
    """The segments that are no known object, with the rest of those that only in part are known ones.

    Args:
        points: Of the frame [m], shape (height, width, 3), table frame.
        known: The objects that are tracked.
        least_area: A smaller rest is the border of a known object [m^2].

    Returns:
        Segments in the same order. A rest has the fault TOUCHES_KNOWN: where it ends beside the known object cannot be seen.
    """
    found = []
    for segment in segments:
        own = _on_known(points[segment.rows, segment.columns], segment.mask, known)
        if np.count_nonzero(own) < _EXPLAINED * np.count_nonzero(segment.mask):
            found.append(segment)
            continue
        rest = cv2.morphologyEx((segment.mask & ~own).astype(np.uint8), cv2.MORPH_OPEN, _THIN) > 0
        at = points[segment.rows, segment.columns][rest].astype(np.float64)
        area = area_from_above(at) if len(at) else 0.0
        if area >= least_area:
            fault = Reason.TOUCHES_KNOWN if segment.whole else segment.fault
            found.append(replace(segment, mask=rest, centre=at[:, :2].mean(axis=0), area=area, fault=fault))
    return found


def area_beyond(segment: Segment, points: NDArray[np.float32], known: Placed) -> float:
    """Area of a segment outside the outline of an object at a pose, or higher than the object is there [m^2]."""
    template, pose = known
    own = points[segment.rows, segment.columns]
    in_object = ((own[..., :2].reshape(-1, 2) - pose[:2]) @ rotation(pose[2])).astype(np.float64)
    outside = template.nearest_distance(in_object) > _ON_OBJECT
    raised = own[..., 2].ravel() > template.nearest_top(in_object) + _RAISED
    beyond = (outside | raised).reshape(segment.mask.shape) & segment.mask
    beyond = cv2.morphologyEx(beyond.astype(np.uint8), cv2.MORPH_OPEN, _THIN) > 0
    at = own[beyond].astype(np.float64)
    return area_from_above(at) if len(at) else 0.0


def _on_known(points: NDArray[np.float32], mask: BoolArray, known: Sequence[Placed]) -> BoolArray:
    """Which pixels of `mask` lie on one of the known objects; points [m], shape (*mask.shape, 3)."""
    own = points[mask][:, :2]
    on_one = np.zeros(len(own), dtype=bool)
    for template, pose in known:
        on_one |= template.nearest_distance((own - pose[:2]) @ rotation(pose[2])) < _ON_OBJECT
    result = np.zeros(mask.shape, dtype=bool)
    result[mask] = on_one
    return result
