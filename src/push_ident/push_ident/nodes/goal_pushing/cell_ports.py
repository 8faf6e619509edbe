"""`planning.goal_ports.GoalPorts` of a cell on ROS."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import Point

from push_ident.errors import PlanningError
from push_ident.geometry.frames import TABLE_FRAME
from push_ident.nodes.convert.tool_path import path_goal
from push_ident.nodes.goal_pushing.executor_link import ExecutorLink, RequestedPush
from push_ident.nodes.goal_pushing.model_input import ModelInput
from push_ident.nodes.goal_pushing.parameters import SteeringValues
from push_ident.nodes.goal_pushing.planners import GoalPlanners, PathPlanners, WorkUnderWay
from push_ident.nodes.goal_pushing.steered_push import SteeredPush
from push_ident.nodes.input.table import TableInput
from push_ident.nodes.input.tracked_objects import TrackedObjects
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal, edges_of
from push_ident.planning.goal import Target
from push_ident.planning.goal_ports import KnownModel, Wish
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_steps import PathStep
from push_ident.planning.planner import GoalPush
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.steering import PathRequest, ToolCorrection
from push_ident.pushing.tool_path import ToolPath
from push_ident.types import Float64Array
from push_ident_msgs.action import ExecutePush

__all__ = ["CellPorts", "CellView", "Steering", "WishOfClient"]


class WishOfClient:
    """What the client of one goal wants; other threads change it."""

    def __init__(self, is_cancel_requested: Callable[[], bool]) -> None:
        self._is_cancel_requested = is_cancel_requested
        self._hold, self._finish = threading.Event(), threading.Event()

    def hold(self) -> None:
        """The arm holds and the goal ends."""
        self._hold.set()

    def finish(self) -> None:
        """The goal ends after the push under way."""
        self._finish.set()

    @property
    def is_superseded(self) -> bool:
        """Whether a newer goal has come."""
        return self._finish.is_set()

    def __call__(self) -> Wish:
        """As `GoalPorts.wish`."""
        if self._hold.is_set() or self._is_cancel_requested():
            return Wish.HOLD
        return Wish.FINISH if self._finish.is_set() else Wish.GO_ON


@dataclass(frozen=True, slots=True)
class Steering:
    """How pushes along paths are corrected."""

    values: Callable[[], SteeringValues]
    """The numbers of it."""
    send: Callable[[ToolCorrection], None]
    """Publishes a correction."""
    guard: Callable[[str], Any]
    """`Guard.watch`."""


class CellView:
    """What all goals share: objects, models, table, executor, planners."""

    def __init__(
        self,
        objects: TrackedObjects,
        models: ModelInput,
        table: TableInput,
        executor: ExecutorLink,
        planners: GoalPlanners,
        settings: Callable[[], PushSettings | None],
        steering: Steering,
    ) -> None:
        self.objects, self.models, self.table, self.executor = objects, models, table, executor
        self.planners, self.settings, self.steering, self.path_planners = planners, settings, steering, PathPlanners()
        self.steered: SteeredPush | None = None
        """The latest push along a path."""


class CellPorts:
    """Of one goal.

    Args:
        view: of the cell.
        wish: of the client.
        executor_timeout: longest silence of the executor during a push [s].
    """

    def __init__(self, view: CellView, wish: WishOfClient, executor_timeout: float) -> None:
        self._view, self.wish, self._executor_timeout = view, wish, executor_timeout

    def now(self) -> float:
        """As `GoalPorts`."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """As `GoalPorts`."""
        time.sleep(seconds)

    def observe(self, object_id: str, max_age: float, after: float) -> TrackedObject | None:
        """As `GoalPorts`."""
        try:
            return self._view.objects.get(object_id, min(max_age, time.monotonic() - after))
        except PlanningError:
            return None

    def why_unseen(self, object_id: str) -> str:
        """As `GoalPorts`."""
        try:
            self._view.objects.get(object_id, math.inf)
        except PlanningError as error:
            return str(error)
        return f"there is no new pose of `{object_id}`."

    def obstacles(self, object_id: str) -> list[Float64Array]:
        """As `GoalPorts`."""
        return self._view.objects.outlines_of_others(object_id)

    def model(self, object_id: str) -> KnownModel | None:
        """As `GoalPorts`."""
        return self._view.models.get(object_id)

    def pushed_at(self, object_id: str) -> float:
        """As `GoalPorts`."""
        return self._view.executor.pushed_at(object_id)

    def push_settings(self) -> PushSettings | None:
        """As `GoalPorts`."""
        return self._view.settings()

    def known_edges(self) -> Sequence[TableEdge]:
        """As `GoalPorts`."""
        table = self._view.table.get()
        return [] if table is None else edges_of(table)

    def begin_target(
        self, model: KnownModel, tracked: TrackedObject, goal: EdgeGoal, edges: Sequence[TableEdge], chosen: Target | None
    ) -> WorkUnderWay[Target]:
        """As `GoalPorts`."""
        return self._view.planners.begin_target(model.posterior, self._settings(), tracked, goal, edges, chosen)

    def begin_plan(
        self, model: KnownModel, tracked: TrackedObject, target: Target, obstacles: list[Float64Array], failed: list[PushPlan2D]
    ) -> WorkUnderWay[GoalPush]:
        """As `GoalPorts`."""
        return self._view.planners.begin(model.posterior, self._settings(), tracked, target, obstacles, failed)

    def _settings(self) -> PushSettings:
        settings = self._view.settings()
        assert settings is not None, "the goal was checked"
        return settings

    def begin_push(self, object_id: str, push: PushPlan2D | int) -> RequestedPush:
        """As `GoalPorts`."""
        if isinstance(push, int):
            goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, seed=push % 2**32)
        else:
            goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_CONTACT, object_id=object_id, frame_id=TABLE_FRAME)
            goal.contact_point = Point(x=float(push.contact_point[0]), y=float(push.contact_point[1]), z=0.0)
            goal.direction, goal.distance, goal.speed = float(push.direction), float(push.distance), float(push.speed)
        return self._view.executor.begin(goal, self._executor_timeout)

    def begin_step(
        self,
        model: KnownModel,
        tracked: TrackedObject,
        path: PathGoal,
        done: float,
        obstacles: list[Float64Array],
        failed: list[PushPlan2D],
        *,
        steers: bool,
    ) -> WorkUnderWay[PathStep]:
        """As `PathPorts`."""
        width = self._view.steering.values().half_width
        planners = self._view.path_planners
        return planners.begin(model.posterior, self._settings(), width, tracked, (path, done), (obstacles, failed), steers)

    def begin_steered(self, tracked: TrackedObject, step: PathStep, path: PathGoal) -> SteeredPush:
        """As `PathPorts`."""
        plan, steering = step.steered, self._view.steering
        assert plan is not None and step.follower is not None, "a push whose tool is steered"
        assert plan.time is not None and plan.tool is not None and plan.corridor is not None, "it has a path"
        values = steering.values()
        request = PathRequest(ToolPath(plan.time, plan.tool), plan.corridor, values.timeout)
        self._view.steered = SteeredPush(
            self._view.executor.begin(path_goal(tracked.object_id, request), self._executor_timeout),
            step.follower(values.lead),
            plan,
            tracked,
            observe=partial(self._view.objects.get, max_age=np.inf),
            send=steering.send,
            guard=steering.guard,
        )
        return self._view.steered
