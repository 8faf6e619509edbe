"""What a running arm says: its joint states, who takes its trajectories, and whether a camera is beside it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState

from push_ident.errors import PushIdentError
from push_ident.limits import LIMITS
from push_ident.nodes.base.network import COMMAND_LINE

__all__ = ["CellNames", "Heard", "listen_to_arms"]


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
    """What was heard under some names."""

    names: CellNames
    n_arms: int = 0
    """Publishers of joint states."""
    n_states: int = 0
    """Joint states that came."""
    positions: dict[str, float] = field(default_factory=dict)
    """Latest position of every joint [rad]."""
    controllers: tuple[str, ...] = ()
    """Types that the listeners of the trajectories take."""
    n_cameras: int = 0
    """Publishers of depth images."""


def listen_to_arms(cells: Sequence[CellNames], seconds: float) -> list[Heard]:
    """Listen for a time [s] under several sets of names at once.

    Raises PushIdentError where ROS does not start or a topic has no valid name.
    """
    try:
        rclpy.init(args=["--ros-args", "--enclave", COMMAND_LINE])
    except RuntimeError as error:
        raise PushIdentError(f"ROS does not start: {error}; check the variables ROS_*.") from None
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
    for name, position in zip(msg.name[: LIMITS.JOINTS.value], msg.position, strict=False):
        if math.isfinite(position):
            heard.positions[name] = position
