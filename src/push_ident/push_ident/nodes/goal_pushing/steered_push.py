"""A push along a path at the executor, which this process corrects at the rate of the poses."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from push_ident.nodes.goal_pushing.executor_link import RequestedPush
from push_ident.nodes.goal_pushing.settings import GOAL_PUSHING
from push_ident.planning.curved_planner import CurvedPush
from push_ident.planning.goal_ports import PushReport
from push_ident.planning.path_follower import Correction, FollowStatus, PathFollower
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.steering import ToolCorrection
from push_ident.types import Float64Array

__all__ = ["SteeredPush"]


class SteeredPush:
    """`planning.goal_ports.SteeredUnderWay`.

    Args:
        push: that was asked for.
        follower: decides the corrections.
        plan: of the push.
        tracked: the object before it.
        observe: the object as observed last.
        send: publishes a correction.
        guard: `Guard.watch`: what fails in the thread is refused and counted; the executor then stops for want of corrections.
    """

    def __init__(
        self,
        push: RequestedPush,
        follower: PathFollower,
        plan: CurvedPush,
        tracked: TrackedObject,
        *,
        observe: Callable[[str], TrackedObject],
        send: Callable[[ToolCorrection], None],
        guard: Callable[[str], Any],
    ) -> None:
        assert plan.time is not None and plan.tool is not None, "a push has a path"
        self._push, self._follower, self._plan, self._observe, self._send, self._guard = push, follower, plan, observe, send, guard
        follower.begin(plan.time, plan.tool, tracked.pose, tracked.covariance, plan.done, plan.expected_error)
        self._object_id, self._contact = tracked.object_id, float(plan.time[1])
        self.done = plan.done
        """As `SteeredUnderWay`."""
        self.n_corrections = 0
        """As `SteeredUnderWay`."""
        self.tool: Float64Array | None = None
        """As `SteeredUnderWay`."""
        self.seconds: list[float] = []
        """That corrections took, by the wall clock."""
        self.ended = ""
        """Why the contact was given up; empty while it goes on."""
        threading.Thread(target=self._run, name="corrections", daemon=True).start()

    def report(self) -> PushReport | None:
        """As `PushUnderWay`."""
        return self._push.report()

    def cancel(self) -> None:
        """As `PushUnderWay`."""
        self._push.cancel()

    def _run(self) -> None:
        latest = -np.inf
        while not self._push.has_ended:
            with self._guard("push_correction"):
                tracked = self._observe(self._object_id)
                push_id, start = self._push.begun
                # Poses before the contact show nothing new.
                if push_id and start > 0.0 and tracked.stamp > max(latest, start + self._contact):
                    latest = tracked.stamp
                    self._correct(tracked, push_id, start)
                    continue
            time.sleep(GOAL_PUSHING.pose_poll)

    def _correct(self, tracked: TrackedObject, push_id: int, start: float) -> None:
        begun = time.perf_counter()
        if self.ended:
            self._send(ToolCorrection(push_id, tracked.stamp, True, np.empty(0), np.empty((0, 2))))
            return
        due = begun + GOAL_PUSHING.correction_budget
        correction = self._follower.correct(tracked.stamp - start, tracked.pose, tracked.covariance, lambda: time.perf_counter() > due)
        self._send(_message(correction, push_id, tracked.stamp))
        self.seconds = [*self.seconds, time.perf_counter() - begun][-GOAL_PUSHING.n_correction_times :]
        self.n_corrections += 1
        self.done, self.tool = correction.done, correction.tool
        if correction.status is not FollowStatus.GOING:
            self.ended = correction.status.value


def _message(correction: Correction, push_id: int, stamp: float) -> ToolCorrection:
    is_over = correction.status is not FollowStatus.GOING
    return ToolCorrection(push_id, stamp, is_over, correction.time - correction.time[0], correction.tool)
