"""Every node answers every lifecycle transition in every state, and goes on."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Iterator

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import ListParameters, SetParameters
from rclpy.parameter import Parameter

from helpers.executor_cell import CONTACT, Cell, send, start_node, wait_for, wait_until_ready
from helpers.node_process import NodeProcess, Talker, node_commands
from helpers.spinning import spinning
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.executables import NODES
from push_ident.pushing.push import PushCode
from push_ident_sim.executables import NODES as SIM_NODES
from push_ident_sim.faults.lifecycle import Lifecycle

pytestmark = pytest.mark.alone

ROUNDS = int(os.environ.get("PUSH_IDENT_LIFECYCLE_ROUNDS", "1"))
"""Of all transitions in all states, for each node; 100 take half an hour."""
ALL = tuple({**NODES, **SIM_NODES})


@pytest.fixture(scope="module")
def nodes(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, NodeProcess]]:
    """All at once, since most of their time is that of loading."""
    folder = tmp_path_factory.mktemp("nodes")
    found = {name: NodeProcess(name, module, parameters, domain, folder) for name, (module, parameters) in node_commands(folder).items()}
    assert set(found) == set(ALL)
    yield found
    codes = {name: node.stop() for name, node in found.items()}
    assert codes == dict.fromkeys(found, 0)
    assert not [name for name, node in found.items() if "Traceback" in node.output]


WRONG: tuple[object, ...] = (math.nan, -math.inf, 1e308, -(2**63), True, "[/x]" * 10_000, "", [b"\xff"], [math.nan] * 3, [1], [""], None)
"""None of them is a value of more than a few parameters."""


@pytest.mark.parametrize("name", ALL)
def test_any_value_for_any_parameter_is_answered(nodes: dict[str, NodeProcess], domain: int, name: str) -> None:
    with Talker(domain) as talker, Lifecycle.of(name, domain) as lifecycle:
        lifecycle.wait(240.0)  # all nodes load at once
        known = talker.ask(talker.node.create_client(ListParameters, f"{name}/list_parameters"), ListParameters.Request())
        names = [*known.result.names, "unknown", "", "a" * 5000]
        setter = talker.node.create_client(SetParameters, f"{name}/set_parameters")
        for state in ("inactive", "active"):
            lifecycle.go_to(state)
            for value in WRONG:
                asked = [Parameter(parameter, value=value).to_parameter_msg() for parameter in names if parameter != "use_sim_time"]
                answer = talker.ask(setter, SetParameters.Request(parameters=asked))
                assert len(answer.results) == len(asked)
                assert all(result.successful or result.reason for result in answer.results)
    assert nodes[name].runs, nodes[name].output


@pytest.mark.parametrize("name", ALL)
def test_every_transition_in_every_state_is_answered_and_the_node_lives(nodes: dict[str, NodeProcess], domain: int, name: str) -> None:
    with Lifecycle.of(name, domain) as lifecycle:
        lifecycle.wait()
        assert lifecycle.state() == "active", nodes[name].output
        assert lifecycle.exercise(ROUNDS) == []
        assert lifecycle.shut_down() == []
    assert nodes[name].runs
    assert "is not possible in state" in nodes[name].output


@pytest.fixture
def cell() -> Iterator[Cell]:
    with spinning(Cell, own_domain()) as cell:
        yield cell


def test_transitions_in_the_middle_of_a_push_hold_the_arm_first(cell: Cell) -> None:
    domain = cell.context.get_domain_id()
    process = start_node(domain)
    try:
        wait_until_ready(cell)
        with Lifecycle.of("push_executor_node", domain) as lifecycle:
            lifecycle.wait()
            for transition in ("deactivate", "shutdown"):
                cell.reset()
                cell.pusher.clear()
                call = send(cell, **CONTACT)
                wait_for(lambda: cell.pusher)
                assert lifecycle.change(transition)
                result = call.end()
                assert result.error_code == PushCode.CANCELED and "stopped" in result.error_text
                time.sleep(0.5)  # for what was sent before it, and for braking
                stands, n_commands = cell.q.copy(), len(cell.commands)
                time.sleep(0.3)
                assert (cell.q == stands).all() and len(cell.commands) == n_commands
                if transition == "deactivate":
                    refused = send(cell, **CONTACT).end()
                    assert refused.error_code == PushCode.BUSY and "not active" in refused.error_text
                    assert lifecycle.change("activate")
                    wait_for(lambda: send(cell, dry_run=True, **CONTACT).end().error_code == 0)
        assert process.poll() is None
    finally:
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=10.0)
    assert process.returncode == 0 and "Traceback" not in output, output


def test_an_interrupt_during_a_transition_ends_the_node_cleanly(cell: Cell) -> None:
    domain = cell.context.get_domain_id()
    process = start_node(domain)
    try:
        wait_until_ready(cell)
        send(cell, **CONTACT)
        wait_for(lambda: cell.pusher)
        change = cell.create_client(ChangeState, "push_executor_node/change_state")
        wait_for(change.service_is_ready)
        change.call_async(ChangeState.Request(transition=Transition(label="deactivate")))
        time.sleep(0.02)
    finally:
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=10.0)
    assert process.returncode == 0 and "Traceback" not in output, output
