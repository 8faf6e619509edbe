"""A gripper on ROS that closes by an action of control_msgs, as that of ros2_robotiq_gripper."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from action_msgs.srv import CancelGoal
from rclpy.action import ActionClient
from rclpy.callback_groups import CallbackGroup
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState

from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.group_calls import GroupCalls
from push_ident.nodes.base.keep_alive import ServerWatch
from push_ident.nodes.push_executor.optional_messages import import_control_messages
from push_ident.nodes.push_executor.settings import EXECUTOR

GRIPPER_ACTION: Final = "gripper_action"
"""Of the parameter `hand`."""
_ACTIONS: Final = ("GripperCommand", "ParallelGripperCommand")


@dataclass(frozen=True, slots=True)
class GripperSettings:
    """Parameters of the executor, without `hand_` before their names."""

    action: str
    position: float
    """That closes it, of its joint [rad] or [m]."""
    effort: float
    """Largest on the way [N] or [N m]."""
    joint: str
    """In `joint_states`, by which it is seen to stay closed; empty: it is not watched."""
    drift: float
    """Largest distance of that joint from where it closed, as `position`."""
    timeout: float
    """Longest silence of that joint [s]."""


class GripperHand:
    """A gripper behind `GripperCommand` or `ParallelGripperCommand`, whichever its server has.

    It counts as closed once a goal has ended in which it reached the position, or stalled against what it holds; from then on as long as
    its server is there, and its joint stays, if that is watched. The action itself says nothing between two goals.
    """

    def __init__(self, node: CellNode, settings: GripperSettings, *, callback_group: CallbackGroup) -> None:
        """Raises InputError where control_msgs is not installed."""
        actions = import_control_messages("action", "hand", GRIPPER_ACTION)
        self._kinds = {f"control_msgs/action/{name}_FeedbackMessage": getattr(actions, name) for name in _ACTIONS}
        self._node, self._settings, self._group = node, settings, callback_group
        self._name = node.resolve_service_name(settings.action)
        self._probe = node.create_client(CancelGoal, f"{self._name}/_action/cancel_goal", callback_group=callback_group)
        self._calls = GroupCalls(node, self._name, callback_group)
        self._client: ActionClient | None = None
        self._kind: Any = None
        self._why_open = f"the gripper has not been closed through {self._name} yet; call close_hand"
        self._closed_at = self._now_at = math.nan
        self._received = -math.inf
        if settings.joint:
            node.create_subscription(
                JointState, "joint_states", self._on_joint_states, qos_profile_sensor_data, callback_group=callback_group
            )

    def close(self) -> None:
        """Withdraw the client; the node withdraws the rest."""
        self._calls.close()
        if self._client is not None:
            self._client.destroy()

    def why_no_fist(self) -> str:
        """As `Hand`."""
        if not self._why_open and (self._client is None or not self._client.server_is_ready()):
            self._why_open = f"the driver of the gripper, the server of {self._name}, has left since it was closed; call close_hand"
        return self._why_open or self._why_moved()

    def _why_moved(self) -> str:
        if not (joint := self._settings.joint):
            return ""
        if (silence := time.monotonic() - self._received) > self._settings.timeout:
            since = f"for {silence:.1f} s, limit {self._settings.timeout:.1f} s" if math.isfinite(silence) else "yet"
            return f"no position of the gripper's joint {joint} in joint_states {since}"
        if not abs(self._now_at - self._closed_at) <= self._settings.drift:
            return f"the gripper has moved: {joint} is at {self._now_at:.3f}, was closed at {self._closed_at:.3f}; call close_hand"
        return ""

    def close_fist(self, timeout: float, is_over: Callable[[], bool]) -> str:
        """As `Hand`."""
        self._why_open = "the gripper is closing"
        self._why_open = self._close(timeout, is_over)
        return self.why_no_fist()

    def _close(self, timeout: float, is_over: Callable[[], bool]) -> str:
        """Why it did not close; empty where it did."""
        deadline = time.monotonic() + timeout

        def goes_on() -> bool:
            time.sleep(EXECUTOR.answer_look)
            return time.monotonic() < deadline and not is_over()

        while not self._find():
            if not goes_on():
                kinds = " or ".join(_ACTIONS) if self._kind is None else f"{self._kind.__name__} as before"
                return f"no server of the action {self._name}, {kinds}, within {timeout:.1f} s; does its controller run?"
        assert self._client is not None
        server, closing = ServerWatch(self._client, self._probe), _Closing(self._client, self._node)
        while not closing.is_over and not (why := server.why_gone()):
            if server.has_answered and not closing.is_sent:  # one that has not discovered this client would drop its answers
                closing.is_sent = True
                self._calls.ask(partial(closing.send, self._goal()))
            if not goes_on():
                closing.cancel()
                return f"the gripper has not reported on {self._name} within {timeout:.1f} s that it is closed"
        if closing.is_over:
            self._closed_at = self._now_at
            return closing.why
        closing.cancel()
        return f"the driver of the gripper on {self._name} {why}"

    def _find(self) -> bool:
        """Have a client of the kind that the server has; false where there is none, or it is of another kind than before."""
        servers = self._node.get_publishers_info_by_topic(f"{self._name}/_action/feedback")
        kinds = [self._kinds[info.topic_type] for info in servers if info.topic_type in self._kinds]
        if kinds and self._client is None:
            self._kind, self._client = kinds[0], ActionClient(self._node, kinds[0], self._name, callback_group=self._group)
        return self._kind in kinds

    def _goal(self) -> Any:
        goal, settings = self._kind.Goal(), self._settings
        if hasattr(goal.command, "max_effort"):
            goal.command.position, goal.command.max_effort = settings.position, settings.effort
        else:
            goal.command.position, goal.command.effort = [settings.position], [settings.effort]
        return goal

    def _on_joint_states(self, msg: JointState) -> None:
        position = dict(zip(msg.name, msg.position, strict=False)).get(self._settings.joint, math.nan)
        if math.isfinite(position):
            self._now_at, self._received = position, time.monotonic()


class _Closing:
    """One goal to close. All but `cancel` is called in the callback group of the client."""

    def __init__(self, client: ActionClient, node: CellNode) -> None:
        self._client, self._guard = client, node.guard
        self._handle: Any = None
        self._is_canceled = self.is_sent = self.is_over = False
        self.why = ""
        """Why it did not close, once that is over."""

    def send(self, goal: Any) -> None:
        self._client.send_goal_async(goal).add_done_callback(self._watched(self._on_answer))

    def cancel(self) -> None:
        self._is_canceled = True
        if self._handle is not None:
            self._handle.cancel_goal_async()

    def _on_answer(self, future: Any) -> None:
        self._handle = future.result()
        if not self._handle.accepted:
            self.why, self.is_over = "the driver of the gripper rejected the goal; its log says why", True
            return
        self._handle.get_result_async().add_done_callback(self._watched(self._on_result))
        if self._is_canceled:
            self._handle.cancel_goal_async()

    def _on_result(self, future: Any) -> None:
        result, status = future.result().result, future.result().status
        # A controller that does not allow stalling aborts: it holds something all the same.
        if not (result.reached_goal or result.stalled):
            self.why = f"the gripper neither reached its closed position nor stalled against what it holds (status {status} of its goal)"
        self.is_over = True

    def _watched(self, work: Callable[[Any], None]) -> Callable[[Any], None]:
        def watched(future: Any) -> None:
            with self._guard.watch("hand"):
                work(future)

        return watched
