"""Whether all of an object moved with it, and what becomes of an object that came apart.

Things that touch are taken in as one object, and so is a thing with another one on it. A push shows it. A pose fit compares the edges of an
object; when one of its parts is pushed, the edges of the larger one may go on fitting. What shows it is the middle: lines of sight that the
upper side at the fitted pose would stop pass it, because the upper side of a rigid object stays whole. Or no pose fits any more.

Such an object gets no pose. It is given up when its parts were taken in, each as a new object with a new id; as long as the parts still
touch, they are refused as several things instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.se2 import rotation
from push_ident.perception.frame.view import FrameView
from push_ident.perception.known_object import ON_OBJECT, THIN, TOP_QUANTILE, NewObject, Placed, Segment, Template, area_from_above
from push_ident.perception.refusals import Reason, Refusal, Removal
from push_ident.perception.tracking.pose_fit import lines_of_sight
from push_ident.types import BoolArray, Float64Array

__all__ = ["Separation", "UpperSide", "compare_upper_side"]

_INSIDE_OUTLINE: Final = 0.005
"""Only lines of sight that pass the top so far inside the outline count [m]: pixels at an edge may show either side of it."""
_BORDER_STRIP: Final = (0.0045, 0.0015)
"""Middle and half width of the strips on both sides of the outline [m]: pixels nearer to the edge cannot contradict a pose."""
_BELOW_UPPER_SIDE: Final = 0.005
"""What is so far below the upper side is not the upper side [m], as in pose fits, and ..."""
_DEVIATIONS: Final = 4.0
"""... so many deviations of a height, as the least height of an object is [-]."""
_VOTE_CELL: Final = 0.004
"""Edge of the cells in which missing area is counted [m]."""
_VOTE_WINDOW: Final = (3, 3)
"""Cells around each in which lines of sight vote: 12 mm, more than the distance of the lines of a camera of 360 px at 1.5 m."""
_TIE: Final = 1e-6
"""Where as many lines pass as are stopped nothing is missing; the mean of votes is exact to this."""
_UPPER_SIDE_STRIDE: Final = 3
"""Of the pixels that are looked at."""
_MISSING: Final = 4e-4
"""Least area that shows that a part is missing [m^2]: below `min_object_area`. Whole objects lack at most 2e-4 along the edges of their
steps (decision 15)."""
_OPEN: Final = (0.1, 0.6)
"""Where no pose fits, a fraction of open border between these shows parts that moved against each other [-]: below, nothing is missing;
above, the object is gone."""
_CROWDED: Final = (0.1, 0.7)
"""A fraction of crowded border between these, with none of it open, shows a thing that touches the object [-]."""
_PARTS_REACH: Final = 2.0
"""The parts of an object are looked for within so many times its radius from where it was lost [-]."""
_TOGETHER: Final = (0.75, 1.4)
"""Area of parts that still touch, relative to that of the object [-]: one may stand on the other in part."""
_APART: Final = (0.8, 1.25)
"""Area of the separate parts together, relative to that of the object [-]."""
_SAME_HEIGHT: Final = 0.01
"""Largest difference of the heights of an object and of its parts [m]: a tipped object differs by more."""
_SAME_POSITION: Final = 0.01
"""A position so near to a point of a segment lies on it [m]."""
_RAISED: Final = 0.005
"""Points so far above the upper side of an object are not on it [m]: three times the noise of a height."""


@dataclass(frozen=True, slots=True)
class UpperSide:
    """What is there, and not there, of the upper side of an object at a pose."""

    missing: float
    """Area of the upper side that is not there [m^2]."""
    height: float
    """Median height of what is measured there instead [m]; NaN where nothing is missing."""
    open_border: float
    """Fraction of the lines of sight just inside the outline that pass [-]."""
    crowded_border: float
    """Fraction of those just outside that are stopped, as by another thing that touches the object [-]."""

    @property
    def is_part_missing(self) -> bool:
        """Whether so much of an object is not where it should be that it is not one rigid thing, or not at this pose."""
        return self.missing > _MISSING


def compare_upper_side(template: Template, view: FrameView, pose: Float64Array, others: Sequence[Placed] = ()) -> UpperSide:
    """Compare the upper side of an object with the lines of sight at a pose (x, y, yaw) [m, m, rad], table frame.

    Hidden spots, and those where something higher is measured, count neither as there nor as missing.

    Args:
        others: Other known objects; their pixels are left out.
    """
    lines = lines_of_sight(template, view, pose, template.radius, _UPPER_SIDE_STRIDE, others)
    if lines is None:
        return UpperSide(0.0, np.nan, 0.0, 0.0)
    positions, passed = lines.innermost_points(template, pose), lines.stopped < 0.5
    distance = template.nearest_distance(positions)
    at_border = np.abs(np.abs(distance) - _BORDER_STRIP[0]) < _BORDER_STRIP[1]
    is_open, is_crowded = _share(passed[at_border & (distance < 0)]), _share(~passed[at_border & (distance > 0)])
    inside = distance < -_INSIDE_OUTLINE
    positions, height = positions[inside], lines.height[inside]
    passed = height < template.least_top(positions) - max(_BELOW_UPPER_SIDE, _DEVIATIONS * view.noise)
    n = int(np.ceil(2.0 * template.radius / _VOTE_CELL)) + 1
    cell = np.floor((positions + template.radius) / _VOTE_CELL).astype(np.int64) @ np.array([1, n])
    votes = np.bincount(cell, weights=np.where(passed, 1.0, -1.0), minlength=n * n).reshape(n, n)
    missing = cv2.blur(votes, _VOTE_WINDOW, borderType=cv2.BORDER_CONSTANT) > _TIE
    below = height[missing.ravel()[cell] & passed]
    return UpperSide(
        float(np.count_nonzero(missing)) * _VOTE_CELL**2, float(np.median(below)) if len(below) else np.nan, is_open, is_crowded
    )


def _share(values: BoolArray) -> float:
    return float(np.mean(values)) if len(values) else 0.0


@dataclass(slots=True)
class _Suspect:
    """An object that no pose fits, or of which a part is missing."""

    placed: Placed
    """At its latest pose as a whole."""
    area: float
    """Of its segment [m^2]."""
    reason: Reason | None = None
    """Why it is several things; None while there is no proof."""
    parts: dict[str, float] = field(default_factory=dict)
    """Areas of the objects taken in near it since [m^2]."""
    n_refused: int = 0
    """Searches in which its parts touched."""
    n_empty: int = 0
    """Searches in a row without anything near it."""
    given_up: bool = False

    def is_near(self, position: Float64Array) -> bool:
        template, pose = self.placed
        return bool(np.linalg.norm(position[:2] - pose[:2]) < _PARTS_REACH * template.radius)

    def is_apart(self, n_more: int = 0, more: float = 0.0) -> bool:
        """Whether the parts taken in, and as many more with that area [m^2], are separate and all of it."""
        total = more + sum(self.parts.values())
        return n_more + len(self.parts) > 1 and _APART[0] * self.area < total < _APART[1] * self.area

    @property
    def height(self) -> float:
        return self.placed[0].top_range[1]


@dataclass(slots=True)
class Separation:
    """The objects that are lost and may have come apart."""

    _suspects: dict[str, _Suspect] = field(default_factory=dict)

    def clear(self, object_id: str) -> None:
        """The object is whole, and where its pose says."""
        self._suspects.pop(object_id, None)

    def suspect(self, object_id: str, placed: Placed, area: float, upper_side: UpperSide) -> None:
        """No pose fits the object, or a part of it is missing.

        Args:
            placed: The object at its latest pose.
            area: Of its segment when it was taken in [m^2].
            upper_side: At the pose that fits best.
        """
        suspect = self._suspects.setdefault(object_id, _Suspect(placed, area))
        if upper_side.open_border > _OPEN[1]:
            return
        if upper_side.is_part_missing:
            suspect.reason = Reason.STACKED if upper_side.height > 0.5 * placed[0].top_range[0] else Reason.TOUCHING
        elif suspect.reason in (None, Reason.TOUCHES_KNOWN):
            if upper_side.open_border > _OPEN[0]:
                suspect.reason = Reason.TOUCHING
            elif _CROWDED[0] < upper_side.crowded_border < _CROWDED[1]:
                suspect.reason = Reason.TOUCHES_KNOWN

    def refuse_parts(
        self, segments: Sequence[Segment], points: NDArray[np.float32], rest_frames: int
    ) -> tuple[list[Segment], list[Refusal], list[Removal]]:
        """Take out the segments that are parts that still touch.

        Args:
            segments: Those that no known object explains.
            points: Of the frame [m], shape (height, width, 3), table frame.
            rest_frames: An object is given up when its parts touched in so many searches.

        Returns:
            The other segments, the refusals, and the objects that are given up.
        """
        refused: list[Refusal] = []
        removed: list[Removal] = []
        for name, suspect in list(self._suspects.items()):
            if suspect.reason is None:
                continue
            near = [segment for segment in segments if suspect.is_near(segment.centre) and segment.fault is not Reason.TOO_SMALL]
            if not near:
                self._note_empty(name, suspect, rest_frames)
                continue
            suspect.n_empty = 0
            if suspect.reason is Reason.TOUCHES_KNOWN:
                touching = [segment for segment in near if segment.whole and _covers(segment, points, suspect.placed[1])]
            elif suspect.is_apart(len(near), sum(segment.area for segment in near)):
                continue
            else:
                touching = [segment for segment in near if segment.whole and _is_all_parts(suspect, segment, points)]
                suspect.n_refused += len(touching)
            refused += [segment.refusal(points, suspect.reason) for segment in touching]
            segments = [segment for segment in segments if not any(segment is other for other in touching)]
            if suspect.n_refused >= rest_frames and not suspect.given_up:
                suspect.given_up = True
                removed.append(Removal(name, suspect.reason))
        return list(segments), refused, removed

    def replace_by(self, new: Mapping[str, NewObject]) -> list[Removal]:
        """New objects were taken in; the objects of which they are parts are given up."""
        removed = []
        for name, suspect in list(self._suspects.items()):
            suspect.parts |= {part: thing.area for part, thing in new.items() if _is_part(suspect, thing)}
            came_apart = suspect.reason is not None and suspect.reason is not Reason.TOUCHES_KNOWN
            if suspect.is_apart() or (suspect.parts and came_apart):
                del self._suspects[name]
                if not suspect.given_up:
                    removed.append(Removal(name, suspect.reason if suspect.reason is Reason.STACKED else Reason.TOUCHING))
        return removed

    def _note_empty(self, name: str, suspect: _Suspect, rest_frames: int) -> None:
        """Nothing is where the object was lost: after a while what comes there later is something else."""
        suspect.n_empty += 1
        if suspect.n_empty < rest_frames:
            return
        if suspect.given_up:
            del self._suspects[name]
        else:
            suspect.reason = None


def _is_all_parts(suspect: _Suspect, segment: Segment, points: NDArray[np.float32]) -> bool:
    """Whether a segment is all parts of an object, of which one moved."""
    low, high = (share * suspect.area for share in _TOGETHER)
    if not low < segment.area < high:
        return False
    heights = segment.points_in(points)[:, 2]
    same_height = abs(float(np.quantile(heights, TOP_QUANTILE)) - suspect.height) < _SAME_HEIGHT
    # What is left of the object when a part was taken away lies within its outline.
    return same_height and _area_beyond(segment, points, suspect.placed) > _MISSING


def _area_beyond(segment: Segment, points: NDArray[np.float32], placed: Placed) -> float:
    """Area of a segment outside the outline of an object at a pose, or higher than the object is there [m^2]."""
    template, pose = placed
    box_points = points[segment.rows, segment.columns]
    in_object = ((box_points[..., :2].reshape(-1, 2) - pose[:2]) @ rotation(pose[2])).astype(np.float64)
    outside = template.nearest_distance(in_object) > ON_OBJECT
    raised = box_points[..., 2].ravel() > template.nearest_top(in_object) + _RAISED
    beyond = (outside | raised).reshape(segment.mask.shape) & segment.mask
    beyond = cv2.morphologyEx(beyond.astype(np.uint8), cv2.MORPH_OPEN, THIN) > 0
    return area_from_above(box_points[beyond].astype(np.float64))


def _is_part(suspect: _Suspect, thing: NewObject) -> bool:
    """Whether a new object may be a part of an object."""
    lower = float(thing.traced.top.max()) < suspect.height + _SAME_HEIGHT
    return lower and thing.area < _APART[1] * suspect.area and suspect.is_near(thing.traced.pose)


def _covers(segment: Segment, points: NDArray[np.float32], position: Float64Array) -> bool:
    """Whether a position (x, y) [m] lies on a segment."""
    on_segment = segment.points_in(points)[:, :2]
    return bool(np.min(np.hypot(*(on_segment - position[:2]).T)) < _SAME_POSITION)
