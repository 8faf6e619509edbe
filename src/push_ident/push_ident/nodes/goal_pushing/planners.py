"""Plans in separate threads: callbacks, and above all a cancellation, must not wait for one."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import numpy as np

from push_ident.identification.results.posterior import ModelPosterior
from push_ident.nodes.goal_pushing.settings import GOAL_PUSHING
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.planning.edge_goal import EdgeGoal, edge_target, held_target
from push_ident.planning.goal import Target
from push_ident.planning.library import compile_planning
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_steps import PathStep, PathSteps
from push_ident.planning.planner import GoalPlanner, GoalPush
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array, ObjectShape

__all__ = ["GoalPlanners", "PathPlanners", "WorkUnderWay"]

K = TypeVar("K")
P = TypeVar("P")
T = TypeVar("T")


class WorkUnderWay(Generic[T]):
    """`planning.goal_ports.UnderWay` in a thread. A result that is not awaited any more is dropped."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work = work
        self._done = threading.Event()
        self._result: T | None = None
        self._error: Exception | None = None
        threading.Thread(target=self._run, name="plan", daemon=True).start()

    def result(self) -> T | None:
        """As `UnderWay`."""
        if not self._done.is_set():
            return None
        if self._error is not None:
            raise self._error
        return self._result

    def _run(self) -> None:
        try:
            self._result = self._work()
        except Exception as error:
            self._error = error
        finally:
            self._done.set()


class _Planners(Generic[K, P]):
    """Belief and planner of each object, which keeps what it has simulated; another planner for another outline or another key."""

    def __init__(self, n_kept: int, make: Callable[[ObjectShape, K], P]) -> None:
        self._n_kept, self._make = n_kept, make
        self._known: dict[str, tuple[Belief, K, P]] = {}

    def get(self, object_id: str, posterior: ModelPosterior, key: K) -> tuple[Belief, P]:
        known, shape = self._known.pop(object_id, None), posterior.unknowns.shape
        if known is None or known[1] != key or not np.array_equal(known[0].shape.outline, shape.outline):
            known = (Belief.of(posterior), key, self._make(shape, key))
        elif known[0].posterior is not posterior:
            known = (Belief.of(posterior), key, known[2])
        self._known[object_id] = known
        while len(self._known) > self._n_kept:
            del self._known[next(iter(self._known))]
        return known[0], known[2]


class GoalPlanners:
    """The planners of goals, one plan at a time."""

    def __init__(self) -> None:
        self._one_at_a_time = threading.Lock()
        self._planners = _Planners(GOAL_PUSHING.n_planners, GoalPlanner)
        threading.Thread(target=self._warm_up, name="compile", daemon=True).start()

    def begin(
        self,
        posterior: ModelPosterior,
        settings: PushSettings,
        tracked: TrackedObject,
        target: Target,
        obstacles: list[Float64Array],
        failed: list[PushPlan2D],
    ) -> WorkUnderWay[GoalPush]:
        """Begin to plan; arguments as of `GoalPlanner.plan`."""

        def work() -> GoalPush:
            with self._one_at_a_time:
                belief, planner = self._planners.get(tracked.object_id, posterior, settings)
                return planner.plan(belief, tracked.pose, tracked.covariance, target.goal, obstacles, failed, target.hold)

        return WorkUnderWay(work)

    def begin_target(
        self,
        posterior: ModelPosterior,
        settings: PushSettings,
        tracked: TrackedObject,
        goal: EdgeGoal,
        edges: Sequence[TableEdge],
        chosen: Target | None,
    ) -> WorkUnderWay[Target]:
        """Begin to choose a pre-grasp pose; arguments as of `GoalPorts.begin_target`."""

        def work() -> Target:
            with self._one_at_a_time:
                belief, _ = self._planners.get(tracked.object_id, posterior, settings)
                if chosen is not None and chosen.hold is not None:
                    return held_target(chosen.goal, chosen.hold, belief)
                return edge_target(goal, edges, belief, tracked.pose, settings)

        return WorkUnderWay(work)

    def _warm_up(self) -> None:
        with self._one_at_a_time:
            compile_planning()


class PathPlanners:
    """The planners of paths, one plan at a time."""

    def __init__(self) -> None:
        self._one_at_a_time = threading.Lock()
        self._planners: _Planners[tuple[PushSettings, float], PathSteps] = _Planners(
            GOAL_PUSHING.n_path_planners, lambda shape, key: PathSteps(shape, *key)
        )

    def begin(
        self,
        posterior: ModelPosterior,
        settings: PushSettings,
        half_width: float,
        tracked: TrackedObject,
        where: tuple[PathGoal, float],
        around: tuple[list[Float64Array], list[PushPlan2D]],
        steers: bool,
    ) -> WorkUnderWay[PathStep]:
        """Begin to plan the next push.

        Args:
            posterior: what is known of the object.
            settings: limits of the pushes.
            half_width: of the corridor of a steered push [m].
            tracked: the object.
            where: the path, and the length of it that is behind [m].
            around: outlines of other objects, and pushes that failed.
            steers: whether the tool may be steered.
        """

        def work() -> PathStep:
            with self._one_at_a_time:
                belief, steps = self._planners.get(tracked.object_id, posterior, (settings, half_width))
                return steps.plan(belief, tracked.pose, *where, *around, steers=steers)

        return WorkUnderWay(work)
