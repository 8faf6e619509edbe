"""bag_recorder_node as a real process: what happens to the bag when the disk, or the process, gives up."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from helpers.executor_cell import Stalls
from push_ident.bags.opening import open_bag
from push_ident.bags.salvage import salvage
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import position_to_msg
from push_ident.nodes.recording.recording_port import RECORDING_QOS

pytestmark = pytest.mark.alone

FULL = 10_000_000
"""[MiB] that no disk has free."""


class User:
    """Publishes the pusher and hears what the recorder says of itself."""

    def __init__(self) -> None:
        self.domain = own_domain()
        self.context = Context()
        rclpy.init(context=self.context, domain_id=self.domain)
        self.node = Node("user", context=self.context)
        self.said: list[DiagnosticStatus] = []
        self.recorded = 0
        """Messages of the pusher in the bag, as the recorder reports once a second."""
        self._pusher = self.node.create_publisher(PoseStamped, "pusher/pose", 1000)
        self.node.create_subscription(DiagnosticStatus, "recording", self.said.append, RECORDING_QOS)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        # Long before it asks: a node that has not found the reading end of a client drops its answer.
        self._setter = self.node.create_client(SetParameters, "bag_recorder_node/set_parameters")
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.n_sent = 0

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        values = {value.key: value.value for status in msg.status for value in status.values}
        self.recorded = int(values.get("/pusher/pose", 0))

    def wait_for(self, condition: Callable[[], object], timeout: float = 120.0) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, "timed out"
            self._executor.spin_once(timeout_sec=0.01)

    def send(self, n: int) -> None:
        self.wait_for(lambda: self._pusher.get_subscription_count() > 0)
        for _ in range(n):
            self._pusher.publish(position_to_msg(self.node.get_clock().now().to_msg(), [0.0, 0.0, 0.01]))
            self.n_sent += 1
            self._executor.spin_once(timeout_sec=0.001)

    def set_parameter(self, name: str, value: int) -> None:
        self.wait_for(self._setter.service_is_ready)
        done = self._setter.call_async(SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()]))
        self.wait_for(done.done)
        assert done.result().results[0].successful

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def user() -> Iterator[User]:
    user = User()
    yield user
    user.close()


def record(user: User, bag: Path, *, most_bytes: int | None = None, min_free_mib: int = 1, numbered: bool = False) -> subprocess.Popen[str]:
    def limit() -> None:
        if most_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    parameters = ["-p", f"bag:={bag}", "-p", f"min_free_mib:={min_free_mib}", "-p", f"numbered:={str(numbered).lower()}"]
    return subprocess.Popen(
        [sys.executable, "-m", "push_ident.nodes", "bag_recorder_node", "--ros-args", *parameters],
        env=os.environ | {"ROS_DOMAIN_ID": str(user.domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=limit,
    )


def end(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGINT)
    try:
        output, _ = process.communicate(timeout=30.0)
    finally:
        process.kill()
    assert "Traceback" not in output
    return output


def test_disk_that_runs_low_closes_the_bag_readable_and_is_reported(user: User, tmp_path: Path) -> None:
    process = record(user, tmp_path / "bag")
    try:
        user.wait_for(lambda: user.said)
        assert user.said[0].level != DiagnosticStatus.ERROR
        user.send(200)
        user.wait_for(lambda: user.recorded == 200)
        user.set_parameter("min_free_mib", FULL)
        user.wait_for(lambda: user.said[-1].level == DiagnosticStatus.ERROR)
        assert "MiB free" in user.said[-1].message
        # Closed at once, not when the process ends.
        user.wait_for((tmp_path / "bag" / "metadata.yaml").exists, 10.0)
        report = salvage(tmp_path / "bag", tmp_path / "copy")
        assert report.total == 200 and report.end == ""
        assert process.poll() is None
        user.send(10)
    finally:
        output = end(process)
    assert process.returncode == 0 and "200 messages" in output


def test_disk_that_refuses_a_write_is_reported_and_the_rest_stays_readable(user: User, tmp_path: Path) -> None:
    process = record(user, tmp_path / "bag", most_bytes=30_000)
    try:
        user.wait_for(lambda: user.said)
        while user.said[-1].level != DiagnosticStatus.ERROR:
            assert user.n_sent < 20_000
            user.send(50)
            time.sleep(0.1)
        assert "cannot be written" in user.said[-1].message
        assert salvage(tmp_path / "bag", tmp_path / "copy").total > 0
    finally:
        end(process)


def test_kill_loses_no_more_than_a_second(user: User, tmp_path: Path) -> None:
    process = record(user, tmp_path / "bag")
    try:
        user.wait_for(lambda: user.said)
        for _ in range(15):
            user.send(20)
            time.sleep(0.1)
        sent_before = user.n_sent
        with Stalls() as stalls:
            began = time.monotonic()
            while time.monotonic() - began < 2.0 + 4.0 * stalls.worst:
                user.send(5)
                time.sleep(0.1)
    finally:
        process.kill()
        process.communicate(timeout=30.0)
    assert salvage(tmp_path / "bag", tmp_path / "copy").total >= sent_before


def test_recorder_started_again_after_its_death_begins_the_next_bag_and_keeps_the_first(user: User, tmp_path: Path) -> None:
    killed = record(user, tmp_path / "bag", numbered=True)
    try:
        user.wait_for(lambda: user.said)
        user.send(50)
    finally:
        killed.kill()
        killed.communicate(timeout=30.0)
    first = sorted((path, path.read_bytes()) for path in (tmp_path / "bag").rglob("*") if path.is_file())
    user.said.clear()
    again = record(user, tmp_path / "bag", numbered=True)
    try:
        user.wait_for(lambda: user.said)
        user.recorded, deadline = 0, time.monotonic() + 120.0
        while user.recorded < 5:  # the subscription of the killed one is still counted for a while
            assert time.monotonic() < deadline
            user.send(5)
            time.sleep(0.1)
    finally:
        end(again)
    assert sorted((path, path.read_bytes()) for path in (tmp_path / "bag").rglob("*") if path.is_file()) == first
    with open_bag(tmp_path / "bag_2") as bag:
        assert sum(1 for _ in bag.raw_messages()) >= 5
