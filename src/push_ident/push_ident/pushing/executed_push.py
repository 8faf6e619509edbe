"""A push under way: when which part of its plan was reached, when it touched, and where its object rested before and after."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from scipy.special import chdtri

from push_ident.errors import PlanningError
from push_ident.geometry.se2 import wrap_angle
from push_ident.pushing.motion import ArmPlan
from push_ident.pushing.pacing import PathPacing
from push_ident.pushing.ports import ArmState, TrackedObject
from push_ident.types import Float64Array


@dataclass(slots=True)
class RestingPose:
    """Mean of the poses of an object at rest, whose errors are independent."""

    stamp: float = -np.inf
    """Of the latest pose [s]."""
    n: int = 0
    """Number of poses."""
    _first: Float64Array = field(default_factory=lambda: np.zeros(3))
    _sum: Float64Array = field(default_factory=lambda: np.zeros(3))
    _covariances: Float64Array = field(default_factory=lambda: np.zeros((3, 3)))

    def add(self, stamp: float, pose: Float64Array, covariance: Float64Array) -> None:
        """Take in (x, y, yaw) [m, m, rad] with its 3 x 3 covariance; one that is not newer than the latest is ignored."""
        if stamp <= self.stamp:
            return
        if not self.n:
            self._first = pose
        offset = pose - self._first
        offset[2] = wrap_angle(offset[2])
        self.stamp, self.n, self._sum, self._covariances = stamp, self.n + 1, self._sum + offset, self._covariances + covariance

    @property
    def mean(self) -> Float64Array:
        """(x, y, yaw) [m, m, rad]; the yaw is not wrapped."""
        return self._first + self._sum / max(self.n, 1)

    @property
    def covariance(self) -> Float64Array:
        """Of the mean, 3 x 3."""
        return self._covariances / max(self.n, 1) ** 2


def displacement(before: RestingPose, after: RestingPose, false_alarm: float = 1e-4) -> tuple[float, float, bool]:
    """Shift [m] and turn [rad] between two rests, and whether they exceed the noise of the poses at a false alarm rate [1]."""
    change = after.mean - before.mean
    change[2] = wrap_angle(change[2])
    # Poses that state no noise get a variance of 1e-12 m^2 and rad^2.
    covariance = before.covariance + after.covariance + 1e-12 * np.eye(3)
    distance2 = float(change @ np.linalg.solve(covariance, change))
    return float(np.hypot(change[0], change[1])), abs(float(change[2])), distance2 > chdtri(3, false_alarm)


class Purpose(IntEnum):
    """Why a push was made; the numbers are those of msg/PushRecord."""

    REQUESTED = 0
    RECENTRE = 1


@dataclass(slots=True)
class ExecutedPush:
    """A push that is to be made, and later its course. Times in seconds of the clock of the cell."""

    purpose: Purpose
    before: TrackedObject
    plan: ArmPlan
    push_id: int = 0
    """0: it has not begun."""
    started: float = 0.0
    contact: float | None = None
    """When the measured tool passed the planned point of contact."""
    ended: float = 0.0
    shift: float = 0.0
    """Of the clock of the arm's stamps ahead of the one above [s]: not 0 where `/clock` and the stamps differ."""
    error: PlanningError | None = None
    """Why it failed."""
    pacing: PathPacing | None = None
    """Tells when which part of the plan was reached."""
    reached: float = 0.0
    """Time of the plan that the arm had reached at the last look [s]."""
    is_reported: bool = False
    """Whether its record was handed out."""
    rest_before: RestingPose = field(default_factory=RestingPose)
    """Of the object."""
    rest_after: RestingPose = field(default_factory=RestingPose)
    _last: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        self.rest_before.add(self.before.stamp, self.before.pose, self.before.covariance)

    def observe(self, state: ArmState) -> None:
        """Process one state of the lowered tool: the contact is where it passes the planned point."""
        push, stamp = self.plan.push, state.stamp
        travel = float((state.pose_tip_in_table[:2, 3] - push.tool_at_contact) @ push.heading)
        if self.contact is None and self._last is not None and self._last[1] < 0.0 <= travel:
            stamp_before, travel_before = self._last
            self.contact = stamp_before + (stamp - stamp_before) * travel_before / (travel_before - travel)
        self._last = (stamp, travel)

    def observe_object(self, now: TrackedObject) -> None:
        """Process the latest pose of the object: it rests until the tool is lowered, and after the tool has stopped."""
        if now.stamp <= self._reached(self.plan.lowered):
            self.rest_before.add(now.stamp, now.pose, now.covariance)
        elif now.stamp > self._reached(self.plan.stop):
            self.rest_after.add(now.stamp, now.pose, now.covariance)

    def times(self) -> tuple[float, float, float]:
        """Start, stop and end of the push [s], as its arm has time, which is that of the poses of the tool.

        A phase that was not reached has the time of the end.
        """
        phases = (self.plan.lowered, self.plan.stop, self.plan.rested)
        start, stop, end = (min(self._reached(t), self.ended) + self.shift for t in phases)
        return start, stop, end

    def _reached(self, path_time: float) -> float:
        return np.inf if self.pacing is None else self.pacing.time_of(path_time)
