"""Live topics of the bag contract with their rates and quality of service."""

from __future__ import annotations

import importlib
import time
from collections import Counter
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from push_ident.bags.contract import Role, role_of
from push_ident.errors import PushIdentError
from push_ident.nodes.base.network import COMMAND_LINE

__all__ = ["listen_to_contract"]

_LATCHED = frozenset({Role.CELLS, Role.OUTLINE, Role.OUTLINE_STD, Role.PUSHER_SHAPE, Role.TF_STATIC, Role.CAMERA_ACCURACY})
_RARE = _LATCHED | {Role.PUSHER, Role.PUSH_RECORD}
"""Roles that may be silent for a while."""


def listen_to_contract(seconds: float) -> list[dict[str, Any]]:
    """Listen for some time [s]; one row per topic: topic, type, rate_hz, qos, silent (no message although some are expected)."""
    try:
        rclpy.init(args=["--ros-args", "--enclave", COMMAND_LINE])
    except RuntimeError as error:
        raise PushIdentError(f"ROS does not start: {error}; check the variables ROS_*.") from None
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
    package, _, name = msgtype.partition("/msg/")
    try:
        message = getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        return
    qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT, durability=durability)
    if durability == DurabilityPolicy.TRANSIENT_LOCAL:
        qos.reliability = ReliabilityPolicy.RELIABLE
    node.create_subscription(message, topic, lambda data: counts.update([topic]), qos, raw=True)
