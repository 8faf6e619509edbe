"""bag_recorder_node as a real process: a disk that fills up, and a process that is killed, cost no more than the last second."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from helpers.executor_cell import Stalls
from helpers.node_process import NodeProcess, Talker
from push_ident.bags.opening import open_bag
from push_ident.bags.salvage import salvage
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import position_to_msg

FULL = 10_000_000
"""[MiB] that no disk has free."""


class User(Talker):
    """Publishes the pusher and hears what the recorder says of itself."""

    def __init__(self, domain: int, folder: Path) -> None:
        super().__init__(domain)
        self._domain, self._folder = domain, folder
        self.said: list[DiagnosticStatus] = []
        self.n_sent = 0
        self._pusher = self.node.create_publisher(PoseStamped, "pusher/pose", 1000)
        self.node.create_subscription(DiagnosticStatus, "recording", self.said.append, LATCHED)
        # Long before it asks: a node that has not found the reading end of a client drops its answer.
        self._setter = self.node.create_client(SetParameters, "bag_recorder_node/set_parameters")

    def record(self, *, most_bytes: int | None = None, **parameters: object) -> NodeProcess:
        """A recorder that has begun; none of its files becomes larger than `most_bytes`."""

        def limit() -> None:
            if most_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

        chosen = {"bag": str(self._folder / "bag"), "min_free_mib": 1} | parameters
        process = NodeProcess("bag_recorder_node", "push_ident.nodes", chosen, self._domain, self._folder, before=limit)
        self.until(lambda: self.said)
        return process

    @property
    def recorded(self) -> int:
        """Messages of the pusher in the bag, as the recorder reports once a second."""
        return int(self.values().get("/pusher/pose", 0))

    def send(self, n: int) -> None:
        self.until(lambda: self._pusher.get_subscription_count() > 0)
        for _ in range(n):
            self._pusher.publish(position_to_msg(self.node.get_clock().now().to_msg(), [0.0, 0.0, 0.01]))
            self.n_sent += 1
            self.spin(0.001)

    def set_parameter(self, name: str, value: int) -> None:
        answer = self.ask(self._setter, SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()]))
        assert answer.results[0].successful


@pytest.fixture
def user(tmp_path: Path) -> Iterator[User]:
    with User(own_domain(), tmp_path) as user:
        yield user


@pytest.mark.live
def test_disk_that_runs_low_closes_the_bag_readable_and_is_reported(user: User, tmp_path: Path) -> None:
    recorder = user.record()
    try:
        assert user.said[0].level != DiagnosticStatus.ERROR
        user.send(200)
        user.until(lambda: user.recorded == 200)
        user.set_parameter("min_free_mib", FULL)
        user.until(lambda: user.said[-1].level == DiagnosticStatus.ERROR)
        assert "MiB free" in user.said[-1].message
        # Closed at once, not when the process ends.
        user.until((tmp_path / "bag" / "metadata.yaml").exists, timeout=10.0)
        report = salvage(tmp_path / "bag", tmp_path / "copy")
        assert report.total == 200 and report.end == ""
        assert recorder.runs
        user.send(10)
    finally:
        code = recorder.stop()
    assert code == 0 and "200 messages" in recorder.output and "Traceback" not in recorder.output


@pytest.mark.live
def test_disk_that_refuses_a_write_is_reported_and_the_rest_stays_readable(user: User, tmp_path: Path) -> None:
    recorder = user.record(most_bytes=30_000)
    try:
        while user.said[-1].level != DiagnosticStatus.ERROR:
            assert user.n_sent < 20_000
            user.send(50)
            time.sleep(0.1)
        assert "cannot be written" in user.said[-1].message
        assert salvage(tmp_path / "bag", tmp_path / "copy").total > 0
    finally:
        recorder.stop()
    assert "Traceback" not in recorder.output


@pytest.mark.alone
def test_kill_loses_no_more_than_a_second_and_the_next_recorder_begins_another_bag(user: User, tmp_path: Path) -> None:
    killed = user.record(numbered=True)
    try:
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
        killed.kill()
    assert salvage(tmp_path / "bag", tmp_path / "copy").total >= sent_before
    first = sorted((path, path.read_bytes()) for path in (tmp_path / "bag").rglob("*") if path.is_file())
    user.said.clear()
    again = user.record(numbered=True)
    try:
        user.forget()
        deadline = time.monotonic() + 120.0
        while user.recorded < 5:  # the subscription of the killed one is still counted for a while
            assert time.monotonic() < deadline
            user.send(5)
            time.sleep(0.1)
    finally:
        again.stop()
    assert sorted((path, path.read_bytes()) for path in (tmp_path / "bag").rglob("*") if path.is_file()) == first
    with open_bag(tmp_path / "bag_2") as bag:
        assert sum(1 for _ in bag.raw_messages()) >= 5
