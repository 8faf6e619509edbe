"""The hand on ROS: whether it is closed, and closing it. A Robotiq 3-finger hand, a gripper with an action, or none: a fixed tool."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import fields
from typing import Any, Final

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.push_executor.gripper_port import GRIPPER_ACTION, GripperHand, GripperSettings
from push_ident.nodes.push_executor.optional_messages import import_messages
from push_ident.nodes.push_executor.settings import EXECUTOR
from push_ident.pushing.hand import BASIC_MODE, CLOSED, HandState
from push_ident.pushing.ports import Hand

_STATUS_TOPIC: Final = "Robotiq3FGripper/InputRegisters"
_COMMAND_TOPIC: Final = "Robotiq3FGripper/OutputRegisters"
_MESSAGES: Final = {
    "robotiq_3f": ("robotiq_3f_gripper_ros2_interfaces", "Robotiq3FGripperInputRegisters", "Robotiq3FGripperOutputRegisters"),
    "simulated": ("push_ident_msgs", "HandStatus", "HandCommand"),
}
"""Package, status and command of each kind of driver. Both have the registers of the hand's manual as fields."""
HAND_KINDS: Final = ("none", *_MESSAGES, GRIPPER_ACTION)


class FixedTool:
    """A pusher that cannot open."""

    def why_no_fist(self) -> str:
        """Always empty."""
        return ""

    def close_fist(self, timeout: float, is_over: Callable[[], bool]) -> str:
        """Always empty."""
        return ""


class RobotiqHand:
    """A Robotiq 3-finger hand behind its Modbus driver: status in, commands out, each with the registers of the manual."""

    def __init__(self, node: Node, kind: str, *, timeout: float, callback_group: CallbackGroup) -> None:
        """`timeout` [s]: longest silence of the driver, by time of receipt. Raises InputError when its messages are not installed."""
        package, status, command = _MESSAGES[kind]
        remedy = "build and source the driver's workspace, or set hand to none for a fixed tool"
        messages = import_messages(f"{package}.msg", "hand", kind, remedy)
        self._command: Any = getattr(messages, command)
        self._timeout = timeout
        self._state: HandState | None = None
        self._received = -math.inf
        self._topic = node.resolve_topic_name(_STATUS_TOPIC)
        self._publisher = node.create_publisher(self._command, _COMMAND_TOPIC, 1)
        node.create_subscription(getattr(messages, status), _STATUS_TOPIC, self._on_status, 1, callback_group=callback_group)

    def why_no_fist(self) -> str:
        """As `Hand`; a silent driver is a reason as well."""
        if self._state is None:
            return f"no status of the hand on {self._topic}; is its driver running?"
        silence = time.monotonic() - self._received
        if silence > self._timeout:
            return f"no status of the hand on {self._topic} for {silence:.1f} s, limit {self._timeout:.1f} s"
        return self._state.why_no_fist

    def close_fist(self, timeout: float, is_over: Callable[[], bool]) -> str:
        """As `Hand`."""
        deadline = time.monotonic() + timeout
        while (reason := self.why_no_fist()) and time.monotonic() < deadline and not is_over():
            is_active = self._state is not None and self._state.activated
            self._publisher.publish(
                self._command(
                    r_act=1,
                    r_mod=BASIC_MODE,
                    r_gto=int(is_active),
                    r_atr=0,
                    r_pra=CLOSED if is_active else 0,
                    r_spa=EXECUTOR.hand_speed,
                    r_fra=0,
                )
            )
            time.sleep(EXECUTOR.hand_command_period)
        return reason

    def _on_status(self, msg: Any) -> None:
        self._received = time.monotonic()
        self._state = HandState(
            activated=msg.g_act == 1,
            mode=int(msg.g_mod),
            going=msg.g_gto == 1,
            readiness=int(msg.g_imc),
            motion=int(msg.g_sta),
            fault=int(msg.g_flt),
            request=int(msg.g_pra),
        )


def make_hand(node: CellNode, values: dict[str, Any], callback_group: CallbackGroup) -> Hand:
    """The hand that the parameters of the executor ask for. Raises InputError where its messages are not installed."""
    kind, timeout = values["hand"], values["hand_timeout"]
    if kind == "none":
        return FixedTool()
    if kind == GRIPPER_ACTION:
        settings = GripperSettings(*(values[f"hand_{field.name}"] for field in fields(GripperSettings)))
        return GripperHand(node, settings, callback_group=callback_group)
    return RobotiqHand(node, kind, timeout=timeout, callback_group=callback_group)
