"""The objects that perception knows, and their pose in each frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from push_ident.perception.frame.view import FrameView
from push_ident.perception.known_object import (
    KnownObject,
    NewObject,
    Placed,
    PoseFit,
    Refined,
    Segment,
    Template,
    TracedObject,
    TrackStatus,
)
from push_ident.perception.tracking.pose_fit import fit_pose, relocate
from push_ident.perception.tracking.separation import Separation, compare_upper_side
from push_ident.types import Float64Array, ObjectShape

__all__ = ["KnownObjects", "TrackedObject", "Tracker"]

_MAX_AGE: Final = 0.2
"""Poses further apart in time do not estimate a velocity [s]."""


@dataclass(slots=True)
class TrackedObject:
    """A registered object and its latest pose."""

    traced: TracedObject
    """How it was traced when it was registered, or later from several rests."""
    template: Template
    area: float
    """Area of its segment [m^2]."""
    first_pose: Float64Array
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
        age = stamp - self.stamp
        self.velocity = (fit.pose - self.pose) / age if 0 < age < _MAX_AGE else np.zeros(3)
        self.pose, self.stamp = fit.pose, stamp

    def adopt(self, better: Refined, template: Template) -> None:
        """Follow the object by a better outline from now on."""
        self.traced, self.template, self.area = better.traced, template, better.area


class KnownObjects(dict[str, TrackedObject]):
    """The known objects by id ("o1", "o2", ...: no part of a ROS topic may begin with a digit). Ids are not used again."""

    def __init__(self) -> None:
        super().__init__()
        self._n_ids = 0

    def add(self, new: NewObject, stamp: float) -> str:
        """Know a new object from now on; its id."""
        self._n_ids += 1
        name = f"o{self._n_ids}"
        self[name] = TrackedObject(new.traced, Template(new.traced), new.area, new.traced.pose, new.traced.pose, stamp)
        return name

    def remember(self, name: str, known: KnownObject) -> None:
        """Know an object of an earlier run, which is to be found again."""
        pose = np.array(known.pose, dtype=np.float64)
        tracked = TrackedObject(known.traced, Template(known.traced), known.area, known.traced.pose, pose, -np.inf)
        tracked.status, tracked.announced = TrackStatus.OUT_OF_VIEW, False
        self[name] = tracked
        self._n_ids = max(self._n_ids, int(name[1:]))

    def tracked(self) -> dict[str, TrackedObject]:
        """Those that have a pose."""
        return {name: known for name, known in self.items() if known.is_tracked}

    def others_near(self, name: str) -> list[Placed]:
        """Other tracked objects near enough to be mistaken for parts of this one."""
        known = self[name]
        return [
            other.placed
            for other_name, other in self.items()
            if other_name != name
            and other.is_tracked
            and np.linalg.norm(other.pose[:2] - known.pose[:2]) < other.template.radius + known.template.radius + 0.03
        ]

    def announce(self) -> dict[str, ObjectShape]:
        """Shapes of the remembered objects that were just found."""
        again = {name: known for name, known in self.tracked().items() if not known.announced}
        for known in again.values():
            known.announced = True
        return {name: known.traced.shape for name, known in again.items()}


class Tracker:
    """Fits the known objects to frames; a fit is accepted unless a part of the object is missing there."""

    def __init__(self, objects: KnownObjects, separation: Separation) -> None:
        self._objects, self._separation = objects, separation

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
        """Fit of a lost object to the first segment of similar area that it fits as a whole; None where it fits none."""
        known, others = self._objects[name], self._objects.others_near(name)
        low, high = view.settings.tracking.same_area
        for segment in segments:
            if low * known.area < segment.area < high * known.area:
                fit = relocate(known.template, view, segment.centre, others=others, last_yaw=float(known.pose[2]))
                if fit.status is TrackStatus.TRACKED and not compare_upper_side(known.template, view, fit.pose, others).is_part_missing:
                    self._separation.clear(name)
                    known.accept(fit, view.frame.stamp)
                    return fit
        return None

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
            known.adopt(better, template)
            shapes[name] = better.traced.shape
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
                self._separation.clear(name)
            else:
                self._separation.suspect(name, known.placed, known.area, upper_side)
        known.accept(fit, view.frame.stamp)
        return fit
