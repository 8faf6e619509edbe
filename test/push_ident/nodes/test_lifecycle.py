"""Every node answers every lifecycle transition in every state and any value of any parameter, and goes on."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import rclpy
from rcl_interfaces.srv import ListParameters, SetParameters
from rclpy.context import Context
from rclpy.parameter import Parameter

from helpers.lifecycle import Lifecycle
from helpers.node_process import node_commands
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.executors import make_executor
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.gap_diagnosis.gap_diagnosis_node import GapDiagnosisNode
from push_ident.nodes.goal_pushing.goal_pushing_node import GoalPushingNode
from push_ident.nodes.identification.identification_node import IdentificationNode
from push_ident.nodes.perception.perception_node import PerceptionNode
from push_ident.nodes.push_executor.push_executor_node import PushExecutorNode
from push_ident.nodes.recording.bag_player_node import BagPlayerNode
from push_ident.nodes.recording.bag_recorder_node import BagRecorderNode
from push_ident.nodes.viewer.viewer_node import ViewerNode
from push_ident_sim.cell.sim_cell_node import SimCellNode
from push_ident_sim.cell.sim_hand_node import SimHandNode

ROUNDS = int(os.environ.get("PUSH_IDENT_LIFECYCLE_ROUNDS", "1"))
"""Of all transitions in all states, for each node; 100 take half an hour."""
KINDS: dict[str, type[CellNode]] = {
    "perception_node": PerceptionNode,
    "push_executor_node": PushExecutorNode,
    "identification_node": IdentificationNode,
    "gap_diagnosis_node": GapDiagnosisNode,
    "goal_pushing_node": GoalPushingNode,
    "bag_player_node": BagPlayerNode,
    "bag_recorder_node": BagRecorderNode,
    "viewer_node": ViewerNode,
    "sim_cell_node": SimCellNode,
    "sim_hand_node": SimHandNode,
}
WRONG: tuple[object, ...] = (math.nan, -math.inf, 1e308, -(2**63), True, "[/x]" * 10_000, "", [b"\xff"], [math.nan] * 3, [1], [""], None)
"""None of them is a value of more than a few parameters."""


@contextmanager
def running(name: str, domain: int, folder: Path) -> Iterator[CellNode]:
    """A node whose callbacks run in threads, as in its process."""
    commands = node_commands(folder)
    assert set(commands) == set(KINDS)
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    parameters = [part for key, value in commands[name][1].items() for part in ("-p", f"{key}:={value}")]
    node = KINDS[name](context=context, cli_args=["--ros-args", *parameters])
    executor = make_executor(3, context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield node
        assert thread.is_alive()
    finally:
        node.close()
        executor.shutdown(timeout_sec=5.0)
        thread.join(5.0)
        node.destroy_node()
        context.try_shutdown()


@pytest.mark.live
@pytest.mark.parametrize("name", KINDS)
def test_any_value_for_any_parameter_and_every_transition_in_every_state_are_answered(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    domain = own_domain()
    with running(name, domain, tmp_path) as node, Lifecycle(name, domain) as lifecycle:
        assert lifecycle.state() == "active"
        assert len(list(node.subscriptions)) + len(list(node.services)) + len(list(node.timers)) > 10
        assert node.raw_callbacks() == []
        known = lifecycle.ask(lifecycle.node.create_client(ListParameters, f"{name}/list_parameters"), ListParameters.Request())
        names = [*known.result.names, "unknown", "", "a" * 5000]
        setter = lifecycle.node.create_client(SetParameters, f"{name}/set_parameters")
        for state in ("inactive", "active"):
            lifecycle.go_to(state)
            for value in WRONG:
                asked = [Parameter(parameter, value=value).to_parameter_msg() for parameter in names if parameter != "use_sim_time"]
                answer = lifecycle.ask(setter, SetParameters.Request(parameters=asked))
                assert len(answer.results) == len(asked)
                assert all(result.successful or result.reason for result in answer.results)
        assert lifecycle.exercise(ROUNDS) == []
        assert lifecycle.shut_down() == []
    said = capfd.readouterr()
    assert "is not possible in state" in said.err and "Traceback" not in said.out + said.err
