"""The search for new and lost objects, done in parts over the frames that follow its own.

A search looks at the whole image, which takes longer than a fit of poses. It is of one frame and of what was known then; only its end, in
which lost objects are fitted again, is of the frame in which it ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.se2 import rotation
from push_ident.perception.frame.table import TableCamera
from push_ident.perception.frame.view import ROBOT, TABLE, FrameView
from push_ident.perception.known_object import ON_OBJECT, THIN, NewObject, Placed, PoseFit, Segment, area_from_above
from push_ident.perception.outline.rests import RestingObject, Rests
from push_ident.perception.outline.tracing import InParts
from push_ident.perception.refusals import Reason, Refusal, Removal
from push_ident.perception.search.hollows import Covered, cover_hollows
from push_ident.perception.search.registration import Registration
from push_ident.perception.search.segments import find_segments
from push_ident.perception.tracking.separation import Separation
from push_ident.perception.tracking.tracker import KnownObjects, Tracker
from push_ident.types import BoolArray, ObjectShape

__all__ = ["N_PARTS", "Search", "SearchResult"]

N_PARTS: Final = 3
"""Parts of a search: labels and hollows, segments, and what they are."""
_EXPLAINED: Final = 0.1
"""A segment of which less lies on known objects is a thing of its own: things that stand close may overlap at their walls [-]."""


@dataclass(frozen=True, slots=True)
class SearchResult:
    """What one search found, as in `Observation`."""

    fits: dict[str, PoseFit] = field(default_factory=dict)
    """Of objects that were found again."""
    new_shapes: dict[str, ObjectShape] = field(default_factory=dict)
    further_views: dict[str, str] = field(default_factory=dict)
    doubts: dict[str, str] = field(default_factory=dict)
    removed: tuple[Removal, ...] = ()


@dataclass(frozen=True, slots=True)
class _Segmented:
    """What stands on the table in one frame."""

    covered: Covered
    segments: list[Segment]
    counts: dict[str, int]
    """Of pixels `table`, `robot`, `object_pixels`, and of `segments`."""


@dataclass(frozen=True, slots=True)
class _Started:
    """A search under way, with what was known in its frame."""

    work: InParts[_Segmented]
    stamp: float
    """Of its frame [s]."""
    tracked: dict[str, Placed]
    """The objects that had a pose, by id."""
    at_rest: tuple[RestingObject, ...]


class Search:
    """A job that takes in new objects, finds lost ones again, and begins better outlines of those at rest."""

    def __init__(self, table: TableCamera, objects: KnownObjects, tracker: Tracker, separation: Separation, rests: Rests) -> None:
        self._table, self._objects, self._tracker, self._separation, self._rests = table, objects, tracker, separation, rests
        self.registration: Final = Registration()
        self.refused: tuple[Refusal, ...] = ()
        """By the last search."""
        self.counts = dict.fromkeys(("table", "robot", "object_pixels", "segments"), 0)
        """Of the last search."""
        self._last = -np.inf
        self._started: _Started | None = None
        self._result = SearchResult()

    @property
    def is_under_way(self) -> bool:
        """Whether parts of it are left to do."""
        return self._started is not None

    def due(self, view: FrameView) -> bool:
        """Once in a search period, unless a better outline has waited for a turn since the last search."""
        return view.is_due(self._last, view.settings.search_period) and not self._rests.waits

    def step(self, view: FrameView) -> int:
        """Do the next part; the turns that took. What the segments are is soon known: that takes none."""
        started = self._started or self._begin(view)
        self._started = None  # an error ends it
        try:
            next(started.work)
        except StopIteration as end:
            self._rests.note_search()
            self._result = self._explain(started, end.value, view)
            return 0
        self._started = started
        return 1

    def take_result(self) -> SearchResult:
        """What a search that ended since the last call found."""
        result, self._result = self._result, SearchResult()
        return result

    def _begin(self, view: FrameView) -> _Started:
        self._last = view.frame.stamp
        tracked = {name: known.placed for name, known in self._objects.tracked().items()}
        return _Started(_segmented(view), view.frame.stamp, tracked, self._rests.resting(self._objects))

    def _explain(self, started: _Started, segmented: _Segmented, view: FrameView) -> SearchResult:
        """What the segments of a search are: known objects, lost ones, which are fitted to the frame of `view`, and new ones."""
        covered, settings = segmented.covered, self._table.settings
        points = covered.view.points
        for resting in started.at_rest:
            self._rests.begin_refinement(resting, segmented.segments, covered.view, settings.min_object_height)
        tracked = {name: known.placed for name, known in self._objects.tracked().items()} | started.tracked
        unexplained = _unexplained(segmented.segments, points, list(tracked.values()), settings.min_object_area)
        fits = {}
        for name, known in self._objects.items():
            fit = None if known.is_tracked else self._tracker.find_again(view, name, unexplained)
            if fit is not None:
                fits[name] = fit
                unexplained = _unexplained(unexplained, points, [known.placed], settings.min_object_area)
        unexplained, touching, removed = self._separation.refuse_parts(unexplained, points, settings.rest_frames)
        new, waiting = self._registration_of([segment for segment in unexplained if segment.whole], covered, started.stamp)
        cut = [segment.refusal(points, segment.fault) for segment in unexplained if segment.fault is not None]
        self.refused, self.counts = (*cut, *touching, *waiting), segmented.counts
        removed += self._separation.replace_by(new)
        for removal in removed:
            del self._objects[removal.object_id]
            self._rests.forget(removal.object_id)
        return SearchResult(
            fits,
            self._objects.announce() | {name: thing.traced.shape for name, thing in new.items()},
            self.registration.further_views,
            {name: thing.doubt for name, thing in new.items() if thing.doubt},
            tuple(removed),
        )

    def _registration_of(self, segments: Sequence[Segment], covered: Covered, stamp: float) -> tuple[dict[str, NewObject], list[Refusal]]:
        """The segments that become objects, by id, and why the others do not."""
        traced, waiting = self.registration.update(segments, covered)
        new = {self._objects.add(thing, stamp): thing for thing in traced}
        for name, thing in new.items():
            self._rests.begin(name, thing.views, thing.traced.pose)
        return new, waiting


def _segmented(view: FrameView) -> InParts[_Segmented]:
    """The segments of a frame."""
    covered = cover_hollows(view)
    yield
    segments, counts = find_segments(covered.view)
    table, robot = (int(np.count_nonzero(covered.view.labels == label)) for label in (TABLE, ROBOT))
    yield
    return _Segmented(covered, segments, {"table": table, "robot": robot, **counts})


def _unexplained(segments: Sequence[Segment], points: NDArray[np.float32], known: Sequence[Placed], least_area: float) -> list[Segment]:
    """The segments that are no known object, with the rest of those that only in part are known ones.

    Args:
        points: Of the frame [m], shape (height, width, 3), table frame.
        known: The objects that are tracked.
        least_area: A smaller rest is the border of a known object [m^2].

    Returns:
        Segments in the same order. A rest has the fault TOUCHES_KNOWN: where it ends beside the known object cannot be seen.
    """
    unexplained = []
    for segment in segments:
        on_known = _on_known(segment.points_in(points), segment.mask, known)
        if np.count_nonzero(on_known) < _EXPLAINED * np.count_nonzero(segment.mask):
            unexplained.append(segment)
            continue
        rest = cv2.morphologyEx((segment.mask & ~on_known).astype(np.uint8), cv2.MORPH_OPEN, THIN) > 0
        left = replace(segment, mask=rest).points_in(points).astype(np.float64)
        area = area_from_above(left)
        if area >= least_area:
            fault = Reason.TOUCHES_KNOWN if segment.whole else segment.fault
            unexplained.append(replace(segment, mask=rest, centre=left[:, :2].mean(axis=0), area=area, fault=fault))
    return unexplained


def _on_known(points: NDArray[np.float32], mask: BoolArray, known: Sequence[Placed]) -> BoolArray:
    """Which pixels of `mask`, with these points [m], shape (n, 3), lie on one of the known objects."""
    on_one = np.zeros(len(points), dtype=bool)
    for template, pose in known:
        on_one |= template.nearest_distance((points[:, :2] - pose[:2]) @ rotation(pose[2])) < ON_OBJECT
    result = np.zeros(mask.shape, dtype=bool)
    result[mask] = on_one
    return result
