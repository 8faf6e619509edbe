"""The objects that perception knows, their pose in each frame, and what becomes of an object that came apart.

Things that touch are taken in as one object, and so is a thing with another one on it. A push shows it: a part of the upper side is missing
at the pose that fits the edges, or no pose fits any more. Such an object gets no pose. It is given up when its parts were taken in, each as
a new object with a new id; as long as the parts still touch, they are refused as several things instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.se2 import rotation
from push_ident.perception.frame.view import FrameView
from push_ident.perception.known_object import (
    NOISE_STEP,
    ON_OBJECT,
    THIN,
    TOP_QUANTILE,
    KnownObject,
    NewObject,
    Placed,
    PoseFit,
    Refined,
    Segment,
    Template,
    TrackStatus,
    area_from_above,
)
from push_ident.perception.refusals import Reason, Refusal, Removal
from push_ident.perception.tracking.pose_fit import MISSING, UpperSide, compare_upper_side, fit_pose, relocate
from push_ident.types import Float64Array, ObjectShape

_MAX_AGE: Final = 0.2
"""Poses further apart in time do not estimate a velocity [s]."""
_OPEN: Final = (0.1, 0.6)
"""Where no pose fits, a fraction of open border between these shows parts that moved against each other [-]: below, nothing is missing;
above, the object is gone."""
_CROWDED: Final = (0.1, 0.9)
"""A fraction of crowded border between these, with none of it open, shows a thing that touches the object [-]."""
_TOGETHER: Final = (0.75, 1.4)
"""Area of parts that still touch, relative to that of the object [-]: one may stand on the other in part."""
_APART: Final = (0.8, 1.25)
"""Area of the separate parts together, relative to that of the object [-]."""
_SAME_HEIGHT: Final = 0.01
"""Largest difference of the heights of an object and of its parts [m]: a tipped object differs by more."""


@dataclass(slots=True)
class TrackedObject:
    """A registered object and its latest pose."""

    template: Template
    """Of the object as it was traced when it was registered, or later from several rests."""
    area: float
    """Area of its segment [m^2]."""
    pose: Float64Array
    stamp: float
    velocity: Float64Array = field(default_factory=lambda: np.zeros(3))
    status: TrackStatus = TrackStatus.TRACKED
    checked: float = -math.inf
    """When it was last looked for missing parts [s]."""
    announced: bool = True
    """Whether its shape has been reported; that of a remembered object is when it is found again."""

    @property
    def is_tracked(self) -> bool:
        """Whether its latest pose is one."""
        return self.status is TrackStatus.TRACKED

    @property
    def placed(self) -> Placed:
        """What tracks it, and its latest pose."""
        return self.template, self.pose

    def predicted(self, stamp: float) -> Float64Array:
        """Pose at constant velocity."""
        age = stamp - self.stamp
        return self.pose + self.velocity * age if 0 < age < _MAX_AGE else self.pose

    def accept(self, fit: PoseFit, stamp: float) -> None:
        """Update status, pose and velocity with a fit."""
        self.status = fit.status
        if not fit.can_start_next:
            self.velocity = np.zeros(3)
            return
        age, step = stamp - self.stamp, fit.pose - self.pose
        # The noise of two poses is no velocity: started from where it leads to, the next fit would be further off.
        noise = 2.0 * np.diag(fit.residual_covariance) / np.maximum(np.square(step), 1e-18)
        self.velocity = np.maximum(1.0 - noise, 0.0) * step / age if 0 < age < _MAX_AGE else np.zeros(3)
        self.pose, self.stamp = fit.pose, stamp


class KnownObjects(dict[str, TrackedObject]):
    """The known objects by id ("o1", "o2", ...: no part of a ROS topic may begin with a digit). Ids are not used again."""

    def __init__(self) -> None:
        super().__init__()
        self._n_ids = 0

    def add(self, new: NewObject, stamp: float) -> str:
        """Know a new object from now on; its id."""
        self._n_ids += 1
        name = f"o{self._n_ids}"
        self[name] = TrackedObject(Template(new.traced), new.area, new.traced.pose, stamp)
        return name

    def remember(self, name: str, known: KnownObject) -> None:
        """Know an object of an earlier run, which is to be found again."""
        pose = np.array(known.pose, dtype=np.float64)
        self[name] = TrackedObject(Template(known.traced), known.area, pose, -np.inf, status=TrackStatus.OUT_OF_VIEW)
        self[name].announced = False
        self._n_ids = max(self._n_ids, int(name[1:]))

    def tracked(self) -> dict[str, TrackedObject]:
        """Those that have a pose."""
        return {name: known for name, known in self.items() if known.is_tracked}

    def others_near(self, name: str) -> list[Placed]:
        """Other tracked objects near enough to be mistaken for parts of this one."""
        known = self[name]
        return [
            other.placed
            for other_name, other in self.tracked().items()
            if other_name != name and np.linalg.norm(other.pose[:2] - known.pose[:2]) < other.template.radius + known.template.radius + 0.03
        ]

    def announce(self) -> dict[str, ObjectShape]:
        """Shapes of the remembered objects that were just found."""
        again = {name: known for name, known in self.tracked().items() if not known.announced}
        for known in again.values():
            known.announced = True
        return {name: known.template.traced.shape for name, known in again.items()}


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
        """Whether a part of it may be there: within twice its radius."""
        template, pose = self.placed
        return bool(np.linalg.norm(position[:2] - pose[:2]) < 2.0 * template.radius)

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
            near = [
                segment
                for segment in segments
                if suspect.is_near(segment.centre) and segment.fault not in (Reason.TOO_SMALL, Reason.TOO_LOW)
            ]
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


class Tracker:
    """Fits the known objects to frames; a fit is accepted unless a part of the object is missing there."""

    def __init__(self, objects: KnownObjects) -> None:
        self._objects = objects
        self.separation: Final = Separation()

    def track(self, view: FrameView, elapsed: float, *, is_searching: bool) -> dict[str, PoseFit]:
        """Fit all known objects near their predicted poses, `elapsed` seconds after the frame before.

        While a search is under way, checks for missing parts wait.
        """
        fits, (max_step, max_turn) = {}, view.settings.tracking.max_jump
        to_check = self._to_check(view, elapsed, is_searching=is_searching)
        for name, known in self._objects.items():
            if not known.announced:
                continue  # where it was in an earlier run is no place to start from
            start = known.predicted(view.frame.stamp)
            others = self._objects.others_near(name)
            fit = fit_pose(known.template, view, start, others)
            jumped = np.hypot(*(fit.pose - start)[:2]) > max_step or abs(fit.pose[2] - start[2]) > max_turn
            if fit.can_start_next and jumped:
                # With most of the object behind the arm, a fit may slide to a pose that no visible pixel contradicts.
                fit = replace(fit, status=TrackStatus.POOR_FIT)
            fits[name] = self._accept(name, fit, view, others, must_check=name in to_check)
        return fits

    def find_again(self, view: FrameView, name: str, segments: Sequence[Segment]) -> PoseFit | None:
        """Fit of a lost object at the one place where it fits as a whole, beside a segment of similar area; None where there is none.

        One of several places is taken where it is less than half as far from the last place of the object as the next; as long as something
        of that size is there, none that is further away than its radius.
        """
        known, others = self._objects[name], self._objects.others_near(name)
        (low, high), (same_place, _) = view.settings.tracking.same_area, view.settings.tracking.max_jump
        fits = list[PoseFit]()
        alike = [segment for segment in segments if low * known.area < segment.area < high * known.area]
        reach = known.template.radius if any(_covers(segment, view.points, known.pose) for segment in alike) else np.inf
        for segment in alike:
            fit = relocate(known.template, view, segment.centre, others=others, last_yaw=float(known.pose[2]))
            is_there = fit.status is TrackStatus.TRACKED and _apart(fit.pose, known.pose) < reach
            if is_there and not compare_upper_side(known.template, view, fit.pose, others).is_part_missing:
                fits.append(fit)
        nearest = min(fits, key=lambda fit: _apart(fit.pose, known.pose), default=None)
        # Several segments, as on both sides of an arm, may show the object in one place.
        elsewhere = [fit for fit in fits if nearest is not None and _apart(fit.pose, nearest.pose) > same_place]
        if nearest is None or any(2.0 * _apart(nearest.pose, known.pose) >= _apart(fit.pose, known.pose) for fit in elsewhere):
            return None
        self.separation.clear(name)
        known.accept(nearest, view.frame.stamp)
        return nearest

    def adopt(
        self, refined: Mapping[str, tuple[Refined, Template]], view: FrameView, fits: dict[str, PoseFit]
    ) -> tuple[dict[str, ObjectShape], dict[str, str]]:
        """Follow objects by better outlines, with fits of this frame to them; the shapes, and why others stay as they are.

        Args:
            fits: Those of this frame, which are updated.
        """
        shapes: dict[str, ObjectShape] = {}
        failed: dict[str, str] = {}
        for name, (better, template) in refined.items():
            known = self._objects[name]
            fit = fit_pose(template, view, known.pose, self._objects.others_near(name))
            if known.is_tracked and fit.status is not TrackStatus.TRACKED:
                failed[name] = f"with it, {fit.status.value}"
                continue
            known.template, known.area, shapes[name] = template, better.area, better.traced.shape
            if known.is_tracked:
                known.pose, fits[name] = fit.pose, fit
        return shapes, failed

    def _to_check(self, view: FrameView, elapsed: float, *, is_searching: bool) -> list[str]:
        """The objects to check in this frame for missing parts: each once in a search period, those not checked for longest first.

        While a search is under way they wait, at most for another period.
        """
        period = view.settings.search_period
        share = elapsed / period if elapsed < period else 1.0
        wait = 2.0 * period if is_searching else period
        due = [name for name, known in self._objects.items() if view.is_due(known.checked, wait)]
        return sorted(due, key=lambda name: self._objects[name].checked)[: int(np.ceil(share * len(self._objects)))]

    def _accept(self, name: str, fit: PoseFit, view: FrameView, others: Sequence[Placed], *, must_check: bool) -> PoseFit:
        """Take the fit of an object, unless a part of it is missing there; the fit with the status that results.

        `must_check`: whether the object is checked for missing parts though nothing speaks for any.
        """
        known = self._objects[name]
        doubtful = not known.is_tracked or fit.share_contradicting > view.settings.tracking.doubtful
        if fit.status in (TrackStatus.TRACKED, TrackStatus.POOR_FIT) and (doubtful or must_check):
            known.checked = view.frame.stamp
            upper_side = compare_upper_side(known.template, view, fit.pose, others)
            if fit.status is TrackStatus.TRACKED and upper_side.is_part_missing:
                fit = replace(fit, status=TrackStatus.PART_MISSING)
            if fit.status is TrackStatus.TRACKED:
                self.separation.clear(name)
            else:
                self.separation.suspect(name, known.placed, known.area, upper_side)
        known.accept(fit, view.frame.stamp)
        return fit


def _apart(pose: Float64Array, other: Float64Array) -> float:
    """Distance of two poses (x, y, yaw) [m]."""
    return float(np.linalg.norm((pose - other)[:2]))


def _is_all_parts(suspect: _Suspect, segment: Segment, points: NDArray[np.float32]) -> bool:
    """Whether a segment is all parts of an object, of which one moved."""
    low, high = (share * suspect.area for share in _TOGETHER)
    if not low < segment.area < high:
        return False
    heights = segment.points_in(points)[:, 2]
    same_height = abs(float(np.quantile(heights, TOP_QUANTILE)) - suspect.height) < _SAME_HEIGHT
    # What is left of the object when a part was taken away lies within its outline.
    return same_height and _area_beyond(segment, points, suspect.placed) > MISSING


def _area_beyond(segment: Segment, points: NDArray[np.float32], placed: Placed) -> float:
    """Area of a segment outside the outline of an object at a pose, or higher than the object is there [m^2]."""
    template, pose = placed
    box_points = points[segment.rows, segment.columns]
    in_object = ((box_points[..., :2].reshape(-1, 2) - pose[:2]) @ rotation(pose[2])).astype(np.float64)
    outside = template.nearest_distance(in_object) > ON_OBJECT
    raised = box_points[..., 2].ravel() > template.nearest_top(in_object) + NOISE_STEP
    beyond = (outside | raised).reshape(segment.mask.shape) & segment.mask
    beyond = cv2.morphologyEx(beyond.astype(np.uint8), cv2.MORPH_OPEN, THIN) > 0
    return area_from_above(box_points[beyond].astype(np.float64))


def _is_part(suspect: _Suspect, thing: NewObject) -> bool:
    lower = float(thing.traced.top.max()) < suspect.height + _SAME_HEIGHT
    return lower and thing.area < _APART[1] * suspect.area and suspect.is_near(thing.traced.pose)


def _covers(segment: Segment, points: NDArray[np.float32], position: Float64Array) -> bool:
    """Whether a position (x, y) [m] lies on a segment, within 10 mm."""
    on_segment = segment.measured_in(points)[:, :2]
    return bool(np.any(np.hypot(*(on_segment - position[:2]).T) < 0.01))
