"""Node that makes the arm push: action `execute_push`, one push at a time, watched all the way."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from shape_msgs.msg import SolidPrimitive
from std_srvs.srv import Trigger

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.nodes.convert import TABLE_FRAME, cylinder_to_msg, object_frame, position_to_msg, stamp_from_msg, stamp_to_msg
from push_ident.nodes.parameters import Parameters
from push_ident.nodes.push_executor.arm_lease import ArmLease
from push_ident.nodes.push_executor.arm_port import ArmPort, ArmState
from push_ident.nodes.push_executor.force_port import ForcePort
from push_ident.nodes.push_executor.hand_port import make_hand
from push_ident.nodes.push_executor.parameters import PARAMETERS, motion_settings, push_settings
from push_ident.nodes.push_executor.watch import ArmWatch, patience
from push_ident.nodes.recording_port import RecordingPort
from push_ident.nodes.run import run_node
from push_ident.nodes.seen_objects import SeenObject, SeenObjects
from push_ident.pushing.motion import ArmMotion, ArmPlan, plan_push, plan_retreat
from push_ident.pushing.push import PushCode, PushPlan2D
from push_ident.pushing.sampling import is_near_edge, push_from_goal, recentring_pushes, sample_push
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushRecord

__all__ = ["PARAMETERS", "PushExecutorNode", "main"]

_POLL = 0.01
"""[s] between two looks for the pose of an object."""
_TOOL_PERIOD = 1.0 / 60.0
_LAST_CALLBACKS = 0.1
"""[s] given to callbacks under way when the node stops."""
_PLANS = 20
"""Pushes tried, at random or back to the middle, before giving up on the arm's reach."""
_FEEDBACK_PERIOD = 0.1
_STANDSTILL = 0.15
"""[s] until an arm that was held stands."""
_DRIFT = 0.002
"""An object that was seen outside the workspace from the start may move so much further out [m]."""


@dataclass(slots=True)
class _Push:
    """A push to be made, and what became of it. Times in seconds of the node's clock."""

    purpose: int
    before: SeenObject
    plan: ArmPlan
    push_id: int = 0
    """0: it has not begun."""
    started: float = 0.0
    contact: float | None = None
    """When the measured tool passed the planned place of contact."""
    _last: tuple[float, float] | None = None

    def see(self, state: ArmState) -> None:
        """Take one state of the lowered tool."""
        push, stamp = self.plan.push, stamp_from_msg(state.stamp)
        travel = float((state.pose_tip_in_table[:2, 3] - push.tool_at_contact) @ push.heading)
        if self.contact is None and self._last is not None and self._last[1] < 0.0 <= travel:
            stamp_before, travel_before = self._last
            self.contact = stamp_before + (stamp - stamp_before) * travel_before / (travel_before - travel)
        self._last = (stamp, travel)


class PushExecutorNode(Node):
    """Serves `execute_push` and `close_hand`; tells by `pusher/pose` and `push_record` what the tool did."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("push_executor_node", **kwargs)
        self._settings = Parameters(self, PARAMETERS)
        values = self._settings.as_dict()
        push_settings(values), motion_settings(values)  # refuse contradictions now rather than at the first goal
        self._lease = ArmLease(self.context.get_domain_id(), self.resolve_topic_name("joint_trajectory"))

        self._one_push = threading.Lock()
        self._idle = threading.Event()
        self._idle.set()
        self._closing = threading.Event()
        self._pushing = False
        self._tool_stamp = -np.inf
        self._n_pushes = 0
        self._last_error = ""

        self._tool_pub = self.create_publisher(PoseStamped, "tool/pose", 10)
        self._pusher_pub = self.create_publisher(PoseStamped, "pusher/pose", 10)
        self._record_pub = self.create_publisher(PushRecord, "push_record", 10)
        self._diagnostics_pub = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._shape_pub = self.create_publisher(SolidPrimitive, "pusher/shape", latched)
        self._shape_pub.publish(cylinder_to_msg(values["pusher_radius"], values["pusher_height"]))

        watched = MutuallyExclusiveCallbackGroup()
        self._arm = ArmPort(
            self,
            description_file=values["robot_description_file"],
            tip_frame=values["tip_frame"],
            neutral=values["neutral_posture"],
            callback_group=watched,
            on_state=self._on_arm_state,
        )
        self._force = ForcePort(self, watched)
        housekeeping = MutuallyExclusiveCallbackGroup()
        self._hand = make_hand(self, values["hand"], timeout=values["hand_timeout"], callback_group=housekeeping)
        self._recording = RecordingPort(self, housekeeping)
        self._watch = ArmWatch(self._arm, self._hand, self._force, self._recording, self._now)
        self._objects = SeenObjects(self, housekeeping)
        self._n_received_before = 0
        self.create_timer(1.0, self._publish_diagnostics, callback_group=housekeeping, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.create_service(Trigger, "close_hand", self._on_close_hand, callback_group=MutuallyExclusiveCallbackGroup())
        self._server = ActionServer(
            self,
            ExecutePush,
            "execute_push",
            self._execute,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def close(self) -> None:
        """Hold the arm if it moves; returns when no push is under way any more, after 1 s at most."""
        self._closing.set()
        self._idle.wait(1.0)
        # Callbacks already in a thread of the executor must end before it goes: it does not wait for them itself.
        time.sleep(_LAST_CALLBACKS)
        self._lease.release()

    # One goal

    def _execute(self, goal: ServerGoalHandle) -> ExecutePush.Result:
        result = ExecutePush.Result()
        if not self._one_push.acquire(blocking=False):
            return self._end(goal, result, PlanningError(PushCode.BUSY, "another push is under way; wait for it or cancel it."))
        self._idle.clear()
        try:
            self._plan_and_run(goal, result)
        except PlanningError as error:
            return self._end(goal, result, error)
        except InputError as error:
            return self._end(goal, result, PlanningError(PushCode.INVALID_GOAL, str(error)))
        finally:
            self._one_push.release()
            self._idle.set()
        return self._end(goal, result, None)

    def _end(self, goal: ServerGoalHandle, result: ExecutePush.Result, error: PlanningError | None) -> ExecutePush.Result:
        if error is None:
            goal.succeed()
            return result
        result.error_code, result.error_text = int(error.code), str(error)
        self._last_error = f"{PushCode(error.code).name}: {error}"
        self.get_logger().error(f"execute_push: {self._last_error}")
        if error.code == PushCode.CANCELED and goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return result

    def _plan_and_run(self, goal: ServerGoalHandle, result: ExecutePush.Result) -> None:
        request: ExecutePush.Goal = goal.request
        self._feedback(goal, ExecutePush.Feedback.PHASE_PLAN, 0.0)
        values = self._settings.as_dict()
        if request.mode not in (ExecutePush.Goal.MODE_CONTACT, ExecutePush.Goal.MODE_RANDOM, ExecutePush.Goal.MODE_RECENTRE):
            raise PlanningError(
                PushCode.INVALID_GOAL, f"mode is {request.mode}, expected MODE_CONTACT (0), MODE_RANDOM (1) or MODE_RECENTRE (2)."
            )
        if not request.dry_run:
            self._watch.check_ready()
        seen = self._objects.get(request.object_id, values["pose_timeout"])
        if not request.dry_run and self._should_recentre(request, seen, values):
            self._refuse_nonsense(request, seen, values)
            self._recentre(goal, result, seen, values)
            seen = self._objects.get(seen.object_id, values["pose_timeout"])

        def plan_from(q: np.ndarray) -> ArmPlan:
            return self._plan(goal, seen, values, q)

        plan = plan_from(self._arm.next_state(values["arm_timeout"]).q)
        _fill_result(result, plan)
        if request.dry_run:
            return
        is_recentring = request.mode == ExecutePush.Goal.MODE_RECENTRE
        push = _Push(PushRecord.PURPOSE_RECENTRE if is_recentring else PushRecord.PURPOSE_REQUESTED, seen, plan)
        try:
            self._make(goal, push, plan_from, values, lambda elapsed: _phase(push.plan, elapsed))
        finally:
            _fill_result(result, push.plan)
            result.push_id = push.push_id

    def _should_recentre(self, request: ExecutePush.Goal, seen: SeenObject, values: dict[str, Any]) -> bool:
        """Only where the push asked for stays the same push wherever the object lies."""
        follows = request.mode == ExecutePush.Goal.MODE_RANDOM or (
            request.mode == ExecutePush.Goal.MODE_CONTACT and request.frame_id == object_frame(seen.object_id)
        )
        return bool(values["recentre"]) and follows and is_near_edge(seen.shape, seen.pose, push_settings(values))

    def _refuse_nonsense(self, request: ExecutePush.Goal, seen: SeenObject, values: dict[str, Any]) -> None:
        """Raise PlanningError INVALID_GOAL for a push that no place of the object makes possible: nothing may move for it."""
        if request.mode != ExecutePush.Goal.MODE_CONTACT:
            return
        try:
            self._push_asked_for(request, seen, values)
        except PlanningError as error:
            if error.code == PushCode.INVALID_GOAL:
                raise

    def _recentre(self, goal: ServerGoalHandle, result: ExecutePush.Result, seen: SeenObject, values: dict[str, Any]) -> None:
        """Push the object towards the middle, where such a push is possible."""

        def plan_from(q: np.ndarray) -> ArmPlan:
            return self._plan_recentring(goal, seen, values, q)

        try:
            push = _Push(PushRecord.PURPOSE_RECENTRE, seen, plan_from(self._arm.next_state(values["arm_timeout"]).q))
        except PlanningError as error:
            if error.code != PushCode.UNREACHABLE:
                raise
            self.get_logger().warning(f"`{seen.object_id}` is near the edge of the workspace and stays there: {error}")
            return
        try:
            self._make(goal, push, plan_from, values, lambda elapsed: int(ExecutePush.Feedback.PHASE_RECENTRE))
        except PlanningError as error:
            raise PlanningError(error.code, f"while the object was pushed back to the middle: {error}") from None
        finally:
            result.recentre_push_id = push.push_id

    def _make(
        self,
        goal: ServerGoalHandle,
        push: _Push,
        plan_from: Callable[[np.ndarray], ArmPlan],
        values: dict[str, Any],
        phase_at: Callable[[float], int],
    ) -> None:
        """Make one push, planned once more where the arm was moved, and publish its record once it has begun, however it ends.

        `phase_at` gives the phase to tell for a time since the start [s].
        """
        told, told_at = -1, -np.inf

        def on_start(motion: ArmMotion, started: float) -> None:
            assert isinstance(motion, ArmPlan)
            self._n_pushes += 1
            push.push_id, push.plan, push.started = self._n_pushes, motion, started

        def on_look(elapsed: float, state: ArmState) -> None:
            nonlocal told, told_at
            self._pushing = push.plan.lowered <= elapsed <= push.plan.rested
            if self._pushing:
                push.see(state)
                self._check_object(push, values)
            phase = phase_at(elapsed)
            if phase != told or elapsed - told_at > _FEEDBACK_PERIOD:
                told, told_at = phase, elapsed
                self._feedback(goal, phase, elapsed / push.plan.duration)

        error: PlanningError | None = None
        was_pushing = False
        try:
            try:
                self._watch.run(
                    push.plan, values, replan=plan_from, check_wanted=lambda: self._check_wanted(goal), on_start=on_start, on_look=on_look
                )
            finally:
                was_pushing, self._pushing = self._pushing, False
            self._check_contact(push, values)
        except PlanningError as failure:
            error = failure
        ended = self._now()
        if was_pushing and error is not None and error.code == PushCode.OBJECT_LOST:
            error = PlanningError(error.code, f"{error} {self._retreat(goal, push, values)}")
        if push.push_id:
            self._record_pub.publish(_record(push, ended, error))
        if error is not None:
            raise error

    def _retreat(self, goal: ServerGoalHandle, push: _Push, values: dict[str, Any]) -> str:
        """Leave after a push that was broken off, if a checked way leads home; what became of it."""
        settings, heading = motion_settings(values), push.plan.push.heading

        def plan_from(q: np.ndarray) -> ArmMotion:
            return plan_retreat(self._arm.planner, q, heading, settings)

        def look(elapsed: float, state: ArmState) -> None:
            self._feedback(goal, ExecutePush.Feedback.PHASE_RETREAT, 1.0)

        time.sleep(_STANDSTILL)
        try:
            motion = plan_from(self._arm.next_state(values["arm_timeout"]).q)
            self._watch.run(
                motion,
                values,
                replan=plan_from,
                check_wanted=lambda: self._check_wanted(goal),
                on_start=lambda motion, start: None,
                on_look=look,
            )
        except PlanningError as error:
            return f"The arm holds: {error}"
        return "The arm went home."

    def _plan(self, goal: ServerGoalHandle, seen: SeenObject, values: dict[str, Any], q_now: np.ndarray) -> ArmPlan:
        request: ExecutePush.Goal = goal.request
        if request.mode == ExecutePush.Goal.MODE_RECENTRE:
            return self._plan_recentring(goal, seen, values, q_now)
        motion = motion_settings(values)
        if request.mode == ExecutePush.Goal.MODE_CONTACT:
            return plan_push(self._arm.planner, q_now, self._push_asked_for(request, seen, values), motion)
        settings, obstacles = push_settings(values), self._objects.outlines_of_others(seen.object_id)
        rng = np.random.default_rng(int(request.seed))
        last_refusal: PlanningError | None = None
        for _ in range(_PLANS):
            self._check_wanted(goal)
            push = sample_push(seen.shape, seen.pose, rng, settings, obstacles)
            try:
                return plan_push(self._arm.planner, q_now, push, motion)
            except PlanningError as error:
                last_refusal = error
        raise PlanningError(PushCode.UNREACHABLE, f"none of {_PLANS} random pushes fits the arm; the last: {last_refusal}")

    def _push_asked_for(self, request: ExecutePush.Goal, seen: SeenObject, values: dict[str, Any]) -> PushPlan2D:
        point, direction = _contact_in_table(request, seen)
        distance, speed = request.distance or values["push_distance"], request.speed or values["push_speed"]
        obstacles = self._objects.outlines_of_others(seen.object_id)
        return push_from_goal(seen.shape, seen.pose, point, direction, distance, speed, push_settings(values), obstacles)

    def _plan_recentring(self, goal: ServerGoalHandle, seen: SeenObject, values: dict[str, Any], q_now: np.ndarray) -> ArmPlan:
        motion, last_refusal = motion_settings(values), "no contact from which the middle can be pushed to"
        pushes = recentring_pushes(seen.shape, seen.pose, push_settings(values), self._objects.outlines_of_others(seen.object_id))
        for _, push in zip(range(_PLANS), pushes, strict=False):
            self._check_wanted(goal)
            try:
                return plan_push(self._arm.planner, q_now, push, motion)
            except PlanningError as error:
                last_refusal = str(error)
        raise PlanningError(PushCode.UNREACHABLE, f"`{seen.object_id}` cannot be pushed towards the middle: {last_refusal}")

    def _check_open(self) -> None:
        if self._closing.is_set():
            raise PlanningError(PushCode.CANCELED, "the node was stopped; the arm holds.")

    def _check_wanted(self, goal: ServerGoalHandle) -> None:
        self._check_open()
        if goal.is_cancel_requested:
            raise PlanningError(PushCode.CANCELED, "canceled on request; the arm holds.")

    def _check_object(self, push: _Push, values: dict[str, Any]) -> None:
        """Raise PlanningError OBJECT_LOST when the object is not seen any more, or its origin has left the workspace."""
        try:
            seen = self._objects.get(push.before.object_id, patience(values, "lost_timeout"))
        except PlanningError as error:
            raise PlanningError(PushCode.OBJECT_LOST, f"lost during the push: {error}") from None
        settings = push_settings(values)
        excess, before = (settings.excess(pose[None, :2]) for pose in (seen.pose, push.before.pose))
        if excess > before + _DRIFT:
            x, y = seen.pose[:2]
            raise PlanningError(PushCode.OBJECT_LOST, f"`{seen.object_id}` left the workspace: it is at ({x:.3f}, {y:.3f}) m.")

    def _check_contact(self, push: _Push, values: dict[str, Any]) -> None:
        """Raise PlanningError NO_CONTACT when the object stayed, OBJECT_LOST when no pose came after the push."""
        before, stop = push.before, push.started + push.plan.stop
        deadline = time.monotonic() + values["pose_timeout"]
        after = self._objects.get(before.object_id, np.inf)
        while after.stamp <= stop:
            self._check_open()
            if time.monotonic() > deadline:
                raise PlanningError(PushCode.OBJECT_LOST, f"`{before.object_id}` was not seen after the push.")
            time.sleep(_POLL)
            after = self._objects.get(before.object_id, np.inf)
        shift = float(np.linalg.norm(after.pose[:2] - before.pose[:2]))
        turn = abs(float(wrap_angle(after.pose[2] - before.pose[2])))
        if shift <= values["min_object_shift"] and turn <= values["min_object_turn"]:
            raise PlanningError(
                PushCode.NO_CONTACT, f"`{before.object_id}` moved by {1e3 * shift:.1f} mm and {turn:.3f} rad only; was its pose right?"
            )

    def _on_close_hand(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._one_push.acquire(blocking=False):
            response.success, response.message = False, "a push is under way; wait for it or cancel it."
            return response
        try:
            reason = self._hand.close_fist(self._settings["hand_close_timeout"], self._closing.is_set)
        finally:
            self._one_push.release()
        response.success, response.message = not reason, reason or "the hand is a closed fist"
        return response

    # Publishing

    def _now(self) -> float:
        return 1e-9 * float(self.get_clock().now().nanoseconds)

    def _feedback(self, goal: ServerGoalHandle, phase: int, progress: float) -> None:
        goal.publish_feedback(ExecutePush.Feedback(phase=int(phase), progress=float(min(progress, 1.0))))

    def _on_arm_state(self, state: ArmState) -> None:
        stamp = stamp_from_msg(state.stamp)
        if 0.0 <= stamp - self._tool_stamp < _TOOL_PERIOD - 1e-4:
            return
        self._tool_stamp = stamp
        position = state.pose_tip_in_table[:3, 3]
        msg = position_to_msg(state.stamp, position)
        if self._pushing:
            self._pusher_pub.publish(msg)
        turn = msg.pose.orientation
        turn.x, turn.y, turn.z, turn.w = quaternion_of_pose(state.pose_tip_in_table)
        self._tool_pub.publish(msg)

    def _publish_diagnostics(self) -> None:
        rate = self._arm.n_received - self._n_received_before
        self._n_received_before = self._arm.n_received
        silent = self._arm.silence > self._settings["arm_timeout"]
        no_clock = bool(self.get_parameter("use_sim_time").value) and self._now() == 0.0
        hand, recording = self._hand.why_no_fist(), self._recording.fault
        reasons = [text for text, true in (("arm silent", silent), ("use_sim_time is set but /clock is silent", no_clock)) if true]
        reasons += [text for text in (hand, recording) if text]
        status = DiagnosticStatus(
            name=f"{self.get_name()}: pushing",
            level=DiagnosticStatus.ERROR
            if silent or hand or recording
            else DiagnosticStatus.WARN
            if no_clock or not self._objects.ids
            else DiagnosticStatus.OK,
            message="; ".join(reasons) or ("no objects seen" if not self._objects.ids else "ready" if self._idle.is_set() else "pushing"),
            hardware_id="",
        )
        for key, value in (
            ("joint_states [1/s]", rate),
            ("joint_states dropped", self._arm.n_dropped),
            ("objects", ", ".join(self._objects.ids)),
            ("pushes", self._n_pushes),
            ("largest force of the last motion [N]", f"{self._watch.peak_force:.1f}"),
            ("last error", self._last_error),
        ):
            status.values.append(KeyValue(key=key, value=str(value)))
        msg = DiagnosticArray(status=[status])
        msg.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_pub.publish(msg)


def _contact_in_table(request: ExecutePush.Goal, seen: SeenObject) -> tuple[np.ndarray, float]:
    """Contact point [m] and heading [rad] of a goal in the table frame."""
    point = np.array([request.contact_point.x, request.contact_point.y])
    if request.frame_id in ("", TABLE_FRAME):
        return point, float(request.direction)
    if request.frame_id == object_frame(seen.object_id):
        return transform_points(seen.pose, point[None])[0], float(request.direction + seen.pose[2])
    raise PlanningError(
        PushCode.INVALID_GOAL, f"frame_id is `{request.frame_id}`, expected `{TABLE_FRAME}` or `{object_frame(seen.object_id)}`."
    )


def _phase(plan: ArmPlan, elapsed: float) -> int:
    feedback = ExecutePush.Feedback
    if elapsed < plan.lowered:
        return int(feedback.PHASE_APPROACH)
    if elapsed < plan.stop:
        return int(feedback.PHASE_PUSH)
    return int(feedback.PHASE_REST if elapsed < plan.rested else feedback.PHASE_RETREAT)


def _point(push: PushPlan2D) -> Point:
    return Point(x=float(push.contact_point[0]), y=float(push.contact_point[1]), z=0.0)


def _fill_result(result: ExecutePush.Result, plan: ArmPlan) -> None:
    push = plan.push
    result.contact_point = _point(push)
    result.direction, result.distance, result.speed = push.direction, push.distance, push.speed
    result.tool_path.header.frame_id = TABLE_FRAME
    result.tool_path.poses = [position_to_msg(stamp_to_msg(max(t, 0.0)), tip) for t, tip in zip(*plan.tool_path, strict=True)]


def _record(under_way: _Push, now: float, error: PlanningError | None) -> PushRecord:
    """Record of a push that has ended by `now` [s]. A phase that was not reached has the time of the end."""
    plan, push, started = under_way.plan, under_way.plan.push, under_way.started
    end = min(started + plan.rested, now)
    msg = PushRecord(push_id=under_way.push_id, purpose=under_way.purpose, object_id=under_way.before.object_id, contact_point=_point(push))
    msg.header.frame_id = TABLE_FRAME
    msg.header.stamp = msg.end = stamp_to_msg(max(end, 0.0))
    msg.start, msg.stop = (stamp_to_msg(max(min(started + t, end), 0.0)) for t in (plan.lowered, plan.stop))
    if error is not None:
        msg.error_code, msg.error_text = int(error.code), str(error)
    if under_way.contact is not None and (error is None or error.code != PushCode.NO_CONTACT):
        msg.contact = stamp_to_msg(under_way.contact)
    msg.direction, msg.distance, msg.speed = push.direction, push.distance, push.speed
    return msg


def main() -> int:
    """Run the node until a signal ends it; the exit code."""
    # The watch over a moving arm keeps one thread, its cancellation and the joint states need their own.
    return run_node(PushExecutorNode, n_threads=4)
