"""gap_diagnosis_node as a real process: pushes played from a bag, diagnosed on request."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from helpers.executor_cell import Stalls
from push_ident.nodes.base.network import own_domain
from push_ident_msgs.action import DiagnoseGap
from push_ident_msgs.msg import GapReport
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.recordings.recording import RecordingSettings, record_pushes

pytestmark = pytest.mark.live

N_PUSHES = 6
TILT = 0.03


class Cell:
    """The node, a bag that is played to it, and somebody who asks."""

    def __init__(self, bag: Path) -> None:
        self.environment = os.environ | {"ROS_DOMAIN_ID": str(own_domain())}
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(self.environment["ROS_DOMAIN_ID"]))
        self.node = Node("user", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.client = ActionClient(self.node, DiagnoseGap, "diagnose_gap")
        self.said: dict[str, str] = {}
        self.reports: list[GapReport] = []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(GapReport, "gap_report", self.reports.append, latched)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        # The outline of the bag is exact: no camera traced it.
        self.process = self.start("gap_diagnosis_node", outline_from_camera=False)
        player = self.start("bag_player_node", bag=str(bag), rate=0.0, listeners=1, wait=300.0)
        assert player.wait(360.0) == 0
        self.wait_for(lambda: self.said.get("pushes") == str(N_PUSHES), 120.0)

    def start(self, name: str, **parameters: object) -> subprocess.Popen[str]:
        arguments = [part for key, value in parameters.items() for part in ("-p", f"{key}:={json.dumps(value)}")]
        command = [sys.executable, "-m", "push_ident.nodes", name, "--ros-args", *arguments]
        return subprocess.Popen(command, env=self.environment, stderr=subprocess.PIPE, text=True)

    def wait_for(self, condition: Callable[[], object], timeout: float) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, f"timed out; the node says {self.said}"
            self.executor.spin_once(timeout_sec=0.02)

    def result_of(self, future: Any, timeout: float) -> Any:
        self.wait_for(future.done, timeout)
        return future.result()

    def send(self, on_stage: Callable[[str], None] = lambda stage: None, **goal: object) -> Any:
        self.wait_for(self.client.server_is_ready, 60.0)
        request = DiagnoseGap.Goal(**goal)
        return self.result_of(self.client.send_goal_async(request, feedback_callback=lambda m: on_stage(m.feedback.stage)), 60.0)

    def close(self) -> None:
        self.process.send_signal(signal.SIGINT)
        _, said = self.process.communicate(timeout=30.0)
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()
        assert self.process.returncode == 0 and "Traceback" not in said, said

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.name.endswith("gap_diagnosis_node"):
                self.said = {value.key: value.value for value in status.values} | {"message": status.message}


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    bag = tmp_path_factory.mktemp("bags") / "tilted"
    record_pushes(bag, RecordingSettings(n_pushes=N_PUSHES, seed=2, effects=InjectedEffects.of({"table_tilt": (TILT, 0.0)})))
    cell = Cell(bag)
    yield cell
    cell.close()


def test_pushes_on_a_tilted_table_are_diagnosed_on_request(cell: Cell) -> None:
    stages: list[str] = []
    handle = cell.send(stages.append)
    assert handle.accepted
    result = cell.result_of(handle.get_result_async(), 360.0).result
    report = result.report
    assert result.success and result.message == report.verdict
    assert report.n_pushes == N_PUSHES and report.verdict in ("named", "one_of", "several")
    tilt = next(effect for effect in report.effects if effect.name == "table_tilt")
    assert list(tilt.parameters) == ["x", "y"]
    assert max(tilt.std) < 0.25 * TILT
    assert all(abs(value - true) < 3 * std for value, true, std in zip(tilt.values, (TILT, 0.0), tilt.std, strict=True))
    assert report.noise < report.after < 0.7 * report.before
    assert sum(part.mean for part in report.account) == pytest.approx(report.before, rel=1e-9)
    assert next(part for part in report.account if part.name.startswith("table_tilt")).mean == pytest.approx(report.before - report.after)
    assert report.ranking[0] == "table_tilt" and len(report.ranking) == len(report.ranking_evidence) == len(report.ranking_smallest)
    assert json.loads(report.json)["verdict"] == report.verdict
    assert "fitting the base model" in stages
    cell.wait_for(lambda: cell.reports, 60.0)
    assert cell.reports[-1] == report
    again = cell.result_of(cell.send().get_result_async(), 360.0).result
    assert again.success and again.message == report.verdict and again.report.ranking[0] == "table_tilt"


def test_cancel_ends_a_diagnosis_at_once(cell: Cell) -> None:
    started: list[str] = []
    handle = cell.send(started.append)
    cell.wait_for(lambda: started, 120.0)
    second = cell.send()
    assert not second.accepted, "one at a time"
    with Stalls() as stalls:
        asked = time.monotonic()
        cell.result_of(handle.cancel_goal_async(), 60.0)
        assert cell.result_of(handle.get_result_async(), 60.0).status == GoalStatus.STATUS_CANCELED
        took = time.monotonic() - asked
    assert took < 3.0 + 6.0 * stalls.worst  # the diagnosis holds all processors until then


def test_what_cannot_be_diagnosed_is_refused_with_the_reason(cell: Cell) -> None:
    for goal, why in (({"object_id": "o9"}, "no pushes of object `o9`"), ({"base_effects": ["ghosts"]}, "no effect `ghosts`")):
        result = cell.result_of(cell.send(**goal).get_result_async(), 120.0).result
        assert not result.success and why in result.message
