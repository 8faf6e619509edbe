"""Identification and a bag player as processes of their own, and an observer of what identification publishes."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.errors import PushIdentError
from push_ident.files import open_log
from push_ident.nodes.base.lifetime import LIFELINE
from push_ident_msgs.msg import MassFrictionMap

__all__ = [
    "IDENTIFICATION",
    "PERCEPTION",
    "PLAYER",
    "NodeProcess",
    "Observer",
    "commands",
    "microseconds",
    "observer",
    "processor_time",
    "resident_memory",
    "until",
]

IDENTIFICATION: Final = "identification_node"
PLAYER: Final = "bag_player_node"
PERCEPTION: Final = "perception_node"
_POLL: Final = 0.02
_LOOK: Final = 0.05
"""Period at which the observer checks whether it should end [s]."""


class NodeProcess:
    """One node as a process of its own; killed at the end of the context if it still runs.

    Args:
        command: what to run.
        log: file for what it writes.
        domain: its ROS domain.
    """

    def __init__(self, command: NodeCommand, log: Path, domain: int) -> None:
        self.name, self._log = command.name, log
        # The pipe ends with this process, and the node with the pipe.
        watched, self._lifeline = os.pipe()
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1", LIFELINE: str(watched)}
        with open_log(log) as file:
            self._popen = subprocess.Popen(
                command.argv,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                pass_fds=(watched,),
                start_new_session=True,
            )
        os.close(watched)

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._popen.pid

    @property
    def runs(self) -> bool:
        """Whether the process still runs."""
        return self._popen.poll() is None

    @property
    def output(self) -> str:
        """All that this process, and those before it with the same file, wrote."""
        return self._log.read_text(encoding="utf-8", errors="replace")

    def check(self) -> None:
        """Raise PushIdentError, with its last lines, when it ended with a failure."""
        code = self._popen.poll()
        if code:
            raise PushIdentError(f"{self.name} ended with exit code {code}: {' / '.join(self.output.splitlines()[-3:])}")

    def kill(self) -> None:
        """Kill it, as a crash does."""
        if self.runs:
            os.killpg(self.pid, signal.SIGKILL)
        self._popen.wait()
        if self._lifeline >= 0:
            os.close(self._lifeline)
            self._lifeline = -1

    def interrupt(self, patience: float = 5.0) -> tuple[int, float]:
        """Ctrl-C: exit code and time to the end [s]; killed after `patience` [s]."""
        requested = time.monotonic()
        if self.runs:
            os.killpg(self.pid, signal.SIGINT)
        try:
            self._popen.wait(patience)
        except subprocess.TimeoutExpired:
            self.kill()
        return int(self._popen.returncode), time.monotonic() - requested

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.kill()


class Observer(Node):
    """Records what identification publishes. Times of arrival: `time.monotonic` [s]."""

    def __init__(self, context: Context, object_id: str) -> None:
        super().__init__("live_observer", context=context)
        latched = QoSProfile(depth=200, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        prefix = f"objects/{object_id}"
        self.counts: dict[str, str] = {}
        """Latest diagnostics of identification."""
        self.reported = 0
        """How many came."""
        self.pose_at: dict[int, float] = {}
        """Arrival of the pose with a stamp [µs]."""
        self.map_at: dict[int, float] = {}
        """Arrival of the first map with a stamp [µs]."""
        self.n_pushes = 0
        """Of the latest map."""
        self.n_cells = 0
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self.create_subscription(MassFrictionMap, f"{prefix}/mass_friction_map", self._on_map, latched)
        self.create_subscription(PoseWithCovarianceStamped, f"{prefix}/pose", self._on_pose, QoSProfile(depth=1000))

    def count(self, name: str) -> int:
        """A counter of identification; 0 before it counted anything."""
        return int(self.counts.get(name, "0"))

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.name.strip("/") == IDENTIFICATION:
                self.counts = {value.key: value.value for value in status.values}
                self.reported += 1

    def _on_map(self, msg: MassFrictionMap) -> None:
        self.map_at.setdefault(microseconds(msg.header.stamp), time.monotonic())
        self.n_pushes, self.n_cells = int(msg.n_pushes), len(msg.x)

    def _on_pose(self, msg: PoseWithCovarianceStamped) -> None:
        self.pose_at[microseconds(msg.header.stamp)] = time.monotonic()


def microseconds(stamp: Time) -> int:
    """A stamp as a whole number: seconds as a float do not keep finer digits."""
    return 10**6 * int(stamp.sec) + round(stamp.nanosec / 1000)


@contextmanager
def observer(domain: int, object_id: str, node: type[Observer] = Observer, **arguments: Any) -> Iterator[Any]:
    """An observer that spins in a thread of its own."""
    context = Context()
    context.init(domain_id=domain)
    executor = SingleThreadedExecutor(context=context)
    stop = threading.Event()

    def spin() -> None:
        while not stop.is_set():
            executor.spin_once(timeout_sec=_LOOK)

    observer = node(context, object_id, **arguments)
    executor.add_node(observer)
    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield observer
    finally:
        stop.set()
        thread.join(timeout=2.0)
        executor.shutdown(timeout_sec=0.5)
        observer.destroy_node()
        context.try_shutdown()


def commands(bag: Path, parameters: Mapping[str, Mapping[str, object]], *, perception: bool = False) -> dict[str, NodeCommand]:
    """By name: identification and the player of a bag, as `push-ident replay` starts them."""
    return {c.name: c for c in node_commands("replay", bag=bag, perception=perception, parameters=parameters, log_level="info")}


def until(condition: Callable[[], object], patience: float, missing: str, *processes: NodeProcess) -> None:
    """Raises PushIdentError, saying what is `missing`, after `patience` [s], or when one of `processes` fails."""
    deadline = time.monotonic() + patience
    while not condition():
        for process in processes:
            process.check()
        if time.monotonic() > deadline:
            raise PushIdentError(f"{missing} within {patience:.0f} s")
        time.sleep(_POLL)


def resident_memory(pid: int) -> float:
    """Of a process [MB]."""
    with open(f"/proc/{pid}/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def processor_time(pid: int) -> float:
    """Of a process, user and system [s]."""
    with open(f"/proc/{pid}/stat", encoding="ascii") as file:
        fields = file.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
