"""Pushing an object along a path: plan, push, correct on the way, until it is at the end, and there as exactly as it was asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.planning.goal import Goal
from push_ident.planning.goal_code import GoalCode, GoalRefusedError
from push_ident.planning.goal_ports import GoalProgress, GoalRequest, GoalState, PathPorts, PushReport, PushUnderWay, SessionLimits
from push_ident.planning.goal_session import Ended, GoalSession
from push_ident.planning.path_goal import PathGoal, check_path
from push_ident.planning.path_planner import PathStatus
from push_ident.planning.path_steps import PathStep, may_steer_after
from push_ident.planning.planner import PlanStatus
from push_ident.planning.target import Target
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushCode

__all__ = ["PathSession"]

_AHEAD: Final = 0.05
"""How far along the path the object may come between two poses [m]."""
_LEAST: Final = 0.004
"""Nearer to the end of the path than this no push is planned [m], as by both planners."""


class _Watched:
    """A push under way during which poses are looked at."""

    def __init__(self, push: PushUnderWay, look: Callable[[], None]) -> None:
        self._push, self._look = push, look

    def report(self) -> PushReport | None:
        self._look()
        return self._push.report()

    def cancel(self) -> None:
        self._push.cancel()


class PathSession(GoalSession):
    """One path; arguments as of `GoalSession`, of which it has the observing, exploring, learning and waiting."""

    def __init__(
        self,
        request: GoalRequest,
        ports: PathPorts,
        limits: SessionLimits | None = None,
        *,
        on_progress: Callable[[GoalProgress], None] = lambda progress: None,
    ) -> None:
        path = request.goal
        assert isinstance(path, PathGoal), "a path"
        end = Goal(path.poses[-1], path.position, path.yaw)
        super().__init__(replace(request, goal=end), ports, limits, on_progress=on_progress)
        self._path, self._path_ports = path, ports
        self._target = Target(end)
        self._done, self._far, self._stamp = 0.0, 0.0, -np.inf
        self._sums, self._weight = np.zeros(2), 0.0
        self._steers, self._arrived = True, False
        self.progress.path, self.progress.done = path, 0.0

    def _check(self, seen: TrackedObject) -> None:
        self._check_known(seen)
        try:
            check_path(self._path, seen.shape, self._settings())
        except GoalRefusedError as error:
            raise Ended(error.code, str(error)) from None

    def _is_there(self, seen: TrackedObject) -> bool:
        at_end = self._arrived or self._path.length - self._done < _LEAST
        return at_end and self._target.is_reached(seen.pose, seen.covariance)

    def _compare(self, seen: TrackedObject) -> None:
        _, error = self._path.error(seen.pose, self._done, _AHEAD)
        self.progress.target, self.progress.error = self._target, error

    def _run(self) -> None:
        seen = self._observe(-np.inf, GoalCode.UNKNOWN_OBJECT)
        self._check(seen)
        self._learn(seen.object_id, self._ports.pushed_at(seen.object_id))
        if self._request.explore:
            seen = self._explore(self._certain(seen))
        while True:
            seen = self._certain(seen)
            step = self._next_step(seen)
            if step.status is PathStatus.ARRIVED:
                self._arrived, self.progress.done = True, 1.0
                self._end_at_pose(seen)
                return
            seen = self._make(seen, step)

    def _end_at_pose(self, seen: TrackedObject) -> None:
        """The end of a path is a pose: where the object is beside it, it is pushed there as to any goal."""
        while not self._is_there(seen):
            seen = self._certain(seen)
            plan = self._plan(seen)
            if plan.status is PlanStatus.ARRIVED:
                return
            self.progress.step = self.progress.tool = None
            seen = self._push_to_goal(seen, plan)

    def _next_step(self, seen: TrackedObject) -> PathStep:
        self._check_pushes()
        model = self._model(seen)
        self._enter(GoalState.PLAN)
        obstacles = self._ports.obstacles(seen.object_id)
        work = self._path_ports.begin_step(model, seen, self._path, self._done, obstacles, list(self._failed), steers=self._steers)
        step = self._computed(work, seen)
        if step.status is PathStatus.UNREACHABLE:
            raise Ended(GoalCode.UNREACHABLE, f"{step.status.value} ({100 * step.done / self._path.length:.0f} % of it are behind).")
        self._take_done(step.done)
        return step

    def _make(self, seen: TrackedObject, step: PathStep) -> TrackedObject:
        """Make a push, and see where the object is then."""
        contact, before = step.contact, self._done
        assert contact is not None, "the planner proposes a push"
        self.progress.step, self.progress.tool = step, None
        self._enter(GoalState.PUSH)
        self._stamp, self._far = seen.stamp, self._done
        if step.steered is not None:
            steered = self._path_ports.begin_steered(seen, step, self._path)

            def look() -> None:
                self._look()
                self.progress.tool = steered.tool

            report = self._carry_out(_Watched(steered, look))
            self._take_done(steered.done)
            self.progress.corrections += steered.n_corrections
        else:
            report = self._carry_out(_Watched(self._ports.begin_push(seen.object_id, contact), self._look))
        if report.code is PushCode.NONE:
            self._failed.clear()
            self._refusals = 0
        else:
            self._take_failure(report, contact)
        self._steers = may_steer_after(step, before, self._done)
        return self._after_push(seen, report)

    def _take_done(self, done: float) -> None:
        self._done = max(self._done, done)
        self.progress.done = self._done / self._path.length

    def _look(self) -> None:
        """Add what the latest pose shows to the error of the way: each piece of path counts by its length."""
        latest = self._ports.observe(self._object_id, np.inf, -np.inf)
        if latest is None or latest.stamp <= self._stamp:
            return
        self._stamp = latest.stamp
        place, error = self._path.error(latest.pose, self._far, _AHEAD)
        moved = max(float(place) - self._far, 0.0)
        self._far += moved
        self._sums, self._weight = self._sums + moved * error**2, self._weight + moved
        if self._weight > 0.0:
            self.progress.rms = np.sqrt(self._sums / self._weight)
