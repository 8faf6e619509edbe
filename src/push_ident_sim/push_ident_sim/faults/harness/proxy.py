"""A proxy between the publisher of a topic and all its subscribers: it drops, delays, reorders, duplicates and changes messages.

The publisher is remapped to `<topic>_source`; the proxy publishes `<topic>`. Messages pass as bytes and are decoded only to be changed.
"""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

from push_ident_sim.faults.harness.topics import TOPICS, qos_of

__all__ = ["PASS", "Proxy", "Rule", "changed", "delayed", "drop", "duplicated", "lossy", "reordered", "source_of"]

Rule = Callable[[bytes, float], list[tuple[float, bytes]]]
"""A message and its time of receipt [s] give the messages to send, each with a delay [s]."""


def PASS(data: bytes, now: float) -> list[tuple[float, bytes]]:
    """Every message as it is."""
    return [(0.0, data)]


def drop(data: bytes, now: float) -> list[tuple[float, bytes]]:
    """No message."""
    return []


def delayed(seconds: float) -> Rule:
    """Every message later [s]."""
    return lambda data, now: [(seconds, data)]


def duplicated(data: bytes, now: float) -> list[tuple[float, bytes]]:
    """Every message twice."""
    return [(0.0, data), (0.0, data)]


def reordered(spread: float, seed: int = 0) -> Rule:
    """Delays drawn from 0 to `spread` [s], so that messages overtake each other."""
    rng = np.random.default_rng(seed)
    return lambda data, now: [(float(rng.uniform(0.0, spread)), data)]


def lossy(share: float, seed: int = 0) -> Rule:
    """Drop a share of the messages at random."""
    rng = np.random.default_rng(seed)
    return lambda data, now: [(0.0, data)] if rng.random() >= share else []


def changed(topic: str, change: Callable[[Any], Any]) -> Rule:
    """Every message of a topic of `TOPICS` after `change`, which may alter its argument; None drops it."""

    def rule(data: bytes, now: float) -> list[tuple[float, bytes]]:
        msg = deserialize_message(data, TOPICS[topic].kind)
        answer = change(msg)
        return [] if answer is None else [(0.0, serialize_message(answer))]

    return rule


def source_of(topic: str) -> str:
    """Where the publisher of a topic that passes the proxy is remapped to: a name that neither trackers nor recorders look for."""
    return ("/" if topic.startswith("/") else "") + topic.strip("/").replace("/", "_") + "_source"


@dataclass(slots=True)
class _Route:
    """One topic."""

    kind: type
    publisher: Any
    rule: Rule = PASS
    latest: bytes = b""
    """Of the source."""
    seen: list[Callable[[float, bytes], None]] = field(default_factory=list)
    """Called with every message of the source."""


class Proxy:
    """Relays topics, each under a rule that can be changed at any time.

    Args:
        node: that subscribes and publishes.
        topics: of `TOPICS`.
    """

    def __init__(self, node: Node, topics: tuple[str, ...]) -> None:
        self._node = node
        self._late: list[tuple[float, int, Any, bytes]] = []
        self._order = itertools.count()
        self._wake = threading.Condition()
        self._over = False
        self._routes: dict[str, _Route] = {}
        for topic in topics:
            kind, qos = TOPICS[topic].kind, qos_of(topic)
            route = self._routes[topic] = _Route(kind, node.create_publisher(kind, topic, qos))
            node.create_subscription(kind, source_of(topic), lambda data, route=route: self._take(route, data), qos, raw=True)
        self._thread = threading.Thread(target=self._send_late, name="proxy", daemon=True)
        self._thread.start()

    @property
    def topics(self) -> tuple[str, ...]:
        """What passes it."""
        return tuple(self._routes)

    def set(self, topic: str, rule: Rule) -> float:
        """Put a topic under a rule from now on; the time [s], of `time.monotonic`."""
        self._routes[topic].rule = rule
        return time.monotonic()

    def set_all(self, rule: Callable[[str], Rule]) -> float:
        """Put every topic under the rule made for it; the time [s]."""
        for topic in self._routes:
            self.set(topic, rule(topic))
        return time.monotonic()

    def clear(self) -> None:
        """Let everything pass."""
        self.set_all(lambda topic: PASS)

    def watch(self, topic: str, take: Callable[[float, bytes], None]) -> None:
        """Call `take` with the time of receipt [s] and the bytes of each message of the source, before the rule."""
        self._routes[topic].seen.append(take)

    def latest(self, topic: str) -> Any:
        """The latest message of the source of a topic; one with no content before the first."""
        route = self._routes[topic]
        return deserialize_message(route.latest, route.kind) if route.latest else route.kind()

    def close(self) -> None:
        """Stop sending; subscriptions end with the node."""
        with self._wake:
            self._over = True
            self._wake.notify()
        self._thread.join(timeout=1.0)

    def _take(self, route: _Route, data: bytes) -> None:
        now = time.monotonic()
        route.latest = data
        for take in route.seen:
            take(now, data)
        for delay, out in route.rule(data, now):
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
                if not self._late or self._late[0][0] > time.monotonic():
                    self._wake.wait(timeout=_LOOK if not self._late else min(_LOOK, max(1e-4, self._late[0][0] - time.monotonic())))
                    continue
                _, _, publisher, data = heapq.heappop(self._late)
            publisher.publish(data)


_LOOK: Final = 0.1
"""Longest time between two looks for delayed messages [s]."""
