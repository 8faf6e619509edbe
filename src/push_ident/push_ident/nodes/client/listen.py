"""What is published in a cell that runs now, for commands: topics of the bag contract with their rates, and the state of an arm."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import JointState

from push_ident.bags.contract import Role, role_of
from push_ident.errors import PushIdentError
from push_ident.limits import LIMITS
from push_ident.nodes.base.network import COMMAND_LINE
from push_ident.nodes.convert.messages import message_class

_LATCHED = frozenset({Role.CELLS, Role.OUTLINE, Role.OUTLINE_STD, Role.PUSHER_SHAPE, Role.TF_STATIC, Role.CAMERA_ACCURACY})
_RARE = _LATCHED | {Role.PUSHER, Role.PUSH_RECORD}
"""Roles that may be silent for a while."""


def start_ros(**options: Any) -> None:
    """Initialise ROS for the nodes of a command. Raises PushIdentError where it does not start."""
    try:
        rclpy.init(args=["--ros-args", "--enclave", COMMAND_LINE], **options)
    except RuntimeError as error:
        raise PushIdentError(f"ROS does not start: {error}; check the variables ROS_*.") from None


def listen_to_contract(seconds: float) -> list[dict[str, Any]]:
    """Listen for some time [s]; one row per topic: topic, type, rate_hz, qos, silent (no message although some are expected)."""
    start_ros()
    node = Node("push_ident_doctor")
    counts: Counter[str] = Counter()
    topics: dict[str, tuple[str, str, Role]] = {}
    try:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            for topic, types in node.get_topic_names_and_types():
                role = role_of(topic)
                publishers = node.get_publishers_info_by_topic(topic) if role is not None and topic not in topics else []
                if role is None or not publishers:
                    continue
                qos = publishers[0].qos_profile
                topics[topic] = (types[0], f"{qos.reliability.name.lower()}, {qos.durability.name.lower()}", role.role)
                _subscribe(node, topic, types[0], qos.durability, counts)
            rclpy.spin_once(node, timeout_sec=0.05)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return [
        {"topic": topic, "type": kind, "rate_hz": counts[topic] / seconds, "qos": qos, "silent": counts[topic] == 0 and role not in _RARE}
        for topic, (kind, qos, role) in sorted(topics.items())
    ]


def _subscribe(node: Node, topic: str, msgtype: str, durability: DurabilityPolicy, counts: Counter[str]) -> None:
    if (message := message_class(msgtype)) is None:
        return
    qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT, durability=durability)
    if durability == DurabilityPolicy.TRANSIENT_LOCAL:
        qos.reliability = ReliabilityPolicy.RELIABLE
    node.create_subscription(message, topic, lambda data: counts.update([topic]), qos, raw=True)


@dataclass(frozen=True, slots=True)
class CellNames:
    """Names of the topics of one cell."""

    states: str
    """Joint states."""
    commands: str
    """Joint trajectories."""
    images: str
    """Depth images."""


@dataclass(slots=True)
class Heard:
    """What was received under some names."""

    names: CellNames
    n_arms: int = 0
    """Publishers of joint states."""
    n_states: int = 0
    """Joint states that came."""
    positions: dict[str, float] = field(default_factory=dict)
    """Latest position of every joint [rad]; NaN where a state names the joint without one."""
    controllers: tuple[str, ...] = ()
    """Types that the listeners of the trajectories take."""
    n_cameras: int = 0
    """Publishers of depth images."""


def listen_to_arms(cells: Sequence[CellNames], seconds: float) -> list[Heard]:
    """Listen for a time [s] under several sets of names at once.

    Raises PushIdentError where ROS does not start or a topic has no valid name.
    """
    start_ros()
    heard = [Heard(names) for names in cells]
    node = Node("push_ident_doctor", enable_rosout=False)
    try:
        for one in heard:
            node.create_subscription(JointState, one.names.states, partial(_take, one), qos_profile_sensor_data)
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            rclpy.spin_once(node, timeout_sec=0.05)
        for one in heard:
            one.n_arms = node.count_publishers(one.names.states)
            one.n_cameras = node.count_publishers(one.names.images)
            one.controllers = tuple(sorted({info.topic_type for info in node.get_subscriptions_info_by_topic(one.names.commands)}))
    except ValueError as error:
        raise PushIdentError(f"topics: {' '.join(str(error).split())}; correct the name.") from None
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return heard


def _take(heard: Heard, msg: JointState) -> None:
    heard.n_states += 1
    for number, name in enumerate(msg.name[: LIMITS.JOINTS.value]):
        heard.positions[name] = msg.position[number] if number < len(msg.position) else math.nan
