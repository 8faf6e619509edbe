"""Every node of the suite as a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import ListParameters, SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from helpers.bags import write_push
from push_ident.bags.writer import BagWriter
from push_ident_msgs.srv import SaveModel

REPEATABLE = (GetState.Request, ListParameters.Request, SetParameters.Request, SaveModel.Request)
"""Requests that may be made twice."""
AGAIN = 2.5
"""After so long one of them is made again [s]."""


def node_commands(folder: Path) -> dict[str, tuple[str, dict[str, object]]]:
    """Module and parameters of every node, such that it runs for long without others; `folder` is for its files."""
    bag = folder / "played"
    with BagWriter(bag) as writer:
        write_push(writer, 10.0)
    return {
        "perception_node": ("push_ident.nodes", {}),
        "push_executor_node": ("push_ident.nodes", {}),
        "identification_node": ("push_ident.nodes", {}),
        "gap_diagnosis_node": ("push_ident.nodes", {}),
        "goal_pushing_node": ("push_ident.nodes", {}),
        "bag_player_node": ("push_ident.nodes", {"bag": str(bag), "rate": 0.001, "wait": 0.0}),
        "bag_recorder_node": ("push_ident.nodes", {"bag": str(folder / "recorded"), "min_free_mib": 1}),
        "viewer_node": ("push_ident.nodes", {"output": "file", "file": str(folder / "shown.rrd")}),
        "sim_cell_node": ("push_ident_sim", {"camera_rate": 0.0}),
        "sim_hand_node": ("push_ident_sim", {}),
    }


class NodeProcess:
    def __init__(
        self,
        name: str,
        module: str,
        parameters: Mapping[str, object],
        domain: int,
        folder: Path,
        *,
        before: Callable[[], object] | None = None,
    ) -> None:
        """`before` is called in the process before the node."""
        self.name, self._log = name, folder / f"{name}.log"
        arguments = [part for key, value in parameters.items() for part in ("-p", f"{key}:={json.dumps(value)}")]
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, name, "--ros-args", *arguments],
                env=os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_PYTHON_CHECK_FIELDS": "1"},
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=folder,
                preexec_fn=before,
            )

    @property
    def runs(self) -> bool:
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def output(self) -> str:
        return self._log.read_text(errors="replace")

    def wait(self, timeout: float) -> int:
        """Its exit code, when it has ended by itself."""
        return self._process.wait(timeout)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def stop(self) -> int:
        if self.runs:
            self._process.send_signal(signal.SIGINT)
        try:
            return self._process.wait(30.0)
        finally:
            self._process.kill()


class Talker:
    """Publishes, asks and listens to the status of the nodes of a domain. A context manager."""

    def __init__(self, domain: int) -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node("talker", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._publishers: dict[str, Any] = {}
        self._reports: list[DiagnosticStatus] = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", lambda msg: self._reports.extend(msg.status), 10)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def publish(self, kind: type, topic: str, message: object) -> None:
        """Send one message; latched, so that one that listens later has it."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(
                kind, topic, QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            )
        self._publishers[topic].publish(message)

    def values(self, node: str = "") -> dict[str, str]:
        """Of the latest status; with several nodes, of the one whose name contains `node`."""
        own = [report for report in self._reports if node in report.name]
        return {value.key: value.value for report in own[-1:] for value in report.values}

    def forget(self) -> None:
        self._reports.clear()

    def spin(self, seconds: float) -> None:
        self._executor.spin_once(timeout_sec=seconds)

    def result_of(self, future: Any, timeout: float = 120.0) -> Any:
        self.until(future.done, timeout=timeout)
        return future.result()

    def until(self, condition: Callable[[], object], meanwhile: Callable[[], object] = lambda: None, timeout: float = 120.0) -> None:
        """Spin until `condition` is true, calling `meanwhile` again and again."""
        wait_for(condition, timeout, lambda: (meanwhile(), self.spin(0.05)), lambda: f"the node says {self._reports[-1:]}")

    def ask(self, client: Any, request: object, timeout: float = 60.0) -> Any:
        """The answer of a service.

        A server that has not found the reading end of a client yet drops its answer: what may be asked twice is asked again.
        """
        self.until(client.service_is_ready)
        futures: list[Any] = []
        asked = 0.0

        def ask_again() -> None:
            nonlocal asked
            if not futures or (isinstance(request, REPEATABLE) and time.monotonic() > asked + AGAIN):
                futures.append(client.call_async(request))
                asked = time.monotonic()

        self.until(lambda: any(future.done() for future in futures), ask_again, timeout)
        return next(future for future in futures if future.done()).result()


def wait_for(
    condition: Callable[[], object],
    timeout: float | Callable[[], float] = 60.0,
    meanwhile: Callable[[], object] = lambda: time.sleep(0.002),
    why: Callable[[], str] = str,
) -> None:
    """`timeout` [s] may grow while it waits, with what the machine lets threads wait; `why` says more of a condition that stays false."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < (timeout() if callable(timeout) else timeout), f"timed out; {why()}"
        meanwhile()


def is_alive(process: int) -> bool:
    """Whether a process runs, one that has ended and waits for its parent excepted."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
