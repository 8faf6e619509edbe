"""`planning.goal_ports.GoalPorts` of a cell on ROS: models, plans, and pushes that this process may correct at the rate of the poses."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from geometry_msgs.msg import Point
from rclpy.callback_groups import CallbackGroup

from push_ident.errors import PlanningError
from push_ident.geometry.frames import TABLE_FRAME
from push_ident.identification.results.known_effects import effects_text
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.nodes.base.cell_node import LATCHED, CellNode
from push_ident.nodes.convert.model import posterior_from_msg
from push_ident.nodes.convert.tool_path import path_goal, turning_goal
from push_ident.nodes.goal_pushing.executor_link import ExecutorLink, RequestedPush
from push_ident.nodes.goal_pushing.parameters import GOAL_PUSHING
from push_ident.nodes.input.objects import ObjectTopics, TrackedObjects
from push_ident.nodes.input.occupancy import OccupancyInput
from push_ident.nodes.input.table import TableInput
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.planning.curved_planner import CurvedPush
from push_ident.planning.edge_goal import EdgeGoal, edge_target, edges_of, held_target
from push_ident.planning.goal import Target
from push_ident.planning.goal_ports import KnownModel, PushReport, Wish
from push_ident.planning.obstacle import Obstacle
from push_ident.planning.path_follower import Correction, FollowStatus, PathFollower
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_steps import PathStep, PathSteps
from push_ident.planning.planner import GoalPlanner, GoalPush
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.steering import PathRequest, ToolCorrection
from push_ident.pushing.tool_path import ToolPath
from push_ident.types import Float64Array, ObjectShape
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import ModelPosterior as ModelPosteriorMsg

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


class Planners(Generic[K, P]):
    """Belief and planner of each object, which keeps what it has simulated; another planner for another outline or another key.

    One plan at a time.
    """

    def __init__(self, n_kept: int, make: Callable[[ObjectShape, K], P]) -> None:
        self._n_kept, self._make = n_kept, make
        self._known: dict[str, tuple[Belief, K, P]] = {}
        self._one_at_a_time = threading.Lock()

    def prepare(self, work: Callable[[], object]) -> None:
        """Begin with something that plans wait for."""

        def prepared() -> None:
            with self._one_at_a_time:
                work()

        threading.Thread(target=prepared, name="compile", daemon=True).start()

    def begin(self, object_id: str, posterior: ModelPosterior, key: K, plan: Callable[[Belief, P], T]) -> WorkUnderWay[T]:
        """Begin to `plan` for an object."""

        def work() -> T:
            with self._one_at_a_time:
                return plan(*self._get(object_id, posterior, key))

        return WorkUnderWay(work)

    def _get(self, object_id: str, posterior: ModelPosterior, key: K) -> tuple[Belief, P]:
        known, shape = self._known.pop(object_id, None), posterior.unknowns.shape
        if known is None or known[1] != key or not np.array_equal(known[0].shape.outline, shape.outline):
            known = (Belief.of(posterior), key, self._make(shape, key))
        elif known[0].posterior is not posterior:
            known = (Belief.of(posterior), key, known[2])
        self._known[object_id] = known
        while len(self._known) > self._n_kept:
            del self._known[next(iter(self._known))]
        return known[0], known[2]


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


class ModelInput:
    """The latest model of every object; a message that cannot be used does not replace the one before."""

    def __init__(self, node: CellNode, callback_group: CallbackGroup) -> None:
        self._node, self._group = node, callback_group
        self._models: dict[str, KnownModel] = {}
        self._effects: dict[str, str] = {}
        self._topics = ObjectTopics(node, self._subscribe, callback_group=callback_group)

    def get(self, object_id: str) -> KnownModel | None:
        """The model of an object; None before one was published."""
        return self._models.get(object_id)

    def n_pushes(self) -> dict[str, int]:
        """Pushes in the model of each object."""
        return {object_id: model.n_pushes for object_id, model in sorted(self._models.items())}

    def effects(self) -> dict[str, str]:
        """Diagnosed effects in the model of each object that has some, with their values."""
        return {object_id: text for object_id, text in sorted(self._effects.items()) if text}

    def _subscribe(self, object_id: str) -> None:
        self._node.create_subscription(
            ModelPosteriorMsg, f"objects/{object_id}/model", partial(self._on_model, object_id), LATCHED, callback_group=self._group
        )

    def _on_model(self, object_id: str, msg: ModelPosteriorMsg) -> None:
        stamp, posterior = posterior_from_msg(msg)
        self._effects[object_id] = effects_text(posterior)
        self._models[object_id] = KnownModel(posterior, stamp, int(msg.n_pushes), bool(msg.is_known))


class SteeredPush:
    """`planning.goal_ports.SteeredUnderWay`.

    Args:
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
        self._send(_correction(correction, push_id, tracked.stamp))
        self.seconds = [*self.seconds, time.perf_counter() - begun][-GOAL_PUSHING.n_correction_times :]
        self.n_corrections += 1
        self.done, self.tool = correction.done, correction.tool
        if correction.status is not FollowStatus.GOING:
            self.ended = correction.status.value


def _correction(correction: Correction, push_id: int, stamp: float) -> ToolCorrection:
    is_over = correction.status is not FollowStatus.GOING
    return ToolCorrection(push_id, stamp, is_over, correction.time - correction.time[0], correction.tool)


@dataclass(slots=True)
class CellView:
    """What all goals share."""

    objects: TrackedObjects
    models: ModelInput
    table: TableInput
    occupancy: OccupancyInput
    executor: ExecutorLink
    values: Callable[[], dict[str, Any]]
    """Parameters of the node."""
    settings: Callable[[], PushSettings | None]
    """Limits of the pushes; None before the pusher is known."""
    send: Callable[[ToolCorrection], None]
    """Publishes a correction of a push along a path."""
    guard: Callable[[str], Any]
    """`Guard.watch`."""
    planners: Planners[PushSettings, GoalPlanner] = field(default_factory=lambda: Planners(GOAL_PUSHING.n_planners, GoalPlanner))
    path_planners: Planners[tuple[PushSettings, float], PathSteps] = field(
        default_factory=lambda: Planners(GOAL_PUSHING.n_path_planners, lambda shape, key: PathSteps(shape, *key))
    )
    """By the width of the corridor of a steered push [m], too."""
    steered: SteeredPush | None = None
    """The latest push along a path."""


class CellPorts:
    """Of one goal.

    Args:
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

    def obstacles(self, object_id: str) -> list[Obstacle]:
        """As `GoalPorts`."""
        return self._view.occupancy.beside(object_id)

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
        settings = self._settings()

        def choose(belief: Belief, _: GoalPlanner) -> Target:
            if chosen is not None and chosen.hold is not None:
                return held_target(chosen.goal, chosen.hold, belief)
            return edge_target(goal, edges, belief, tracked.pose, settings)

        return self._view.planners.begin(tracked.object_id, model.posterior, settings, choose)

    def begin_plan(
        self, model: KnownModel, tracked: TrackedObject, target: Target, obstacles: list[Float64Array], failed: list[PushPlan2D]
    ) -> WorkUnderWay[GoalPush]:
        """As `GoalPorts`."""
        pose, covariance = tracked.pose, tracked.covariance

        def plan(belief: Belief, planner: GoalPlanner) -> GoalPush:
            return planner.plan(belief, pose, covariance, target.goal, obstacles, failed, target.hold)

        return self._view.planners.begin(tracked.object_id, model.posterior, self._settings(), plan)

    def begin_random(self, model: KnownModel, tracked: TrackedObject, obstacles: list[Float64Array], seed: int) -> WorkUnderWay[PushPlan2D]:
        """As `GoalPorts`."""

        def choose(belief: Belief, planner: GoalPlanner) -> PushPlan2D:
            return planner.random_push(belief, tracked.pose, tracked.covariance, obstacles, seed)

        return self._view.planners.begin(tracked.object_id, model.posterior, self._settings(), choose)

    def _settings(self) -> PushSettings:
        settings = self._view.settings()
        assert settings is not None, "the goal was checked"
        return settings

    def begin_push(self, object_id: str, push: PushPlan2D | ToolPath | int) -> RequestedPush:
        """As `GoalPorts`."""
        if isinstance(push, ToolPath):
            goal = turning_goal(object_id, push)
        elif isinstance(push, int):
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
        key = self._settings(), self._view.values()["path_corridor"]

        def plan(belief: Belief, steps: PathSteps) -> PathStep:
            return steps.plan(belief, tracked.pose, path, done, obstacles, failed, steers=steers)

        return self._view.path_planners.begin(tracked.object_id, model.posterior, key, plan)

    def begin_steered(self, tracked: TrackedObject, step: PathStep, path: PathGoal) -> SteeredPush:
        """As `PathPorts`."""
        plan, values = step.steered, self._view.values()
        assert plan is not None and step.follower is not None, "a push whose tool is steered"
        assert plan.time is not None and plan.tool is not None and plan.corridor is not None, "it has a path"
        request = PathRequest(ToolPath(plan.time, plan.tool), plan.corridor, values["path_timeout"])
        self._view.steered = SteeredPush(
            self._view.executor.begin(path_goal(tracked.object_id, request), self._executor_timeout),
            step.follower(values["path_lead"]),
            plan,
            tracked,
            observe=partial(self._view.objects.get, max_age=np.inf),
            send=self._view.send,
            guard=self._view.guard,
        )
        return self._view.steered
