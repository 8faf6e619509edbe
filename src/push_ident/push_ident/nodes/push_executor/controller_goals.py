"""Goals for the trajectory controller of the arm: control_msgs/action/FollowJointTrajectory, as joint_trajectory_controller serves it."""

from __future__ import annotations

import math
import threading
import time
from typing import Any, Final

from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from rclpy.action import ActionClient
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from trajectory_msgs.msg import JointTrajectory

from push_ident.errors import PlanningError
from push_ident.limits import plain_text
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.group_calls import GroupCalls
from push_ident.nodes.base.keep_alive import ServerWatch
from push_ident.nodes.push_executor.optional_messages import import_control_messages
from push_ident.nodes.push_executor.settings import EXECUTOR
from push_ident.pushing.push import PushCode
from push_ident.pushing.push_request import FOLLOW

_CONSTRAINTS: Final = {"path": "trajectory", "goal": "goal"}
"""The parameter `constraints.<joint>.<...>` of a controller that has the tolerance of a goal without one."""


class TrajectoryController:
    """Client of the action beside the topic `joint_trajectory`, so that goals and holds reach the same controller.

    Tolerances are those of the controller where they are 0 [rad].
    """

    def __init__(self, node: CellNode, *, path_tolerance: float, goal_tolerance: float) -> None:
        """Raises InputError where control_msgs is not installed."""
        self.kind = import_control_messages("action", "free_motions", FOLLOW).FollowJointTrajectory
        self._tolerance_kind = import_control_messages("msg", "free_motions", FOLLOW).JointTolerance
        self.tolerances = {"path": path_tolerance, "goal": goal_tolerance}
        self.group = MutuallyExclusiveCallbackGroup()
        self.action = node.resolve_topic_name("joint_trajectory").rpartition("/")[0] + "/follow_joint_trajectory"
        self.client = ActionClient(node, self.kind, self.action, callback_group=self.group)
        self._probe = node.create_client(CancelGoal, f"{self.action}/_action/cancel_goal", callback_group=self.group)
        self.calls = GroupCalls(node, self.action, self.group)
        self.guard = node.guard

    def close(self) -> None:
        """Withdraw the client; the node withdraws the rest."""
        self.calls.close()
        self.client.destroy()

    def check(self) -> None:
        """As `pushing.ports.Arm.check_goals`: a server that has not discovered this client yet would drop its answers."""
        server, deadline = ServerWatch(self.client, self._probe), time.monotonic() + EXECUTOR.discovery
        while not server.has_answered:
            if time.monotonic() > deadline:
                raise PlanningError(
                    PushCode.ARM_SILENT,
                    f"no controller answers on the action {self.action}. Is joint_trajectory_controller active, and joint_trajectory "
                    "remapped to its topic? Without the action, set free_motions: pieces.",
                )
            self.calls.ask(server.why_gone)
            time.sleep(EXECUTOR.answer_look)

    def send(self, trajectory: JointTrajectory) -> FollowedGoal:
        """Have the controller follow a trajectory in place of what it does."""
        goal = self.kind.Goal(trajectory=trajectory)
        for kind, tolerance in self.tolerances.items():
            if tolerance:
                each = [self._tolerance_kind(name=joint, position=tolerance) for joint in trajectory.joint_names]
                setattr(goal, f"{kind}_tolerance", each)
        followed = FollowedGoal(self)
        self.calls.ask(lambda: followed.begin(goal))
        return followed


class FollowedGoal:
    """`pushing.ports.ControllerGoal` of the action. Methods but `cancel` are called in the callback group of its client."""

    def __init__(self, controller: TrajectoryController) -> None:
        self._controller = controller
        self._lock = threading.Lock()
        self._handle: Any = None
        self._is_canceled = False
        self._errors: dict[str, float] = {}
        self.is_over = False
        self.fault: PlanningError | None = None

    @property
    def is_accepted(self) -> bool:
        """As `ControllerGoal`."""
        return self._handle is not None

    def cancel(self) -> None:
        """As `ControllerGoal`; one that the controller has not accepted yet is canceled as soon as it is."""
        with self._lock:
            self._is_canceled, handle = True, self._handle
        if handle is not None and not self.is_over:
            # From this thread: the arm must stop also where the node is about to end and no callback is called any more.
            with self._controller.guard.watch(self._controller.action):
                handle.cancel_goal_async()

    def begin(self, goal: Any) -> None:
        """Send it."""
        if not self._is_canceled:
            self._controller.client.send_goal_async(goal, feedback_callback=self._on_feedback).add_done_callback(self._on_answer)

    def _on_answer(self, future: Any) -> None:
        with self._controller.guard.watch(self._controller.action):
            handle = future.result()
            if not handle.accepted:
                self._end(PushCode.TRACKING, "rejected the goal; its log says why. Are its joints those of the arm, and its clock?")
                return
            with self._lock:
                self._handle, is_canceled = handle, self._is_canceled
            handle.get_result_async().add_done_callback(self._on_result)
            if is_canceled:
                handle.cancel_goal_async()

    def _on_feedback(self, message: Any) -> None:
        feedback = message.feedback
        self._errors = {name: abs(error) for name, error in zip(feedback.joint_names, feedback.error.positions, strict=False)}

    def _on_result(self, future: Any) -> None:
        with self._controller.guard.watch(self._controller.action):
            status, result = future.result().status, future.result().result
            codes = self._controller.kind.Result
            said = plain_text(result.error_string) or "without a reason"
            if self._is_canceled or (status == GoalStatus.STATUS_SUCCEEDED and result.error_code == codes.SUCCESSFUL):
                self.is_over = True
            elif status == GoalStatus.STATUS_CANCELED:
                self._end(PushCode.BUSY, "was told by another client to cancel the goal; only one may command the arm.")
            elif status == GoalStatus.STATUS_ABORTED and result.error_code == codes.INVALID_GOAL:
                self._end(PushCode.BUSY, f"gave the goal up: {said} Only one client may command the arm.")
            elif result.error_code == codes.PATH_TOLERANCE_VIOLATED:
                self._end(PushCode.TRACKING, f"ended the goal, PATH_TOLERANCE_VIOLATED: {said}. {self._farthest('path')}")
            elif result.error_code == codes.GOAL_TOLERANCE_VIOLATED:
                self._end(PushCode.TRACKING, f"ended the goal, GOAL_TOLERANCE_VIOLATED: {said}. {self._farthest('goal')}")
            elif status == GoalStatus.STATUS_UNKNOWN:
                self._end(PushCode.TRACKING, "was started again, and has forgotten the goal.")
            else:
                self._end(PushCode.TRACKING, f"ended the goal with code {result.error_code}: {said}.")

    def _farthest(self, kind: str) -> str:
        """The joint that was farthest from where it was to be, and the tolerance: the controller writes both to its log only."""
        errors = {name: error for name, error in self._errors.items() if math.isfinite(error)}
        if not errors:
            return "Its log names the joint and the tolerance."
        name = max(errors, key=lambda name: errors[name])
        tolerance, joint = self._controller.tolerances[kind], plain_text(name)
        own = f"limit constraints.{joint}.{_CONSTRAINTS[kind]} of the controller"
        limit = f"{kind}_tolerance {tolerance:.3f} rad" if tolerance else own
        return f"In its last feedback {joint} was farthest from its path, {errors[name]:.3f} rad; {limit}."

    def _end(self, code: PushCode, what: str) -> None:
        self.fault = None if self._is_canceled else PlanningError(code, f"the controller on {self._controller.action} {what}")
        self.is_over = True


def make_controller(node: CellNode, free_motions: str, *, path_tolerance: float, goal_tolerance: float) -> TrajectoryController | None:
    """The controller that takes goals, where the parameter `free_motions` asks for it; errors as those of `TrajectoryController`."""
    if free_motions != FOLLOW:
        return None
    return TrajectoryController(node, path_tolerance=path_tolerance, goal_tolerance=goal_tolerance)
