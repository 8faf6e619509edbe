"""Whether all of an object moved with it: the upper side of a rigid object stays whole.

A pose fit compares the edges of an object. Things that touch are taken in as one; when one of them is pushed, the edges of the larger
one may go on fitting. What shows it is the middle: lines of sight that the upper side at the fitted pose would stop pass it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from push_ident.perception.tracking import Scene, Template, lines_of_sight
from push_ident.types import BoolArray, Float64Array

__all__ = ["PartsSeen", "parts_seen"]

_INSIDE: Final = 0.005
"""Only lines of sight that pass the top so far inside the outline count [m]: pixels at an edge may show either side of it."""
_BORDER: Final = (0.0045, 0.0015)
"""Middle and half width of the strips on both sides of the outline [m]: pixels nearer to the edge cannot contradict a pose."""
_BELOW: Final = 0.005
"""What is so far below the upper side is not the upper side [m], as in pose fits, and ..."""
_DEVIATIONS: Final = 4.0
"""... so many deviations of a height, as the least height of an object is [-]."""
_CELL: Final = 0.004
"""Edge of the cells in which missing area is counted [m]."""
_WINDOW: Final = (3, 3)
"""Cells around each in which lines of sight vote: 12 mm, more than the distance of the lines of a camera of 360 px at 1.5 m."""
_TIE: Final = 1e-6
"""Where as many lines pass as are stopped nothing is missing; the mean of votes is exact to this."""
_STRIDE: Final = 3
"""Of the pixels that are looked at."""


@dataclass(frozen=True, slots=True)
class PartsSeen:
    """What is there, and not there, of the upper side of an object at a pose."""

    missing: float
    """Area of the upper side that is not there [m^2]."""
    height: float
    """Median height of what is seen in its place [m]; NaN where nothing is missing."""
    open_border: float
    """Fraction of the lines of sight just inside the outline that pass [-]."""
    crowded_border: float
    """Fraction of those just outside that are stopped, as by another thing that touches the object [-]."""


def parts_seen(template: Template, scene: Scene, pose: Float64Array, noise: float) -> PartsSeen:
    """Compare the upper side of an object with the lines of sight at a pose (x, y, yaw) [m, m, rad], table frame.

    `noise`: standard deviation of a height [m].

    Hidden places, and those where something higher is measured, count neither as there nor as missing.

    Raises:
        FrameError: The size of the image differs from its camera info.
    """
    lines = lines_of_sight(template, scene, pose, template.radius, _STRIDE)
    if lines is None:
        return PartsSeen(0.0, np.nan, 0.0, 0.0)
    places, passed = lines.innermost_points(template, pose), lines.stopped < 0.5
    distance = template.nearest_distance(places)
    beside = np.abs(np.abs(distance) - _BORDER[0]) < _BORDER[1]
    is_open, is_crowded = _share(passed[beside & (distance < 0)]), _share(~passed[beside & (distance > 0)])
    inside = distance < -_INSIDE
    places, height = places[inside], lines.height[inside]
    passed = height < template.least_top(places) - max(_BELOW, _DEVIATIONS * noise)
    n = int(np.ceil(2.0 * template.radius / _CELL)) + 1
    cell = np.floor((places + template.radius) / _CELL).astype(np.int64) @ np.array([1, n])
    votes = np.bincount(cell, weights=np.where(passed, 1.0, -1.0), minlength=n * n).reshape(n, n)
    missing = cv2.blur(votes, _WINDOW, borderType=cv2.BORDER_CONSTANT) > _TIE
    seen = height[missing.ravel()[cell] & passed]
    return PartsSeen(float(np.count_nonzero(missing)) * _CELL**2, float(np.median(seen)) if len(seen) else np.nan, is_open, is_crowded)


def _share(values: BoolArray) -> float:
    return float(np.mean(values)) if len(values) else 0.0
