"""What the nodes of a cell publish, with the time at which it came; and a hand to publish, ask and command from outside."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from push_ident.errors import PushIdentError
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import MassFrictionMap, PushPrediction, PushRecord
from push_ident_sim.cell.robot import JOINT_NAMES
from push_ident_sim.faults.harness.topics import OBJECT, TOPICS, qos_of

__all__ = ["ArmSample", "Goal", "Monitor", "Reported", "until"]

_LOOK: Final = 0.05
"""Period at which the thread of the monitor checks whether it should end [s]."""
_POLL: Final = 0.005
_ANSWER: Final = 2.5
"""Longest wait for the answer of a service before it is asked again [s]."""


@dataclass(frozen=True, slots=True)
class ArmSample:
    """One joint state of the arm."""

    received: float
    """[s], `time.monotonic`"""
    stamp: float
    """[s], time of the cell"""
    q: NDArray[np.float64]
    """[rad], in the order of `JOINT_NAMES`."""
    velocity: NDArray[np.float64]
    """[rad/s]"""


@dataclass(frozen=True, slots=True)
class Reported:
    """One status of `/diagnostics`."""

    received: float
    level: bytes
    message: str
    values: dict[str, str]

    @property
    def refused(self) -> int:
        """Messages and requests that were refused so far."""
        return int(self.values.get("refused", "0"))


@dataclass(slots=True)
class Goal:
    """A push that was requested."""

    phases: list[tuple[float, int]] = field(default_factory=list)
    """Time [s] and phase of each feedback."""
    handle: Any = None
    future: Any = None
    ended: float = 0.0
    """When the result came [s]."""
    push_id: int = 0
    """Of the push, as its feedback says; 0: nothing moved yet."""

    @property
    def result(self) -> ExecutePush.Result | None:
        """Of the push; None before it ended."""
        return self.future.result().result if self.future is not None and self.future.done() else None


def until(condition: Callable[[], object], patience: float, missing: str) -> None:
    """Raise PushIdentError, saying what is `missing`, where `condition` is not true within `patience` [s]."""
    deadline = time.monotonic() + patience
    while not condition():
        if time.monotonic() > deadline:
            raise PushIdentError(f"{missing} within {patience:.0f} s")
        time.sleep(_POLL)


class Monitor:
    """A node in a thread of its own. What it heard is in its lists; they grow until `forget`."""

    def __init__(self, domain: int) -> None:
        self._context = Context()
        self._context.init(domain_id=domain)
        self._executor = SingleThreadedExecutor(context=self._context)
        self.node = Node("fault_monitor", context=self._context)
        self._executor.add_node(self.node)
        self._raw_states: list[tuple[float, bytes]] = []
        self.commands: list[tuple[float, JointTrajectory]] = []
        self.records: list[tuple[float, PushRecord]] = []
        self.maps: list[tuple[float, MassFrictionMap]] = []
        self.predictions: list[tuple[float, PushPrediction]] = []
        self.reports: dict[str, list[Reported]] = {}
        """By name of the status."""
        self.stall = 0.0
        """Longest time that this process had to wait for a processor since `forget` [s]."""
        self._publishers: dict[tuple[str, str], Any] = {}
        self._stop = threading.Event()
        for kind, topic, kept in (
            (JointTrajectory, "joint_trajectory", self.commands),
            (PushRecord, "push_record", self.records),
            (MassFrictionMap, f"objects/{OBJECT}/mass_friction_map", self.maps),
            (PushPrediction, f"objects/{OBJECT}/prediction", self.predictions),
        ):
            self.node.create_subscription(kind, topic, lambda msg, kept=kept: kept.append((time.monotonic(), msg)), QoSProfile(depth=200))
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, QoSProfile(depth=200))
        self._push = ActionClient(self.node, ExecutePush, "execute_push")
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._spin, self._watch_stalls)]
        for thread in self._threads:
            thread.start()

    def on_state(self, received: float, data: bytes) -> None:
        """Keep one joint state of the arm, as bytes."""
        self._raw_states.append((received, data))

    @property
    def last_state(self) -> float:
        """When the latest joint state came [s]; 0 before the first."""
        return self._raw_states[-1][0] if self._raw_states else 0.0

    def states(self, since: float = 0.0) -> list[ArmSample]:
        """Joint states received from `since` [s] on."""
        return [_sample(received, data) for received, data in list(self._raw_states) if received >= since]

    def forget(self) -> None:
        """Empty all lists; the latest diagnostics stay."""
        for kept in (self._raw_states, self.commands, self.records, self.maps, self.predictions):
            del kept[:]  # type: ignore[attr-defined]
        for reports in self.reports.values():
            del reports[:-1]
        self.stall = 0.0

    def report_of(self, node: str) -> Reported | None:
        """Latest status of a node; of the first one where it has several."""
        return next((reports[-1] for name, reports in self.reports.items() if _is_of(name, node) and reports), None)

    def reports_of(self, node: str, since: float) -> list[Reported]:
        """All statuses of a node that came from `since` [s] on, oldest first."""
        found = [report for name, reports in list(self.reports.items()) if _is_of(name, node) for report in list(reports)]
        return sorted((report for report in found if report.received >= since), key=lambda report: report.received)

    # ---- from outside

    def send(self, goal: ExecutePush.Goal, patience: float = 20.0) -> Goal:
        """Request a push; returns when it was accepted."""
        until(self._push.server_is_ready, patience, "execute_push was not served")
        sent = Goal()

        def on_feedback(msg: Any) -> None:
            sent.phases.append((time.monotonic(), int(msg.feedback.phase)))
            sent.push_id = int(msg.feedback.push_id) or sent.push_id

        asked = self._ask(lambda: self._push.send_goal_async(goal, feedback_callback=on_feedback), patience)
        until(asked.done, patience, "execute_push did not answer")
        sent.handle = asked.result()
        if not sent.handle.accepted:
            raise PushIdentError("execute_push refused the goal")
        sent.future = self._ask(sent.handle.get_result_async, patience)
        sent.future.add_done_callback(lambda future: setattr(sent, "ended", time.monotonic()))
        return sent

    def call(self, kind: type, name: str, request: Any, patience: float = 10.0) -> Any:
        """Answer of a service that may be asked again: a server that was killed is known to the graph for some seconds."""
        client = self.node.create_client(kind, name)
        deadline = time.monotonic() + patience
        try:
            while True:
                until(client.service_is_ready, max(0.1, deadline - time.monotonic()), f"{name} was not served")
                future = self._ask(lambda: client.call_async(request), patience)
                try:
                    until(future.done, min(_ANSWER, patience), f"{name} did not answer")
                    return future.result()
                except PushIdentError:
                    if time.monotonic() > deadline:
                        raise
        finally:
            self.node.destroy_client(client)

    def publish(self, topic: str, msg: Any, *, kind: type | None = None, qos: QoSProfile | None = None) -> float:
        """Publish a message, or the bytes of one, once somebody listens; the time [s]."""
        kind = kind or TOPICS[topic].kind
        key = (topic, kind.__name__)
        if key not in self._publishers:
            self._publishers[key] = self.node.create_publisher(kind, topic, qos or qos_of(topic))
            deadline = time.monotonic() + 2.0
            while self._publishers[key].get_subscription_count() == 0 and time.monotonic() < deadline:
                time.sleep(_POLL)
            time.sleep(0.1)  # the other end learns of the match a little later
        self._publishers[key].publish(msg)
        return time.monotonic()

    def withdraw(self) -> None:
        """Remove all publishers made by `publish`."""
        while self._publishers:
            self.node.destroy_publisher(self._publishers.popitem()[1])

    def close(self) -> None:
        """End the thread, then the node."""
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        self._executor.shutdown(timeout_sec=0.5)
        self.node.destroy_node()
        self._context.try_shutdown()

    # ---- threads

    def _ask(self, question: Callable[[], Any], patience: float) -> Any:
        # In the thread that spins: from another one, the answer may come before the request is registered, and is dropped.
        answer = self._executor.create_task(question)
        until(answer.done, patience, "the monitor's own thread did not answer")
        return answer.result()

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=_LOOK)

    def _watch_stalls(self) -> None:
        last = time.monotonic()
        while not self._stop.wait(0.01):
            now = time.monotonic()
            self.stall = max(self.stall, now - last - 0.01)
            last = now

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        now = time.monotonic()
        for status in msg.status:
            values = {value.key: value.value for value in status.values}
            self.reports.setdefault(status.name, []).append(Reported(now, status.level, status.message, values))


def _sample(received: float, data: bytes) -> ArmSample:
    msg = deserialize_message(data, JointState)
    order = [list(msg.name).index(name) for name in JOINT_NAMES]
    position, velocity = np.array(msg.position)[order], np.array(msg.velocity)[order]
    return ArmSample(received, stamp_from_msg(msg.header.stamp), position, velocity)


def _is_of(name: str, node: str) -> bool:
    return name.strip("/").split(":")[0] == node
