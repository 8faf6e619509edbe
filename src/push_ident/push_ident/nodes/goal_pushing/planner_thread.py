"""Plans in threads of their own: callbacks, and above all a cancellation, must not wait for one."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Final, Generic, TypeVar

import numpy as np

from push_ident.identification.results.posterior import ModelPosterior
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.planning.edge_goal import EdgeGoal, edge_target, held_target
from push_ident.planning.kernels import compile_planning
from push_ident.planning.planner import GoalPlanner, GoalPush
from push_ident.planning.target import Target
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array

__all__ = ["PlannerThread", "WorkUnderWay"]

_KEPT: Final = 4
"""Objects whose planner is kept: each holds a library of some 3 MB."""


T = TypeVar("T")


class WorkUnderWay(Generic[T]):
    """`planning.goal_ports.UnderWay` in a thread. What nobody waits for any more is finished and dropped."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work = work
        self._done = threading.Event()
        self._found: T | None = None
        self._error: Exception | None = None
        threading.Thread(target=self._run, name="plan", daemon=True).start()

    def result(self) -> T | None:
        """As `UnderWay`."""
        if not self._done.is_set():
            return None
        if self._error is not None:
            raise self._error
        return self._found

    def _run(self) -> None:
        try:
            self._found = self._work()
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
        target: Target,
        obstacles: list[Float64Array],
        failed: list[PushPlan2D],
    ) -> WorkUnderWay[GoalPush]:
        """Begin to plan; arguments as of `GoalPlanner.plan`."""

        def work() -> GoalPush:
            with self._one_at_a_time:
                belief, planner = self._planner(seen.object_id, posterior, settings)
                return planner.plan(belief, seen.pose, seen.covariance, target.goal, obstacles, failed, target.hold)

        return WorkUnderWay(work)

    def begin_target(
        self,
        posterior: ModelPosterior,
        settings: PushSettings,
        seen: TrackedObject,
        goal: EdgeGoal,
        edges: Sequence[TableEdge],
        chosen: Target | None,
    ) -> WorkUnderWay[Target]:
        """Begin to choose a pre-grasp pose; arguments as of `GoalPorts.begin_target`."""

        def work() -> Target:
            with self._one_at_a_time:
                belief, _ = self._planner(seen.object_id, posterior, settings)
                if chosen is not None and chosen.hold is not None:
                    return held_target(chosen.goal, chosen.hold, belief)
                return edge_target(goal, edges, belief, seen.pose, settings)

        return WorkUnderWay(work)

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
