"""Every node answers every lifecycle transition in every state and any value of any parameter, and goes on."""

from __future__ import annotations

import importlib
import math
import os
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.srv import ListParameters, SetParameters
from rclpy.action import ActionServer
from rclpy.parameter import Parameter

from helpers.lifecycle import Lifecycle
from helpers.node_process import node_commands
from helpers.spinning import running
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.guard import is_guarded
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.executables import NODES
from push_ident_sim.executables import NODES as SIM_NODES

ROUNDS = int(os.environ.get("PUSH_IDENT_LIFECYCLE_ROUNDS", "1"))
"""Of all transitions in all states, for each node; 100 take half an hour."""
WRONG: tuple[object, ...] = (math.nan, -math.inf, 1e308, -(2**63), True, "[/x]" * 10_000, "", [b"\xff"], [math.nan] * 3, [1], [""], None)
"""None of them is a value of more than a few parameters."""


def kind_of(name: str) -> type[CellNode]:
    return getattr(importlib.import_module({**NODES, **SIM_NODES}[name]), name.title().replace("_", ""))


def raw_callbacks(node: CellNode) -> list[str]:
    """Callbacks that no guard surrounds."""
    callbacks: dict[str, Any] = {f"subscription {s.topic_name}": s.callback for s in node.subscriptions}
    callbacks |= {f"service {s.srv_name}": s.callback for s in node.services} | {str(timer): timer.callback for timer in node.timers}
    for server in node.waitables:
        if isinstance(server, ActionServer):
            names = ("_execute_callback", "_goal_callback", "_cancel_callback", "_handle_accepted_callback")
            callbacks |= {f"action {name}": getattr(server, name) for name in names}
    return [name for name, callback in callbacks.items() if not is_guarded(callback)]


@pytest.mark.live
@pytest.mark.parametrize("name", [*NODES, *SIM_NODES])
def test_any_value_for_any_parameter_and_every_transition_in_every_state_are_answered(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    domain, commands = own_domain(), node_commands(tmp_path)
    parameters = [f"{key}:={value}" for key, value in commands[name][1].items()]
    with running(kind_of(name), domain, *parameters, n_threads=3) as node, Lifecycle(name, domain) as lifecycle:
        assert lifecycle.state() == "active"
        assert len(list(node.subscriptions)) + len(list(node.services)) + len(list(node.timers)) > 10
        assert raw_callbacks(node) == []
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
