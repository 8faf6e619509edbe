"""One node as a process on a ROS domain of its own, and beside it the fuzzer's own node, which publishes, calls and listens."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import ListParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

from push_ident.cli.supervisor import NodeCommand
from push_ident.nodes.executables import NODES
from push_ident_sim.executables import NODES as SIM_NODES
from push_ident_sim.fuzz.fields import interface_class
from push_ident_sim.studies.common.live_nodes import NodeProcess, resident_memory

__all__ = ["HANG", "Bench", "Interfaces", "NodeFailure", "Sent", "granted", "program_of"]

HANG: Final = 10.0
"""A node that does not answer for so long hangs [s], where the machine has a processor for every process that wants one."""
_START: Final = 60.0
"""Longest wait for a node to serve its parameters after the start [s]."""
_LOOK: Final = 0.002
_ATTEMPTS: Final = 3
"""To publish a message."""
_TRACEBACK: Final = ("Traceback (most recent call last)", "Fatal Python error", "Segmentation fault", "terminate called")
_LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_LATE_ANSWERS: Final = ("/_action/get_result",)
"""Services that answer when something else has ended."""


_KEPT: Final = 6000
"""Messages that are remembered, to find out which of them made the node fail."""
_KEPT_BYTES: Final = 300_000_000


class NodeFailure(Exception):
    """What a node must never do."""

    def __init__(self, kind: str, text: str) -> None:
        """`kind`: died, hangs, traceback, memory, no work, motion."""
        super().__init__(f"{kind}: {text}")
        self.kind = kind


@dataclass(frozen=True, slots=True)
class Sent:
    """One message or request that the node was sent."""

    to: str
    """Topic or service."""
    kind: Any
    """Class of the message or service."""
    data: bytes
    """Serialised message or request."""
    valid: bool = False
    is_request: bool = False


@dataclass(frozen=True, slots=True)
class Interfaces:
    """What a node takes in: full name and type of each."""

    topics: dict[str, str]
    services: dict[str, str]
    """Those of its actions and of its parameters included."""


def granted(seconds: float) -> float:
    """A patience [s], longer by as much as this machine has more to do than it can do at once."""
    return seconds * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def program_of(executable: str) -> str:
    """The module that runs an executable of the suite."""
    return "push_ident_sim" if executable in SIM_NODES and executable not in NODES else "push_ident.nodes"


class Bench:
    """Runs one node in an empty folder. Everything happens in the caller's thread; use it as a context manager."""

    def __init__(self, executable: str, folder: Path, domain: int, parameters: Mapping[str, object]) -> None:
        """`folder` becomes the working folder and the home of the process; `parameters` are those of the node."""
        folder.mkdir(parents=True, exist_ok=True)
        self.executable, self.folder, self.domain = executable, folder, domain
        self.name = f"/{executable}"
        self.log = folder / "log.txt"
        self.sent: Counter[str] = Counter()
        """Mutated messages and requests by topic and service."""
        self.valid = 0
        """Valid messages."""
        self.history: deque[Sent] = deque()
        """The latest messages and requests, valid ones included."""
        self._kept_bytes = 0
        self.diagnostics: dict[str, str] = {}
        """Keys and values of the node's latest status; empty before the first."""
        self.reports = 0
        self._parameters = dict(parameters)
        self._context = Context()
        self._context.init(domain_id=domain)
        self.node = Node("fuzzer", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._publishers: dict[str, Publisher] = {}
        self._clients: dict[str, Any] = {}
        self._process: NodeProcess | None = None
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)

    # ---- the process

    def start(self) -> None:
        """Start the node and wait until it serves its parameters."""
        arguments = [part for key, value in self._parameters.items() for part in ("-p", f"{key}:={json.dumps(value)}")]
        argv = (sys.executable, "-m", program_of(self.executable), self.executable, "--ros-args", *arguments)
        with _folder(self.folder):
            self._process = NodeProcess(NodeCommand(self.executable, argv), self.log, self.domain)
        deadline = time.monotonic() + granted(_START)
        while not self._listed(self._client(f"{self.name}/list_parameters", ListParameters)):
            self.check()
            if time.monotonic() > deadline:
                raise NodeFailure("hangs", f"{self.executable} did not start within {_START:.0f} s")
        self.probe()

    def _listed(self, client: Any) -> bool:
        self.spin(0.05)
        return bool(client.service_is_ready())

    def stop(self) -> int:
        """Ctrl-C; the exit code, or a failure when it had to be killed."""
        assert self._process is not None
        patience = granted(HANG)
        code, seconds = self._process.interrupt(patience)
        if seconds > patience - 0.1:
            raise NodeFailure("hangs", f"did not end within {patience:.0f} s after SIGINT")
        # A node ends itself with exit code 1 where it takes over 1.8 s, as it may on a busy machine.
        if code != 0 and not (code == 1 and seconds > 1.5 and granted(1.0) > 1.0):
            raise NodeFailure("died", f"ended with exit code {code} after SIGINT")
        return code

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._process is not None:
            self._process.kill()
        self._executor.shutdown(timeout_sec=0.5)
        self.node.destroy_node()
        self._context.try_shutdown()

    @property
    def memory(self) -> float:
        """Resident memory of the node [MB]."""
        assert self._process is not None
        return resident_memory(self._process.pid) if self._process.runs else 0.0

    def check(self) -> None:
        """Raise NodeFailure when the process has ended or logged a traceback."""
        assert self._process is not None
        text = self.log.read_text(encoding="utf-8", errors="replace")
        if not self._process.runs:
            raise NodeFailure("died", "the process ended: " + _end_of(text))
        if any(mark in text for mark in _TRACEBACK):
            raise NodeFailure("traceback", _end_of(text))

    # ---- what the node takes in

    @property
    def topics_used(self) -> frozenset[str]:
        """Topics that were published on."""
        return frozenset(self._publishers)

    def interfaces(self) -> Interfaces:
        """Subscriptions and services of the node as the ROS graph has them, actions included."""
        node = self.node
        topics = dict(node.get_subscriber_names_and_types_by_node(self.executable, "/"))
        services = dict(node.get_service_names_and_types_by_node(self.executable, "/"))
        return Interfaces({name: types[0] for name, types in topics.items()}, {name: types[0] for name, types in services.items()})

    def publisher(self, topic: str, kind: Any) -> Publisher:
        """The one publisher of a topic, with the quality of service that the node asks for."""
        if topic not in self._publishers:
            readers = [info.qos_profile for info in self.node.get_subscriptions_info_by_topic(topic) if info.node_name == self.executable]
            latched = any(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in readers)
            self._publishers[topic] = self.node.create_publisher(kind, topic, _LATCHED if latched else _everything())
            self.spin(0.02)
        return self._publishers[topic]

    def offer(self, topic: str, kind: Any, *, latched: bool = False) -> Publisher:
        """Make the publisher of a topic before the node looks for it."""
        self._publishers[topic] = self.node.create_publisher(kind, topic, _LATCHED if latched else _everything())
        return self._publishers[topic]

    def publish(self, topic: str, kind: Any, msg: Any, *, valid: bool = False) -> None:
        """A message or serialised bytes. One that DDS does not take is dropped."""
        publisher = self.publisher(topic, kind)
        try:
            data = msg if isinstance(msg, bytes) else serialize_message(msg)
        except RuntimeError:
            return  # what cannot be written cannot be sent by any publisher
        for _ in range(_ATTEMPTS):
            try:
                publisher.publish(data)
            except rclpy_implementation.RCLError:
                # No room, or longer than a message of this type can be, which DDS does not send.
                self.probe()
            else:
                self._remember(Sent(topic, kind, data, valid=valid))
                return

    def _remember(self, sent: Sent) -> None:
        if sent.valid:
            self.valid += 1
        else:
            self.sent[sent.to] += 1
        self.history.append(sent)
        self._kept_bytes += len(sent.data)
        while len(self.history) > _KEPT or (self._kept_bytes > _KEPT_BYTES and len(self.history) > 1):
            self._kept_bytes -= len(self.history.popleft().data)

    # ---- asking

    def request(self, service: str, kind: Any, request: Any) -> Any:
        """As `call`, for a mutated request; None where the node does not serve it any more."""
        client = self._client(service, kind)
        while not self.wait(client.service_is_ready, 1.0):
            if service not in self.interfaces().services:
                return None
        try:
            data = serialize_message(request)
        except RuntimeError:
            # What cannot be written cannot be sent by any client.
            return None
        self._remember(Sent(service, kind, data, is_request=True))
        return self.attempt(service, kind, request)

    def attempt(self, service: str, kind: Any, request: Any) -> Any:
        """As `call`, but None where the node does not serve it any more; a request that was lost in a transition is made again."""
        try:
            return self.call(service, kind, request)
        except NodeFailure:
            self.probe()  # raises where the node is not well
            return self.call(service, kind, request) if service in self.interfaces().services else None

    def replay_request(self, sent: Sent) -> Any:
        """A request of an earlier run."""
        return self.request(sent.to, sent.kind, deserialize_message(sent.data, sent.kind.Request))

    def call(self, service: str, kind: Any, request: Any, patience: float = HANG) -> Any:
        """The answer to a request. Raises NodeFailure when none comes; None from a service that answers when something else has ended."""
        future = self.ask(service, kind, request, patience)
        if service.endswith(_LATE_ANSWERS):
            self.wait(future.done, 0.02)
            return future.result() if future.done() else None
        if not self.wait(future.done, patience):
            raise NodeFailure("hangs", f"{service} did not answer within {patience:.0f} s")
        return future.result()

    def ask(self, service: str, kind: Any, request: Any, patience: float = HANG) -> Any:
        """The future of an answer."""
        client = self._client(service, kind)
        if not self.wait(client.service_is_ready, patience):
            raise NodeFailure("hangs", f"{service} is not served")
        return client.call_async(request)

    def probe(self) -> float:
        """Ask for something that the node always answers, behind all messages that wait; time to the answer [s]."""
        asked = time.monotonic()
        self.call(f"{self.name}/list_parameters", ListParameters, ListParameters.Request(prefixes=["use_sim_time"]))
        return time.monotonic() - asked

    def wait(self, condition: Callable[[], object], patience: float) -> bool:
        """Take in what comes until a condition holds; false after `patience` [s], as granted. Raises NodeFailure when the node ended."""
        deadline, looked = time.monotonic() + granted(patience), time.monotonic()
        while not condition():
            self._executor.spin_once(timeout_sec=_LOOK)
            now = time.monotonic()
            if now > deadline:
                return bool(condition())
            if now > looked + 0.2:
                looked = now
                self.check()
        return True

    def spin(self, seconds: float) -> None:
        """Take in what comes for some time [s]."""
        deadline = time.monotonic() + seconds
        while True:
            self._executor.spin_once(timeout_sec=0.0)
            if time.monotonic() >= deadline:
                return

    def await_report(self, condition: Callable[[dict[str, str]], object], patience: float = 5.0) -> bool:
        """Wait for diagnostics of the node, newer than this call, that fulfil a condition."""
        before = self.reports
        return self.wait(lambda: self.reports > before and condition(self.diagnostics), patience)

    def _client(self, service: str, kind: Any) -> Any:
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service)
        return self._clients[service]

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if self._is_own(status):
                self.diagnostics = {value.key: value.value for value in status.values} | {"message": status.message}
                self.reports += 1

    def _is_own(self, status: DiagnosticStatus) -> bool:
        return bool(status.name.strip("/").split(":")[0] == self.executable)

    def kind_of(self, type_name: str) -> Any:
        """Class of an interface by the name of its type."""
        return interface_class(type_name)


def _everything() -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)


def _end_of(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return " / ".join(lines[-6:])[-1500:]


@contextlib.contextmanager
def _folder(folder: Path) -> Any:
    """What is started inside has `folder` as working folder and as home."""
    before, home = Path.cwd(), os.environ.get("HOME")
    os.chdir(folder)
    os.environ["HOME"] = str(folder)
    try:
        yield
    finally:
        os.chdir(before)
        if home is None:
            del os.environ["HOME"]
        else:
            os.environ["HOME"] = home
