"""Node that makes the arm push: action `execute_push`, one push at a time, supervised from start to end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, PoseStamped
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from shape_msgs.msg import SolidPrimitive
from std_srvs.srv import Trigger

from push_ident.errors import InputError
from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.nodes.base.cell_node import LATCHED, CellNode, Component, Health
from push_ident.nodes.base.frames import MovingFrames, StaticFrames
from push_ident.nodes.base.keep_alive import ClientWatch
from push_ident.nodes.convert.messages import TABLE_FRAME, position_to_msg, pusher_shape_to_msg, stamp_to_msg
from push_ident.nodes.convert.tool_path import correction_from_msg, path_request_from_goal
from push_ident.nodes.input.objects import TrackedObjects
from push_ident.nodes.push_executor.arm_port import ArmLease, ArmPort, ForcePort
from push_ident.nodes.push_executor.controller_goals import TrajectoryController, make_controller
from push_ident.nodes.push_executor.gripper_port import GripperHand
from push_ident.nodes.push_executor.hand_port import make_hand
from push_ident.nodes.push_executor.parameters import PARAMETERS, execution_settings
from push_ident.nodes.push_executor.settings import EXECUTOR
from push_ident.nodes.recording.recording_port import RecordingPort
from push_ident.pushing.executed_push import ExecutedPush
from push_ident.pushing.execution import PushExecution
from push_ident.pushing.ports import ArmState, ExecutionPorts, Phase
from push_ident.pushing.push import PushCode, PushPlan2D
from push_ident.pushing.push_request import Mode, PushOutcome, PushRequest
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushCorrection, PushRecord


class _NodeClock:
    """`pushing.ports.Clock` of a node."""

    def __init__(self, node: Node) -> None:
        self._node = node

    @property
    def is_simulated(self) -> bool:
        return bool(self._node.get_parameter("use_sim_time").value)

    def now(self) -> float:
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)

    def monotonic(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)


class _GoalClient:
    """`pushing.ports.Client` behind a goal of the action."""

    def __init__(self, goal: ServerGoalHandle, why_gone: Callable[[], str]) -> None:
        self._goal, self._why_gone = goal, why_gone
        self._push_id, self._start = 0, Time()

    @property
    def why_over(self) -> str:
        return "canceled on request" if self._goal.is_cancel_requested else self._why_gone()

    def feedback(self, phase: Phase, progress: float) -> None:
        msg = ExecutePush.Feedback(phase=int(phase), progress=float(min(progress, 1.0)), push_id=self._push_id, start=self._start)
        self._goal.publish_feedback(msg)

    def began(self, push_id: int, start: float) -> None:
        self._push_id, self._start = push_id, stamp_to_msg(max(start, 0.0))


class PushExecutorNode(CellNode):
    """Serves `execute_push` and `close_hand`; publishes the path of the tool in `pusher/pose` and each push in `push_record`.

    Only an active node moves the arm: when it is deactivated, cleaned up or shut down during a push, it holds the arm first.
    """

    # The watch over a moving arm keeps one thread; its cancellation, the joint states and a transition need one each.
    n_threads = 5
    yields = False

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("push_executor_node", PARAMETERS, check=execution_settings, **kwargs)

    def make_component(self) -> Component:
        """The lease of the arm, the ports of the cell and the action."""
        return _PushExecutor(self)


class _PushExecutor(Component):
    def __init__(self, node: CellNode) -> None:
        self._node, self._settings = node, node.settings
        values = self._settings.as_dict()
        self._tool_stamp = -np.inf
        self._last_error = ""
        self._is_active = False
        self._answered = threading.Event()
        self._answered.set()
        self._n_received_before = 0

        self._tool_pub = node.create_publisher(PoseStamped, "tool/pose", 10)
        self._frames = (MovingFrames(node), StaticFrames(node)) if values["publish_tf"] else None
        self._pusher_pub = node.create_publisher(PoseStamped, "pusher/pose", 10)
        self._record_pub = node.create_publisher(PushRecord, "push_record", 10)
        self._shape_pub = node.create_publisher(SolidPrimitive, "pusher/shape", LATCHED)
        tool = execution_settings(values).push.tool
        self._has_yaw = not tool.is_cylinder
        self._shape_pub.publish(pusher_shape_to_msg(tool, values["pusher_height"]))

        self._make_ports(values)
        # As poses: the newest counts, and one that is lost is followed by the next.
        node.create_subscription(
            PushCorrection,
            "push_correction",
            lambda msg: self._execution.correct(correction_from_msg(msg)),
            qos_profile_sensor_data,
            callback_group=MutuallyExclusiveCallbackGroup(),
        )
        self._clients = ClientWatch(node, "execute_push")
        node.create_service(Trigger, "close_hand", self._on_close_hand, callback_group=MutuallyExclusiveCallbackGroup())
        node.create_action_server(ExecutePush, "execute_push", self._execute, failed=self._failed, callback_group=ReentrantCallbackGroup())
        # Last: what fails after it would keep the lease.
        self._lease = ArmLease(node.context.get_domain_id(), node.resolve_topic_name("joint_trajectory"))

    def _make_ports(self, values: dict[str, Any]) -> None:
        node, supervised, housekeeping = self._node, MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        self._cell_clock = _NodeClock(node)
        self._force = ForcePort(node, supervised)
        self._hand = make_hand(node, values, housekeeping)
        self._recording = RecordingPort(node, housekeeping)
        self._objects = TrackedObjects(node, housekeeping, lambda: self._is_active and self._execution.is_pushing)
        self._controller = make_controller(
            node, values["free_motions"], path_tolerance=values["path_tolerance"], goal_tolerance=values["goal_tolerance"]
        )
        self._arm = ArmPort(
            node,
            description_file=values["robot_description_file"],
            tip_frame=values["tip_frame"],
            neutral=values["neutral_posture"],
            callback_group=supervised,
            on_state=self._on_arm_state,
            controller=self._controller,
        )
        self._execution = PushExecution(
            ExecutionPorts(self._arm, self._hand, self._force, self._recording, self._objects, self._cell_clock),
            on_push=lambda push: self._record_pub.publish(_record_to_msg(push)),
            on_warning=node.get_logger().warning,
        )

    def resume(self) -> None:
        self._execution.start()
        self._is_active = True

    def pause(self) -> None:
        """Hold the arm if it moves; returns when no push is under way any more, after 1 s at most."""
        self._is_active = False
        self._execution.stop(1.0)
        self._answered.wait(EXECUTOR.answer_wait)

    def close(self) -> None:
        self._lease.release()
        for part in (self._controller, self._hand):
            if isinstance(part, (TrajectoryController, GripperHand)):
                part.close()

    # ---- requests

    def _execute(self, goal: ServerGoalHandle) -> ExecutePush.Result:
        self._answered.clear()
        try:
            settings = execution_settings(self._settings.as_dict())
            with self._clients.over(goal, settings.limits.patience(self._settings["client_timeout"])) as why_gone:
                outcome = self._execution.execute(_request_from_goal(goal.request), settings, _GoalClient(goal, why_gone))
            return self._answer(goal, outcome)
        finally:
            self._answered.set()

    def _answer(self, goal: ServerGoalHandle, outcome: PushOutcome) -> ExecutePush.Result:
        result = _result_to_msg(outcome)
        if outcome.error is None:
            goal.succeed()
            return result
        self._last_error = f"{PushCode(outcome.error.code).name}: {outcome.error}"
        self._node.get_logger().error(f"execute_push: {self._last_error}")
        if outcome.error.code == PushCode.CANCELED and goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return result

    def _failed(self, why: str) -> ExecutePush.Result:
        code = PushCode.INVALID_GOAL if self._is_active else PushCode.BUSY
        self._last_error = f"{code.name}: {why}"
        return ExecutePush.Result(error_code=int(code), error_text=why)

    def _on_close_hand(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._is_active:
            raise InputError("The node is not active; activate it.")
        reason = self._execution.close_hand(self._settings["hand_close_timeout"])
        response.success, response.message = not reason, reason or "the hand is closed"
        return response

    # ---- what is published

    def _on_arm_state(self, state: ArmState, stamp: Time) -> None:
        if 0.0 <= state.stamp - self._tool_stamp < EXECUTOR.tool_period - 1e-4:
            return
        self._tool_stamp = state.stamp
        axis = state.pose_tip_in_table[:2, 0]
        msg = position_to_msg(stamp, state.pose_tip_in_table[:3, 3], yaw=float(np.arctan2(axis[1], axis[0])) if self._has_yaw else 0.0)
        if self._execution.is_pushing:
            self._pusher_pub.publish(msg)
        turn = msg.pose.orientation
        turn.x, turn.y, turn.z, turn.w = quaternion_of_pose(state.pose_tip_in_table)
        self._tool_pub.publish(msg)
        if self._frames is not None:
            moving, static = self._frames
            # A robot_state_publisher with the description of the nodes has that link already.
            if (tip := self._settings["tip_frame"]) not in static:
                moving.broadcast(stamp, {tip: msg.pose})

    def health(self) -> Health:
        rate = self._arm.n_received - self._n_received_before
        self._n_received_before = self._arm.n_received
        silent = self._arm.silence > self._settings["arm_timeout"]
        no_clock = self._cell_clock.is_simulated and self._cell_clock.now() == 0.0
        because = f": {self._arm.why_silent}" if self._arm.why_silent else ""
        hand, recording = self._hand.why_no_fist(), self._recording.fault
        reasons = [
            text for text, true in ((f"arm silent{because}", silent), ("use_sim_time is set but /clock is silent", no_clock)) if true
        ]
        reasons += [text for text in (hand, recording, self._arm.description_fault) if text]
        level = DiagnosticStatus.OK
        if silent or hand or recording:
            level = DiagnosticStatus.ERROR
        elif no_clock or not self._objects.ids or self._arm.description_fault:
            level = DiagnosticStatus.WARN
        state = "no objects" if not self._objects.ids else "ready" if self._execution.is_idle else "pushing"
        values = {
            "joint_states [1/s]": rate,
            "joint_states dropped": self._arm.n_dropped,
            "objects": ", ".join(self._objects.ids),
            "pushes": self._execution.n_pushes,
            "largest force of the last motion [N]": f"{self._execution.peak_force:.1f}",
            "last error": self._last_error,
        }
        return Health(level, "; ".join(reasons) or state, values | self._objects.notes)


def _request_from_goal(goal: ExecutePush.Goal) -> PushRequest:
    return PushRequest(
        mode=int(goal.mode),
        object_id=goal.object_id,
        frame_id=goal.frame_id,
        contact_point=(float(goal.contact_point.x), float(goal.contact_point.y)),
        direction=float(goal.direction),
        distance=float(goal.distance),
        speed=float(goal.speed),
        seed=int(goal.seed),
        dry_run=bool(goal.dry_run),
        path=path_request_from_goal(goal) if goal.mode == Mode.PATH else None,
    )


def _result_to_msg(outcome: PushOutcome) -> ExecutePush.Result:
    result = ExecutePush.Result(push_id=outcome.push_id, recentre_push_id=outcome.recentre_push_id)
    result.corrections, result.corrections_refused = outcome.n_corrections, outcome.n_refused
    if outcome.plan is not None:
        push = outcome.plan.push
        result.contact_point = _point(push)
        result.direction, result.distance, result.speed = push.direction, push.distance, push.speed
        result.tool_path.header.frame_id = TABLE_FRAME
        times, tips = outcome.plan.tool_path
        yaws = np.zeros(len(times)) if outcome.plan.tool_yaw is None else outcome.plan.tool_yaw
        path = zip(times, tips, yaws.tolist(), strict=True)
        result.tool_path.poses = [position_to_msg(stamp_to_msg(max(t, 0.0)), tip, yaw=yaw) for t, tip, yaw in path]
    if outcome.error is not None:
        result.error_code, result.error_text = int(outcome.error.code), str(outcome.error)
    return result


def _record_to_msg(made: ExecutedPush) -> PushRecord:
    push, error = made.plan.push, made.error
    start, stop, end = made.times()
    msg = PushRecord(push_id=made.push_id, purpose=int(made.purpose), object_id=made.before.object_id, contact_point=_point(push))
    msg.header.frame_id = TABLE_FRAME
    msg.header.stamp = msg.end = stamp_to_msg(max(end, 0.0))
    msg.start, msg.stop = stamp_to_msg(max(start, 0.0)), stamp_to_msg(max(stop, 0.0))
    if error is not None:
        msg.error_code, msg.error_text = int(error.code), str(error)
    if made.contact is not None and (error is None or error.code != PushCode.NO_CONTACT):
        msg.contact = stamp_to_msg(made.contact)
    msg.direction, msg.distance, msg.speed = push.direction, push.distance, push.speed
    return msg


def _point(push: PushPlan2D) -> Point:
    return Point(x=float(push.contact_point[0]), y=float(push.contact_point[1]), z=0.0)
