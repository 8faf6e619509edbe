"""Pushing an object along a path: plan, push, correct during the push, until it is at the end within tolerance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from push_ident.planning.goal import Goal, GoalCode, GoalRefusedError, Target
from push_ident.planning.goal_ports import GoalProgress, GoalRequest, GoalState, PathPorts, SessionLimits
from push_ident.planning.goal_session import Ended, GoalSession
from push_ident.planning.path_follower import FollowerOptions
from push_ident.planning.path_goal import PathGoal, check_path
from push_ident.planning.path_planner import PATH_OPTIONS, PathStatus
from push_ident.planning.path_steps import PathStep, may_steer_after
from push_ident.pushing.ports import TrackedObject


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

    def _check(self, observed: TrackedObject) -> None:
        settings = self._settings()
        if settings.span:
            raise Ended(
                GoalCode.INVALID_GOAL,
                f"the tool has two contacts {1e3 * settings.span:.0f} mm apart, and a path is followed with one contact; "
                "take a round tool, or give the end of the path as a goal.",
            )
        self._check_known(observed)
        try:
            check_path(self._path, observed.shape, settings)
        except GoalRefusedError as error:
            raise Ended(error.code, str(error)) from None
        spacing = PATH_OPTIONS.least_progress
        self._check_clear(observed, self._path.at(np.append(np.arange(0.0, self._path.length, spacing), self._path.length)))

    def _is_there(self, observed: TrackedObject) -> bool:
        at_end = self._arrived or self._path.length - self._done < PATH_OPTIONS.least_progress
        return at_end and self._target.is_reached(observed.pose, observed.covariance)

    def _compare(self, observed: TrackedObject) -> None:
        _, error = self._path.error(observed.pose, self._done, FollowerOptions().frame_travel)
        self.progress.target, self.progress.error = self._target, error

    def _run(self) -> None:
        observed = self._observe(-np.inf, GoalCode.UNKNOWN_OBJECT)
        self._check(observed)
        self._learn(observed.object_id, self._ports.pushed_at(observed.object_id))
        if self._request.explore:
            observed = self._explore(self._certain(observed))
        while True:
            observed = self._certain(observed)
            step = self._next_step(observed)
            if step.status is PathStatus.ARRIVED:
                self._arrived, self.progress.done = True, 1.0
                # The end of a path is a pose: an object that is not there is pushed there as to any goal.
                self._go_to_pose(observed)
                return
            observed = self._make(observed, step)

    def _next_step(self, observed: TrackedObject) -> PathStep:
        self._check_pushes()
        model = self._model(observed)
        self._enter(GoalState.PLAN)
        obstacles = self._outlines(observed)
        work = self._path_ports.begin_step(model, observed, self._path, self._done, obstacles, list(self._failed), steers=self._steers)
        step = self._computed(work, observed)
        if step.status is PathStatus.UNREACHABLE:
            raise Ended(GoalCode.UNREACHABLE, f"{step.status.value} ({100 * step.done / self._path.length:.0f} % of it are behind).")
        self._take_done(step.done)
        return step

    def _make(self, observed: TrackedObject, step: PathStep) -> TrackedObject:
        """Make a push, and see where the object is then."""
        contact, before = step.contact, self._done
        assert contact is not None, "the planner proposes a push"
        self.progress.step, self.progress.tool = step, None
        self._enter(GoalState.PUSH)
        self._stamp, self._far = observed.stamp, self._done
        if step.steered is not None:
            steered = self._path_ports.begin_steered(observed, step, self._path)

            def look() -> None:
                self._look()
                self.progress.tool = steered.tool

            report = self._carry_out(steered, look)
            self._take_done(steered.done)
            self.progress.corrections += steered.n_corrections
        else:
            report = self._carry_out(self._ports.begin_push(observed.object_id, contact), self._look)
        self._take_report(report, contact)
        self._steers = may_steer_after(step, before, self._done)
        return self._after_push(observed, report)

    def _take_done(self, done: float) -> None:
        self._done = max(self._done, done)
        self.progress.done = self._done / self._path.length

    def _look(self) -> None:
        """Add the error of the latest pose to the mean over the path, weighted by length of path."""
        latest = self._ports.observe(self._object_id, np.inf, -np.inf)
        if latest is None or latest.stamp <= self._stamp:
            return
        self._stamp = latest.stamp
        reached, error = self._path.error(latest.pose, self._far, FollowerOptions().frame_travel)
        moved = max(float(reached) - self._far, 0.0)
        self._far += moved
        self._sums, self._weight = self._sums + moved * error**2, self._weight + moved
        if self._weight > 0.0:
            self.progress.rms = np.sqrt(self._sums / self._weight)
