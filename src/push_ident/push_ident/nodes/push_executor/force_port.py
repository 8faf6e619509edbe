"""The force of the pusher as the executor watches it."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from push_ident.nodes.convert import force_from_msg

__all__ = ["ForcePort"]


class ForcePort:
    """Subscribes to `pusher/wrench`, where there is one."""

    def __init__(self, node: Node, callback_group: CallbackGroup) -> None:
        self._lock = threading.Lock()
        self._peak = 0.0
        self._received = -math.inf
        node.create_subscription(WrenchStamped, "pusher/wrench", self._on_wrench, qos_profile_sensor_data, callback_group=callback_group)

    @property
    def silence(self) -> float:
        """Wall time since the last measurement [s]; infinite before the first."""
        return time.monotonic() - self._received

    def take_peak(self) -> float:
        """Largest horizontal force since the last call [N]."""
        with self._lock:
            peak, self._peak = self._peak, 0.0
        return peak

    def _on_wrench(self, msg: WrenchStamped) -> None:
        _, force = force_from_msg(msg)
        self._received = time.monotonic()
        with self._lock:
            self._peak = max(self._peak, float(np.linalg.norm(force)))
