"""Objects that came apart, and what becomes of their parts.

Things that touch are taken in as one object, and so is a thing with another one on it. A push shows it: a part of the object is gone from
its place (`parts.parts_seen`), or no pose fits any more. Such an object gets no pose. It is given up when its parts were taken in, each
as a new object with a new id; as long as the parts still touch, they are refused as several things instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.perception.contacts import Placed, area_beyond
from push_ident.perception.parts import PartsSeen
from push_ident.perception.refusals import Reason, Refusal, Removal
from push_ident.perception.registration import NewObject, refusal_of
from push_ident.perception.segments import Segment
from push_ident.perception.tracking import Template
from push_ident.types import Float64Array

__all__ = ["Parting", "is_part_missing"]

_MISSING: Final = 4e-4
"""Least area that shows that a part is missing [m^2]: below `min_object_area`. Whole objects lack at most 2e-4 along the edges of their
steps (decision 15)."""
_OPEN: Final = (0.1, 0.6)
"""Where no pose fits, a fraction of open border between these shows parts that moved against each other [-]: below, nothing is missing;
above, the object is gone."""
_CROWDED: Final = (0.1, 0.7)
"""A fraction of crowded border between these, with none of it open, shows a thing that touches the object [-]."""
_REACH: Final = 2.0
"""The parts of an object are looked for within so many times its radius from where it was lost [-]."""
_TOGETHER: Final = (0.75, 1.4)
"""Area of parts that still touch, relative to that of the object [-]: one may stand on the other in part."""
_APART: Final = (0.8, 1.25)
"""Area of the separate parts together, relative to that of the object [-]."""
_SAME_HEIGHT: Final = 0.01
"""Largest difference of the heights of an object and of its parts [m]: a tipped object differs by more."""
_TOP: Final = 0.98
"""Quantile of the heights of a segment that is its height [-]: single pixels are outliers."""
_SAME_PLACE: Final = 0.01
"""A place so near to a point of a segment lies on it [m]."""


def is_part_missing(seen: PartsSeen) -> bool:
    """Whether so much of an object is not where it should be that it is not one rigid thing, or not at this pose."""
    return seen.missing > _MISSING


@dataclass(slots=True)
class _Lost:
    """An object that no pose fits, or of which a part is missing."""

    placed: Placed
    """Where it was last as a whole."""
    area: float
    """Of its segment [m^2]."""
    reason: Reason | None = None
    """Why it is several things; None while there is no proof."""
    parts: dict[str, float] = field(default_factory=dict)
    """Areas of the objects taken in near it since [m^2]."""
    n_refused: int = 0
    """Searches in which its parts were seen to touch."""
    n_unseen: int = 0
    """Searches in a row without anything near it."""
    given_up: bool = False

    def is_near(self, place: Float64Array) -> bool:
        template, pose = self.placed
        return bool(np.linalg.norm(place[:2] - pose[:2]) < _REACH * template.radius)

    def is_apart(self, n_more: int = 0, more: float = 0.0) -> bool:
        """Whether the parts taken in, and as many more with that area [m^2], are separate and all of it."""
        total = more + sum(self.parts.values())
        return n_more + len(self.parts) > 1 and _APART[0] * self.area < total < _APART[1] * self.area

    @property
    def height(self) -> float:
        return self.placed[0].top_range[1]


@dataclass(slots=True)
class Parting:
    """The objects that are lost and may have come apart."""

    _lost: dict[str, _Lost] = field(default_factory=dict)

    def found(self, object_id: str) -> None:
        """The object is whole, and where its pose says."""
        self._lost.pop(object_id, None)

    def lost(self, object_id: str, template: Template, pose: Float64Array, area: float, seen: PartsSeen) -> None:
        """No pose fits the object, whose latest one was `pose` (x, y, yaw) [m, m, rad]; or a part of it is missing.

        Args:
            area: Of its segment when it was taken in [m^2].
            seen: Of the object at the best pose.
        """
        lost = self._lost.setdefault(object_id, _Lost((template, pose), area))
        if seen.open_border > _OPEN[1]:
            return
        if is_part_missing(seen):
            lost.reason = Reason.STACKED if seen.height > 0.5 * template.top_range[0] else Reason.TOUCHING
        elif lost.reason in (None, Reason.TOUCHES_KNOWN):
            if seen.open_border > _OPEN[0]:
                lost.reason = Reason.TOUCHING
            elif _CROWDED[0] < seen.crowded_border < _CROWDED[1]:
                lost.reason = Reason.TOUCHES_KNOWN

    def refuse(
        self, segments: Sequence[Segment], points: NDArray[np.float32], rest_frames: int
    ) -> tuple[list[Segment], list[Refusal], list[Removal]]:
        """Take out the segments that are parts that still touch.

        Args:
            segments: Those that no known object explains.
            points: Of the frame [m], shape (height, width, 3), table frame.
            rest_frames: An object is given up when its parts were seen to touch in so many searches.

        Returns:
            The other segments, the refusals, and the objects that are given up.
        """
        refused: list[Refusal] = []
        removed: list[Removal] = []
        for name, lost in list(self._lost.items()):
            if lost.reason is None:
                continue
            near = [segment for segment in segments if lost.is_near(segment.centre) and segment.fault is not Reason.TOO_SMALL]
            if not near:
                self._not_seen(name, lost, rest_frames)
                continue
            lost.n_unseen = 0
            if lost.reason is Reason.TOUCHES_KNOWN:
                touching = [segment for segment in near if segment.whole and _holds(segment, points, lost.placed[1])]
            elif lost.is_apart(len(near), sum(segment.area for segment in near)):
                continue
            else:
                touching = [segment for segment in near if segment.whole and _is_together(lost, segment, points)]
                lost.n_refused += len(touching)
            refused += [refusal_of(segment, points, lost.reason) for segment in touching]
            segments = [segment for segment in segments if not any(segment is other for other in touching)]
            if lost.n_refused >= rest_frames and not lost.given_up:
                lost.given_up = True
                removed.append(Removal(name, lost.reason))
        return list(segments), refused, removed

    def taken_in(self, new: Mapping[str, NewObject]) -> list[Removal]:
        """New objects; the objects of which they are parts are given up."""
        removed = []
        for name, lost in list(self._lost.items()):
            lost.parts |= {own: thing.area for own, thing in new.items() if _is_part(lost, thing)}
            came_apart = lost.reason is not None and lost.reason is not Reason.TOUCHES_KNOWN
            if lost.is_apart() or (lost.parts and came_apart):
                del self._lost[name]
                if not lost.given_up:
                    removed.append(Removal(name, lost.reason if lost.reason is Reason.STACKED else Reason.TOUCHING))
        return removed

    def _not_seen(self, name: str, lost: _Lost, rest_frames: int) -> None:
        """Nothing is where the object was lost: after a while what comes there later is something else."""
        lost.n_unseen += 1
        if lost.n_unseen < rest_frames:
            return
        if lost.given_up:
            del self._lost[name]
        else:
            lost.reason = None


def _is_together(lost: _Lost, segment: Segment, points: NDArray[np.float32]) -> bool:
    """Whether a segment is all parts of an object, of which one moved."""
    low, high = (share * lost.area for share in _TOGETHER)
    if not low < segment.area < high:
        return False
    heights = points[segment.rows, segment.columns][segment.mask][:, 2]
    same_height = abs(float(np.quantile(heights, _TOP)) - lost.height) < _SAME_HEIGHT
    # What is left of the object when a part was taken away lies within its outline.
    return same_height and area_beyond(segment, points, lost.placed) > _MISSING


def _is_part(lost: _Lost, thing: NewObject) -> bool:
    """Whether a new object may be a part of an object."""
    lower = float(thing.traced.top.max()) < lost.height + _SAME_HEIGHT
    return lower and thing.area < _APART[1] * lost.area and lost.is_near(thing.traced.pose)


def _holds(segment: Segment, points: NDArray[np.float32], place: Float64Array) -> bool:
    """Whether a place (x, y) [m] lies on a segment."""
    own = points[segment.rows, segment.columns][segment.mask][:, :2]
    return bool(np.min(np.hypot(*(own - place[:2]).T)) < _SAME_PLACE)
