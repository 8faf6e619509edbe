"""Plans in threads of their own: callbacks, and above all a cancellation, must not wait for one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

import numpy as np

from push_ident.identification.result import ModelPosterior
from push_ident.planning.belief import Belief
from push_ident.planning.goal import Goal
from push_ident.planning.kernels import compile_planning
from push_ident.planning.planner import GoalPlanner, GoalPush
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array

__all__ = ["PlanUnderWay", "PlannerThread"]

_KEPT: Final = 4
"""Objects whose planner is kept: each holds a library of some 3 MB."""


class PlanUnderWay:
    """`planning.goal_session.Planning` in a thread. A plan that nobody waits for any more is finished and dropped."""

    def __init__(self, work: Callable[[], GoalPush]) -> None:
        self._work = work
        self._done = threading.Event()
        self._plan: GoalPush | None = None
        self._error: Exception | None = None
        threading.Thread(target=self._run, name="plan", daemon=True).start()

    def result(self) -> GoalPush | None:
        """As `Planning`."""
        if not self._done.is_set():
            return None
        if self._error is not None:
            raise self._error
        return self._plan

    def _run(self) -> None:
        try:
            self._plan = self._work()
        except Exception as error:
            self._error = error
        finally:
            self._done.set()


class PlannerThread:
    """The planners of all objects, one plan at a time."""

    def __init__(self) -> None:
        self._one_at_a_time = threading.Lock()
        self._planners: dict[str, tuple[Belief, PushSettings, GoalPlanner]] = {}
        threading.Thread(target=self._warm_up, name="compile", daemon=True).start()

    def begin(
        self,
        posterior: ModelPosterior,
        settings: PushSettings,
        seen: TrackedObject,
        goal: Goal,
        obstacles: list[Float64Array],
        failed: list[PushPlan2D],
    ) -> PlanUnderWay:
        """Begin to plan; arguments as of `GoalPlanner.plan`."""

        def work() -> GoalPush:
            with self._one_at_a_time:
                belief, planner = self._planner(seen.object_id, posterior, settings)
                return planner.plan(belief, seen.pose, seen.covariance, goal, obstacles, failed)

        return PlanUnderWay(work)

    def _warm_up(self) -> None:
        with self._one_at_a_time:
            compile_planning()

    def _planner(self, object_id: str, posterior: ModelPosterior, settings: PushSettings) -> tuple[Belief, GoalPlanner]:
        """Belief and planner of an object, which keeps what it has simulated; another planner for another outline or other settings."""
        known = self._planners.pop(object_id, None)
        shape = posterior.unknowns.shape
        if known is None or known[1] != settings or not np.array_equal(known[0].shape.outline, shape.outline):
            known = (Belief.of(posterior), settings, GoalPlanner(shape, settings))
        elif known[0].posterior is not posterior:
            known = (Belief.of(posterior), settings, known[2])
        self._planners[object_id] = known
        while len(self._planners) > _KEPT:
            del self._planners[next(iter(self._planners))]
        return known[0], known[2]
