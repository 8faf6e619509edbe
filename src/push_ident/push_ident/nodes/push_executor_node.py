"""Node that makes the arm push: action `execute_push`, one push at a time, watched all the way."""

from __future__ import annotations

import sys
import threading
import time
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
from scipy.spatial.transform import Rotation
from shape_msgs.msg import SolidPrimitive

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.nodes.arm_port import ArmPort, ArmState
from push_ident.nodes.convert import TABLE_FRAME, cylinder_to_msg, object_frame, position_to_msg, stamp_from_msg, stamp_to_msg
from push_ident.nodes.parameters import Parameters
from push_ident.nodes.push_executor_parameters import PARAMETERS, motion_settings, push_settings
from push_ident.nodes.run import run_node
from push_ident.nodes.seen_objects import SeenObject, SeenObjects
from push_ident.pushing.motion import ArmPlan, plan_push
from push_ident.pushing.push import PushCode, PushPlan2D
from push_ident.pushing.sampling import push_from_goal, sample_push
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushRecord

__all__ = ["PushExecutorNode", "main"]

_WATCH_PERIOD = 0.01
"""[s] between two looks at the moving arm; with the arm timeout it bounds the time to hold."""
_TOOL_PERIOD = 1.0 / 60.0
_LAST_CALLBACKS = 0.1
"""[s] given to callbacks under way when the node stops."""
_RANDOM_PLANS = 20
"""Random pushes tried before giving up on the arm's reach."""
_ARRIVAL = 1.0
"""[s] the arm may still need after the end of the plan."""


@dataclass(slots=True)
class _Motion:
    """A plan under way. Times in seconds of the node's clock."""

    plan: ArmPlan
    started: float
    contact: float | None = None
    """When the measured tool passed the planned place of contact."""
    _before: tuple[float, float] | None = None

    def see(self, state: ArmState) -> None:
        """Take one state of the lowered tool."""
        push, stamp = self.plan.push, stamp_from_msg(state.stamp)
        travel = float((state.pose_tip_in_table[:2, 3] - push.tool_at_contact) @ push.heading)
        if self.contact is None and self._before is not None and self._before[1] < 0.0 <= travel:
            stamp_before, travel_before = self._before
            self.contact = stamp_before + (stamp - stamp_before) * travel_before / (travel_before - travel)
        self._before = (stamp, travel)


class PushExecutorNode(Node):
    """Serves `execute_push`; tells by `pusher/pose` and `push_record` what the tool did."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("push_executor_node", **kwargs)
        self._settings = Parameters(self, PARAMETERS)
        values = self._settings.as_dict()
        push_settings(values), motion_settings(values)  # refuse contradictions now rather than at the first goal

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

        self._arm = ArmPort(
            self,
            description_file=values["robot_description_file"],
            tip_frame=values["tip_frame"],
            neutral=values["neutral_posture"],
            callback_group=MutuallyExclusiveCallbackGroup(),
            on_state=self._on_arm_state,
        )
        housekeeping = MutuallyExclusiveCallbackGroup()
        self._objects = SeenObjects(self, housekeeping)
        self._n_received_before = 0
        self.create_timer(1.0, self._publish_diagnostics, callback_group=housekeeping, clock=Clock(clock_type=ClockType.STEADY_TIME))
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
        self._feedback(goal, ExecutePush.Feedback.PHASE_PLAN, 0.0)
        values = self._settings.as_dict()
        if self._arm.has_rival():
            topic = self.resolve_topic_name("joint_trajectory")
            raise PlanningError(PushCode.BUSY, f"another node publishes {topic}; only one may command the arm.")
        seen = self._objects.get(goal.request.object_id, values["pose_timeout"])
        plan = self._plan(goal.request, seen, values, self._arm.next_state(values["arm_timeout"]).q)
        _fill_result(result, plan)
        if goal.request.dry_run:
            return
        motion = self._start(goal, seen, values, plan)
        _fill_result(result, motion.plan)
        self._n_pushes += 1
        result.push_id = self._n_pushes
        error: PlanningError | None = None
        try:
            self._watch(goal, motion, values)
            self._check_contact(seen, motion.started + motion.plan.stop, values)
        except PlanningError as failure:
            error = failure
            raise
        finally:
            self._record_pub.publish(_record(self._n_pushes, seen.object_id, motion, self._now(), error))

    def _plan(self, request: ExecutePush.Goal, seen: SeenObject, values: dict[str, Any], q_now: np.ndarray) -> ArmPlan:
        settings, motion = push_settings(values), motion_settings(values)
        obstacles = self._objects.outlines_of_others(seen.object_id)
        if request.mode == ExecutePush.Goal.MODE_CONTACT:
            point, direction = _contact_in_table(request, seen)
            distance, speed = request.distance or values["push_distance"], request.speed or values["push_speed"]
            push = push_from_goal(seen.shape, seen.pose, point, direction, distance, speed, settings, obstacles)
            return plan_push(self._arm.planner, q_now, push, motion)
        if request.mode != ExecutePush.Goal.MODE_RANDOM:
            raise PlanningError(PushCode.INVALID_GOAL, f"mode is {request.mode}, expected MODE_CONTACT (0) or MODE_RANDOM (1).")
        rng = np.random.default_rng(int(request.seed))
        last_refusal: PlanningError | None = None
        for _ in range(_RANDOM_PLANS):
            push = sample_push(seen.shape, seen.pose, rng, settings, obstacles)
            try:
                return plan_push(self._arm.planner, q_now, push, motion)
            except PlanningError as error:
                last_refusal = error
        raise PlanningError(PushCode.UNREACHABLE, f"none of {_RANDOM_PLANS} random pushes fits the arm; the last: {last_refusal}")

    def _start(self, goal: ServerGoalHandle, seen: SeenObject, values: dict[str, Any], plan: ArmPlan) -> _Motion:
        """Send the plan if the arm still is where it starts, planned once more if it was moved meanwhile."""
        for attempt in range(2):
            command = self._arm.prepare(plan)
            q = self._arm.next_state(values["arm_timeout"]).q
            off = float(np.max(np.abs(q - plan.trajectory.position[0])))
            self._check_wanted(goal)
            if off <= values["start_tolerance"]:
                return _Motion(plan, self._arm.send(command))
            if attempt == 0:
                plan = self._plan(goal.request, seen, values, q)
        raise PlanningError(
            PushCode.TRACKING,
            f"the arm moves by itself: {off:.3f} rad off the start of the plan, limit {values['start_tolerance']:.3f} rad.",
        )

    def _watch(self, goal: ServerGoalHandle, motion: _Motion, values: dict[str, Any]) -> None:
        """Until the motion has ended. On any fault the arm is held."""
        try:
            self._follow(goal, motion, values)
        except BaseException as fault:
            # A silent arm is best held where it was sent; one that speaks, where it is.
            silent = isinstance(fault, PlanningError) and fault.code == PushCode.ARM_SILENT
            planned = motion.plan.trajectory.at(self._now() - motion.started)
            self._arm.hold(planned if silent or self._arm.state is None else self._arm.state.q)
            raise
        finally:
            self._pushing = False

    def _follow(self, goal: ServerGoalHandle, motion: _Motion, values: dict[str, Any]) -> None:
        plan, phase_before, reported = motion.plan, -1, -np.inf
        while True:
            time.sleep(_WATCH_PERIOD)
            self._check_wanted(goal)
            elapsed = self._now() - motion.started
            state = self._arm.fresh_state(values["arm_timeout"])
            self._check_tracking(plan, state, self._age_of(state, values["tracking_lag"], motion.started), values)
            self._pushing = plan.lowered <= elapsed <= plan.rested
            if self._pushing:
                motion.see(state)
            phase = _phase(plan, elapsed)
            if phase != phase_before or elapsed - reported > 0.1:
                phase_before, reported = phase, elapsed
                self._feedback(goal, phase, elapsed / plan.duration)
            if elapsed >= plan.duration and np.max(np.abs(state.q - plan.trajectory.position[-1])) <= values["start_tolerance"]:
                return

    def _age_of(self, state: ArmState, tolerance: float, started: float) -> float:
        """Time of a state since the start of the motion [s]: by its stamp or, where the arm keeps another clock, by its receipt."""
        now, stamp = self._now(), stamp_from_msg(state.stamp)
        if abs(now - stamp) <= max(tolerance, 0.1):
            return stamp - started
        return now - started - (time.monotonic() - state.received)

    def _check_wanted(self, goal: ServerGoalHandle) -> None:
        if self._closing.is_set():
            raise PlanningError(PushCode.CANCELED, "the node was stopped; the arm holds.")
        if goal.is_cancel_requested:
            raise PlanningError(PushCode.CANCELED, "canceled on request; the arm holds.")

    def _check_tracking(self, plan: ArmPlan, state: ArmState, elapsed: float, values: dict[str, Any]) -> None:
        if elapsed < -values["arm_timeout"]:
            raise PlanningError(PushCode.TRACKING, f"time jumped back by {-elapsed:.2f} s during the motion.")
        off, limit = plan.deviation(state.pose_tip_in_table[:3, 3], elapsed, values["tracking_lag"]), values["tracking_tolerance"]
        if off > limit:
            raise PlanningError(
                PushCode.TRACKING, f"the tool is {1e3 * off:.1f} mm off its way after {elapsed:.2f} s, limit {1e3 * limit:.1f} mm."
            )
        if elapsed > plan.duration + _ARRIVAL:
            raise PlanningError(PushCode.TRACKING, f"the arm did not arrive within {_ARRIVAL:.1f} s after the end of the plan.")

    def _check_contact(self, before: SeenObject, stop: float, values: dict[str, Any]) -> None:
        """Raise PlanningError NO_CONTACT when the object stayed, UNKNOWN_OBJECT when no pose came after the push."""
        deadline = time.monotonic() + values["pose_timeout"]
        after = self._objects.get(before.object_id, np.inf)
        while after.stamp <= stop:
            if time.monotonic() > deadline:
                raise PlanningError(PushCode.UNKNOWN_OBJECT, f"`{before.object_id}` was not seen after the push.")
            time.sleep(_WATCH_PERIOD)
            after = self._objects.get(before.object_id, np.inf)
        shift = float(np.linalg.norm(after.pose[:2] - before.pose[:2]))
        turn = abs(float(wrap_angle(after.pose[2] - before.pose[2])))
        if shift <= values["min_object_shift"] and turn <= values["min_object_turn"]:
            raise PlanningError(
                PushCode.NO_CONTACT, f"`{before.object_id}` moved by {1e3 * shift:.1f} mm and {turn:.3f} rad only; was its pose right?"
            )

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
        x, y, z, w = Rotation.from_matrix(state.pose_tip_in_table[:3, :3]).as_quat()
        orientation = msg.pose.orientation
        orientation.x, orientation.y, orientation.z, orientation.w = float(x), float(y), float(z), float(w)
        self._tool_pub.publish(msg)

    def _publish_diagnostics(self) -> None:
        rate = self._arm.n_received - self._n_received_before
        self._n_received_before = self._arm.n_received
        silent = self._arm.silence > self._settings["arm_timeout"]
        no_clock = bool(self.get_parameter("use_sim_time").value) and self._now() == 0.0
        reasons = [text for text, true in (("arm silent", silent), ("use_sim_time is set but /clock is silent", no_clock)) if true]
        status = DiagnosticStatus(
            name=f"{self.get_name()}: pushing",
            level=DiagnosticStatus.ERROR if silent else DiagnosticStatus.WARN if no_clock or not self._objects.ids else DiagnosticStatus.OK,
            message="; ".join(reasons) or ("no objects seen" if not self._objects.ids else "ready" if self._idle.is_set() else "pushing"),
            hardware_id="",
        )
        for key, value in (
            ("joint_states [1/s]", rate),
            ("joint_states dropped", self._arm.n_dropped),
            ("objects", ", ".join(self._objects.ids)),
            ("pushes", self._n_pushes),
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


def _record(push_id: int, object_id: str, motion: _Motion, now: float, error: PlanningError | None) -> PushRecord:
    """Record of a motion that has ended by `now` [s]. A phase that was not reached has the time of the end."""
    plan, push = motion.plan, motion.plan.push
    end = min(motion.started + plan.rested, now)
    msg = PushRecord(push_id=push_id, object_id=object_id, contact_point=_point(push))
    msg.header.frame_id = TABLE_FRAME
    msg.header.stamp = msg.end = stamp_to_msg(max(end, 0.0))
    msg.start, msg.stop = (stamp_to_msg(max(min(motion.started + t, end), 0.0)) for t in (plan.lowered, plan.stop))
    if error is not None:
        msg.error_code, msg.error_text = int(error.code), str(error)
    if motion.contact is not None and (error is None or error.code != PushCode.NO_CONTACT):
        msg.contact = stamp_to_msg(motion.contact)
    msg.direction, msg.distance, msg.speed = push.direction, push.distance, push.speed
    return msg


def main() -> int:
    """Entry point of the executable."""
    # The watch over a moving arm keeps one thread, its cancellation and the joint states need their own.
    return run_node(PushExecutorNode, n_threads=4)


if __name__ == "__main__":
    sys.exit(main())
