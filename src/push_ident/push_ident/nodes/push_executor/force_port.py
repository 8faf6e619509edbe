"""The force of the pusher as the executor watches it."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from push_ident.errors import InputError
from push_ident.nodes.convert.messages import force_from_msg

__all__ = ["ForcePort"]


class ForcePort:
    """Subscribes to `pusher/wrench`, where there is one."""

    def __init__(self, node: Node, callback_group: CallbackGroup) -> None:
        self._node, self._lock = node, threading.Lock()
        self._peak = 0.0
        self._received = -math.inf
        self._stamp = Time()
        self._is_there = False
        self.fault = ""
        """Why the latest measurement cannot be trusted; empty where it can."""
        node.create_subscription(WrenchStamped, "pusher/wrench", self._on_wrench, qos_profile_sensor_data, callback_group=callback_group)

    @property
    def is_there(self) -> bool:
        """As `pushing.ports.ForceSensor`: from the first message on, and while the topic has a publisher."""
        return self._is_there or self._node.count_publishers(self._node.resolve_topic_name("pusher/wrench")) > 0

    @property
    def silence(self) -> float:
        """Wall time since the last measurement that can be trusted [s]; infinite before the first."""
        return time.monotonic() - self._received

    def take_peak(self) -> float:
        """Largest horizontal force since the last call [N]; infinite where a measurement could not be trusted."""
        with self._lock:
            peak, self._peak = self._peak, 0.0
        return peak

    def _on_wrench(self, msg: WrenchStamped) -> None:
        self._is_there = True
        if msg.header.stamp == self._stamp != Time():
            raise InputError("its stamp is that of the message before: a driver that repeats itself has lost its sensor.")
        self._stamp = msg.header.stamp
        try:
            size = float(np.linalg.norm(force_from_msg(msg)[1]))
        except InputError as error:
            self._note(math.inf, str(error))
            raise
        self._received = time.monotonic()
        self._note(size, "")

    def _note(self, size: float, fault: str) -> None:
        with self._lock:
            self._peak, self.fault = max(self._peak, size), fault
