"""What the nodes of a cell publish, with the time at which it came; and a hand to publish, ask and command from outside."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from system.faults.proxy import OBJECT, TOPICS, qos_of, source_of
from trajectory_msgs.msg import JointTrajectory

from helpers.executor_cell import Stalls, ask
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident.types import Float64Array
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import MassFrictionMap, PushPrediction, PushRecord
from push_ident_sim.cell.robot import JOINT_NAMES

ASK_AGAIN = 2.5
"""A server that was killed is known to the graph for some seconds: after so long without an answer it is asked again [s]."""


def until(condition: Callable[[], object], patience: float, missing: str, every: float = 0.005) -> None:
    """Fail, saying what is `missing`, where `condition` is not true within `patience` [s]; looks at it `every` so many seconds."""
    deadline = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < deadline, f"{missing} within {patience:.0f} s"
        time.sleep(every)


@dataclass(frozen=True)
class ArmSample:
    received: float
    """[s], `time.monotonic`"""
    stamp: float
    """[s], time of the cell"""
    q: Float64Array
    """[rad], in the order of `JOINT_NAMES`."""
    velocity: Float64Array
    """[rad/s]"""

    @property
    def speed(self) -> float:
        return float(np.abs(self.velocity).max())


@dataclass(frozen=True)
class Reported:
    received: float
    message: str
    values: dict[str, str]

    @property
    def refused(self) -> int:
        return int(self.values.get("refused", "0"))

    def says(self, *words: str) -> bool:
        text = f"{self.message} {self.values}".lower()
        return all(word.lower() in text for word in words)


@dataclass
class Goal:
    phases: list[int] = field(default_factory=list)
    """Of the feedback so far."""
    handle: Any = None
    future: Any = None

    @property
    def result(self) -> ExecutePush.Result | None:
        """None before it ended."""
        return self.future.result().result if self.future.done() else None


class Monitor(Node):
    """Callbacks run in a thread. What was heard is in the lists, with its time of receipt; they grow until `forget`."""

    def __init__(self, context: Context) -> None:
        super().__init__("fault_monitor", context=context)
        self._raw_states: list[tuple[float, bytes]] = []
        self.commands: list[tuple[float, JointTrajectory]] = []
        self.records: list[tuple[float, PushRecord]] = []
        self.maps: list[tuple[float, MassFrictionMap]] = []
        self.predictions: list[tuple[float, PushPrediction]] = []
        self._reports: dict[str, list[Reported]] = {}
        """By name of the node."""
        self.stalls = Stalls().__enter__()
        """How long this process had to wait for a processor since `forget`."""
        self._own: dict[str, Any] = {}
        for kind, topic, kept, raw in (
            (JointState, source_of("joint_states"), self._raw_states, True),
            (JointTrajectory, "joint_trajectory", self.commands, False),
            (PushRecord, "push_record", self.records, False),
            (MassFrictionMap, f"objects/{OBJECT}/mass_friction_map", self.maps, False),
            (PushPrediction, f"objects/{OBJECT}/prediction", self.predictions, False),
        ):
            self.create_subscription(kind, topic, lambda msg, kept=kept: kept.append((time.monotonic(), msg)), 200, raw=raw)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 200)
        self._push = ActionClient(self, ExecutePush, "execute_push")

    def states(self, since: float = 0.0) -> list[ArmSample]:
        """True joint states, before the proxy, received from `since` [s] on."""
        return [_sample(received, data) for received, data in list(self._raw_states) if received >= since]

    def latest_state(self) -> ArmSample | None:
        """None before the first."""
        return _sample(*self._raw_states[-1]) if self._raw_states else None

    def forget(self) -> None:
        for kept in (self._raw_states, self.commands, self.records, self.maps, self.predictions):
            kept.clear()  # type: ignore[attr-defined]
        for reports in self._reports.values():
            del reports[:-1]
        self.stalls.worst = 0.0

    def reports_of(self, node: str, since: float = 0.0) -> list[Reported]:
        """All statuses of a node that came from `since` [s] on, oldest first."""
        return [report for report in list(self._reports.get(node, ())) if report.received >= since]

    # ---- from outside

    def send(self, goal: ExecutePush.Goal, patience: float = 20.0) -> Goal:
        """Request a push; returns when it was accepted."""
        until(self._push.server_is_ready, patience, "execute_push was not served")
        sent = Goal()
        asked = ask(self, lambda: self._push.send_goal_async(goal, feedback_callback=lambda m: sent.phases.append(int(m.feedback.phase))))
        until(asked.done, patience, "execute_push did not answer")
        sent.handle = asked.result()
        assert sent.handle.accepted, "execute_push refused the goal"
        sent.future = ask(self, sent.handle.get_result_async)
        return sent

    def call(self, kind: type, name: str, request: Any, patience: float = 10.0) -> Any:
        """Answer of a service that may be asked again."""
        client = self.create_client(kind, name)
        deadline = time.monotonic() + patience
        try:
            until(client.service_is_ready, patience, f"{name} was not served")
            while time.monotonic() < deadline:
                future = ask(self, lambda: client.call_async(request))
                again = time.monotonic() + min(ASK_AGAIN, patience)
                while not future.done() and time.monotonic() < again:
                    time.sleep(0.005)
                if future.done():
                    return future.result()
            raise AssertionError(f"{name} did not answer within {patience:.0f} s")
        finally:
            self.destroy_client(client)

    def publish(self, topic: str, msg: Any) -> float:
        """Publish a message of a topic of `TOPICS`, or the bytes of one, once somebody listens; the time [s]."""
        if topic not in self._own:
            publisher = self._own[topic] = self.create_publisher(TOPICS[topic].kind, topic, qos_of(topic))
            until(publisher.get_subscription_count, 5.0, f"nobody listens to {topic}")
            time.sleep(0.1)  # the other end learns of the match a little later
        self._own[topic].publish(msg)
        return time.monotonic()

    def withdraw(self) -> None:
        while self._own:
            self.destroy_publisher(self._own.popitem()[1])

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            report = Reported(time.monotonic(), status.message, {value.key: value.value for value in status.values})
            self._reports.setdefault(status.name.strip("/").split(":")[0], []).append(report)


def _sample(received: float, data: bytes) -> ArmSample:
    msg = deserialize_message(data, JointState)
    order = [list(msg.name).index(name) for name in JOINT_NAMES]
    return ArmSample(received, stamp_from_msg(msg.header.stamp), np.array(msg.position)[order], np.array(msg.velocity)[order])
