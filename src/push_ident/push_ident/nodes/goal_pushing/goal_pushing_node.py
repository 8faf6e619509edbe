"""Node `goal_pushing`: pushes an object to a goal pose, along a path or out over an edge of the table, and learns from each push."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PolygonStamped
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.qos import qos_profile_sensor_data
from shape_msgs.msg import SolidPrimitive
from visualization_msgs.msg import MarkerArray

from push_ident.errors import PushIdentError
from push_ident.limits import plain_text
from push_ident.nodes.base.cell_node import LATCHED, CellNode, Component, Health
from push_ident.nodes.base.keep_alive import ClientWatch
from push_ident.nodes.convert.markers import GoalDrawing, goal_markers_to_msg
from push_ident.nodes.convert.messages import pusher_shape_from_msg
from push_ident.nodes.convert.table import EDGE_TOPIC, edge_to_msg
from push_ident.nodes.convert.tool_path import correction_to_msg
from push_ident.nodes.goal_pushing.cell_ports import CellPorts, CellView, ModelInput, WishOfClient
from push_ident.nodes.goal_pushing.convert_goal import draw_goal, feedback_to_msg, request_from_msg, result_to_msg
from push_ident.nodes.goal_pushing.executor_link import ExecutorLink
from push_ident.nodes.goal_pushing.parameters import GOAL_PUSHING, PARAMETERS, check_values, push_settings
from push_ident.nodes.input.objects import TrackedObjects
from push_ident.nodes.input.occupancy import OccupancyInput
from push_ident.nodes.input.table import TableInput
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal import GoalCode, GoalRefusedError
from push_ident.planning.goal_ports import GoalOutcome, GoalProgress, GoalRequest, GoalState, SessionLimits, Wish
from push_ident.planning.goal_session import GoalSession
from push_ident.planning.library import compile_planning
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_session import PathSession
from push_ident.pushing.push import PushSettings
from push_ident.types import PusherShape
from push_ident_msgs.action import PushToGoal
from push_ident_msgs.msg import PushCorrection


class GoalPushingNode(CellNode):
    """Serves `push_to_goal`; moves the arm through `execute_push` only.

    A newer goal preempts the previous one, unless it is refused. When the node is deactivated, cleaned up or shut down, the arm
    holds.
    """

    # A goal that pushes and one that waits for it keep a thread each; poses, models, answers of the executor and cancellations need theirs.
    n_threads = 7

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("goal_pushing_node", PARAMETERS, check=check_values, **kwargs)

    def make_component(self) -> Component:
        """Inputs from the cell, the client of the executor, and the action."""
        return _GoalPushing(self)


class _GoalPushing(Component):
    def __init__(self, node: CellNode) -> None:
        self._node, self._settings = node, node.settings
        self._tool: PusherShape | None = None
        self._is_active = False
        self._wishes: set[WishOfClient] = set()
        self._lock = threading.Lock()  # of the wishes
        self._arm = threading.Lock()  # held by the goal that pushes
        self._pushing: WishOfClient | None = None
        self._state = "ready"
        self._n_goals = self._n_reached = 0
        self._last = ""
        self._drawn: tuple[object, ...] | None = None
        """What the markers that were published last were made of."""
        self._markers = node.create_publisher(MarkerArray, "push_to_goal/markers", LATCHED)
        self._edge = node.create_publisher(PolygonStamped, EDGE_TOPIC, LATCHED)
        housekeeping, heavy = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        self._objects = TrackedObjects(node, housekeeping, lambda: self._pushing is not None)
        self._models = ModelInput(node, heavy)
        node.create_subscription(SolidPrimitive, "pusher/shape", self._on_pusher_shape, LATCHED, callback_group=housekeeping)
        self._executor = ExecutorLink(node)
        self._clients = ClientWatch(node, "push_to_goal")
        table = TableInput(node, housekeeping)
        corrections = node.create_publisher(PushCorrection, "push_correction", qos_profile_sensor_data)
        self._view = CellView(
            self._objects,
            self._models,
            table,
            OccupancyInput(node, heavy, self._objects, self._settings["workspace"]),
            self._executor,
            self._settings.as_dict,
            self._push_settings,
            lambda correction: corrections.publish(correction_to_msg(correction)),
            node.guard.watch,
        )
        self._view.planners.prepare(compile_planning)
        node.create_action_server(PushToGoal, "push_to_goal", self._execute, failed=_failed, callback_group=ReentrantCallbackGroup())

    def resume(self) -> None:
        self._is_active = True

    def pause(self) -> None:
        """Hold the arm and end all goals, within a second."""
        self._is_active = False
        with self._lock:
            for wish in self._wishes:
                wish.hold()
        deadline = time.monotonic() + GOAL_PUSHING.hold_wait
        while self._wishes and time.monotonic() < deadline:
            time.sleep(GOAL_PUSHING.look_period)

    def close(self) -> None:
        self._executor.close()

    # ---- input

    def _on_pusher_shape(self, msg: SolidPrimitive) -> None:
        tool = pusher_shape_from_msg(msg)
        push_settings(self._settings.as_dict(), tool)
        self._tool = tool

    def _push_settings(self) -> PushSettings | None:
        return push_settings(self._settings.as_dict(), self._tool) if self._tool is not None else None

    # ---- the action

    def _execute(self, goal: ServerGoalHandle) -> PushToGoal.Result:
        with self._clients.over(goal, self._settings["client_timeout"]) as why_gone:
            return self._pursue(goal, why_gone)

    def _pursue(self, goal: ServerGoalHandle, why_gone: Callable[[], str]) -> PushToGoal.Result:
        wish = WishOfClient(lambda: bool(goal.is_cancel_requested or why_gone()))
        try:
            request = request_from_msg(goal.request, self._settings.as_dict())
            session = self._session(goal, request, wish)
            session.check()
            self._publish_edge(request)
        except PushIdentError as error:
            # The goal before goes on.
            code = error.code if isinstance(error, GoalRefusedError) else GoalCode.INVALID_GOAL
            self._node.guard.refuse("push_to_goal", f"{code.name}: {error}")
            goal.abort()
            return result_to_msg(GoalOutcome(code, str(error), GoalProgress()))
        with self._lock:
            for other in self._wishes:
                other.finish()
            self._wishes.add(wish)
            if not self._is_active:
                wish.hold()
        self._n_goals += 1
        try:
            outcome = self._run(session, wish)
        finally:
            with self._lock:
                self._wishes.discard(wish)
        if outcome.code is GoalCode.CANCELED and not goal.is_cancel_requested:
            if wish.is_superseded:
                outcome = replace(outcome, code=GoalCode.PREEMPTED, text="a newer goal took its place and was canceled; the arm holds.")
            elif why := why_gone():
                outcome = replace(outcome, text=f"{why}; the arm holds.")
            else:
                outcome = replace(outcome, text="the node was deactivated; the arm holds. Activate it and send the goal again.")
        return self._answer(goal, outcome)

    def _publish_edge(self, request: GoalRequest) -> None:
        """Publish the edge that a goal gives: identification must know which of its pushes overhung."""
        if isinstance(request.goal, EdgeGoal) and request.goal.edge is not None:
            self._edge.publish(edge_to_msg(request.goal.edge, self._node.get_clock().now().to_msg()))

    def _session(self, goal: ServerGoalHandle, request: GoalRequest, wish: WishOfClient) -> GoalSession:
        values = self._settings.as_dict()

        def show(progress: GoalProgress) -> None:
            self._state = progress.state.name.lower()
            if progress.note:
                self._node.get_logger().warning(plain_text(progress.note))
            with self._node.guard.watch("push_to_goal"):
                goal.publish_feedback(feedback_to_msg(progress))
                if self._pushing is wish:
                    self._draw(progress)

        kind = PathSession if isinstance(request.goal, PathGoal) else GoalSession
        limits = SessionLimits(**{field.name: values[field.name] for field in fields(SessionLimits) if field.name in values})
        return kind(request, CellPorts(self._view, wish, values["executor_timeout"]), limits, on_progress=show)

    def _run(self, session: GoalSession, wish: WishOfClient) -> GoalOutcome:
        """Push, once the push of the goal before has ended."""
        while not self._arm.acquire(timeout=GOAL_PUSHING.look_period):
            session.report()
            if wish() is Wish.HOLD and (before := self._pushing) is not None:
                before.hold()
            if wish() is not Wish.GO_ON:
                # The session reports that itself, without a step.
                return session.run()
        self._pushing = wish
        try:
            return session.run()
        finally:
            self._pushing, self._state = None, "ready"
            with self._node.guard.watch("push_to_goal"):
                self._publish_drawing(None)
            self._arm.release()

    def _draw(self, progress: GoalProgress) -> None:
        """Show the goal and the push under way, where they have changed."""
        shown = (progress.target, progress.state is GoalState.PUSH, progress.plan, progress.step, progress.tool)
        is_shown = self._drawn is not None and all(new is old for new, old in zip(shown, self._drawn, strict=True))
        if progress.target is None or not progress.object_id or is_shown:
            return
        self._publish_drawing(draw_goal(progress, self._objects.get(progress.object_id, math.inf).shape.outline))
        self._drawn = shown

    def _publish_drawing(self, drawing: GoalDrawing | None) -> None:
        self._drawn = None
        self._markers.publish(goal_markers_to_msg(drawing, self._node.get_clock().now().to_msg()))

    def _answer(self, goal: ServerGoalHandle, outcome: GoalOutcome) -> PushToGoal.Result:
        position, yaw = outcome.progress.error
        self._last = f"{outcome.code.name}, {outcome.progress.pushes} pushes, {1e3 * position:.1f} mm and {yaw:.3f} rad from the goal"
        if outcome.code is GoalCode.NONE:
            self._n_reached += 1
            self._node.get_logger().info(f"push_to_goal: {self._last}")
            goal.succeed()
        else:
            self._node.get_logger().warning(f"push_to_goal: {self._last}: {plain_text(outcome.text)}")
            if outcome.code is GoalCode.CANCELED and goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
        return result_to_msg(outcome)

    # ---- health

    def health(self) -> Health:
        served, models = self._executor.is_served, self._models.n_pushes()
        reasons = [
            text
            for text, is_missing in (
                ("execute_push is not served; is push_executor_node running?", not served),
                ("nothing on pusher/shape yet", self._tool is None),
                ("no objects; is perception running?", not self._objects.ids),
                ("no models; is identification running?", not models),
            )
            if is_missing
        ]
        values = {
            "objects": ", ".join(self._objects.ids),
            "pushes learned by object": models,
            "effects by object": "; ".join(f"{o}: {text}" for o, text in self._models.effects().items()) or "none",
            "goals": self._n_goals,
            "goals reached": self._n_reached,
            "corrections of the last push, median and 99 % [ms]": self._correction_times(),
            "last goal": self._last or "none",
        }
        return Health(
            DiagnosticStatus.WARN if reasons else DiagnosticStatus.OK, "; ".join(reasons) or self._state, values | self._objects.notes
        )

    def _correction_times(self) -> str:
        steered = self._view.steered
        if steered is None or not steered.seconds:
            return "none"
        median, most = np.quantile(steered.seconds, [0.5, 0.99])
        return f"{1e3 * median:.1f}, {1e3 * most:.1f}"


def _failed(why: str) -> PushToGoal.Result:
    return result_to_msg(GoalOutcome(GoalCode.INVALID_GOAL, why, GoalProgress()))
