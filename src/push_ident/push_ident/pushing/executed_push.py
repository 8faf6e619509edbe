"""A push that is made: when which part of its plan was reached, when it touched, and where its object rested before and after."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.motion import ArmPlan
from push_ident.pushing.pacing import PathPacing
from push_ident.pushing.ports import ArmState, TrackedObject
from push_ident.pushing.resting import RestingPose

__all__ = ["ExecutedPush", "Purpose"]


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
    """Time of the plan that the arm had reached when it was looked at last [s]."""
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
