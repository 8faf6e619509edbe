"""A proxy between the publisher of a topic and all its subscribers: it drops, delays, reorders, duplicates and changes messages.

The publisher is remapped to `<topic>_source`; the proxy publishes `<topic>`. Messages pass as bytes and are decoded only to be changed.
"""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from push_ident_msgs.msg import PushRecord

OBJECT = "truth"
"""Id of the object whose poses come from the simulated world, without a camera."""
OBJECT_POSE = f"objects/{OBJECT}/pose"


@dataclass(frozen=True)
class Topic:
    kind: type
    latched: bool = False


TOPICS = {
    "joint_states": Topic(JointState),
    "joint_trajectory": Topic(JointTrajectory),
    "robot_description": Topic(String, latched=True),
    "pusher/wrench": Topic(WrenchStamped),
    "pusher/pose": Topic(PoseStamped),
    "push_record": Topic(PushRecord),
    "/clock": Topic(Clock),
    OBJECT_POSE: Topic(PoseWithCovarianceStamped),
}


def qos_of(topic: str) -> QoSProfile:
    """As the nodes publish it."""
    known = TOPICS[topic]
    return QoSProfile(
        depth=1 if known.latched else 100,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if known.latched else DurabilityPolicy.VOLATILE,
    )


Rule = Callable[[bytes], list[tuple[float, bytes]]]
"""A message gives the messages to send, each with a delay [s]."""
LOOK = 0.1
"""Longest time between two looks for delayed messages [s]."""


def as_it_is(data: bytes) -> list[tuple[float, bytes]]:
    return [(0.0, data)]


def drop(data: bytes) -> list[tuple[float, bytes]]:
    return []


def duplicated(data: bytes) -> list[tuple[float, bytes]]:
    return [(0.0, data), (0.0, data)]


def reordered(spread: float) -> Rule:
    """Delays drawn from 0 to `spread` [s], so that messages overtake each other."""
    rng = np.random.default_rng(0)
    return lambda data: [(float(rng.uniform(0.0, spread)), data)]


def lossy(share: float) -> Rule:
    """Drop a share of the messages at random."""
    rng = np.random.default_rng(0)
    return lambda data: [(0.0, data)] if rng.random() >= share else []


def changed(topic: str, change: Callable[[Any], object]) -> Rule:
    """Every message of a topic of `TOPICS` after `change`, which alters its argument."""

    def rule(data: bytes) -> list[tuple[float, bytes]]:
        msg = deserialize_message(data, TOPICS[topic].kind)
        change(msg)
        return [(0.0, serialize_message(msg))]

    return rule


def source_of(topic: str) -> str:
    """Where the publisher of a topic that passes the proxy is remapped to: a name that neither trackers nor recorders look for."""
    return ("/" if topic.startswith("/") else "") + topic.strip("/").replace("/", "_") + "_source"


@dataclass
class Route:
    kind: type
    publisher: Any
    rule: Rule = as_it_is
    latest: bytes = b""
    """Of the source."""


class Proxy:
    """Relays topics of `TOPICS`, each under a rule that can be changed at any time."""

    def __init__(self, node: Node, topics: tuple[str, ...]) -> None:
        self._late: list[tuple[float, int, Any, bytes]] = []
        self._order = itertools.count()
        self._wake = threading.Condition()
        self._over = False
        self._routes: dict[str, Route] = {}
        for topic in topics:
            kind, qos = TOPICS[topic].kind, qos_of(topic)
            route = self._routes[topic] = Route(kind, node.create_publisher(kind, topic, qos))
            node.create_subscription(kind, source_of(topic), lambda data, route=route: self._take(route, data), qos, raw=True)
        self._thread = threading.Thread(target=self._send_late, daemon=True)
        self._thread.start()

    def set(self, topic: str, rule: Rule) -> float:
        self._routes[topic].rule = rule
        return time.monotonic()

    def change(self, topic: str, change: Callable[[Any], object]) -> float:
        return self.set(topic, changed(topic, change))

    def clear(self) -> None:
        for route in self._routes.values():
            route.rule = as_it_is

    def latest(self, topic: str) -> Any:
        route = self._routes[topic]
        return deserialize_message(route.latest, route.kind)

    def close(self) -> None:
        with self._wake:
            self._over = True
            self._wake.notify()
        self._thread.join(timeout=1.0)

    def _take(self, route: Route, data: bytes) -> None:
        now = time.monotonic()
        route.latest = data
        for delay, out in route.rule(data):
            if delay <= 0.0:
                route.publisher.publish(out)
            else:
                with self._wake:
                    heapq.heappush(self._late, (now + delay, next(self._order), route.publisher, out))
                    self._wake.notify()

    def _send_late(self) -> None:
        while True:
            with self._wake:
                if self._over:
                    return
                wait = self._late[0][0] - time.monotonic() if self._late else LOOK
                if wait > 0.0:
                    self._wake.wait(timeout=min(LOOK, max(1e-4, wait)))
                    continue
                _, _, publisher, data = heapq.heappop(self._late)
            publisher.publish(data)
