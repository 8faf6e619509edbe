"""Every node answers every lifecycle transition in every state, and goes on."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator

import pytest
from rcl_interfaces.srv import ListParameters, SetParameters
from rclpy.parameter import Parameter

from helpers.domains import own_domain
from helpers.node_process import NodeProcess, Talker, node_commands
from push_ident.nodes.executables import NODES
from push_ident_sim.executables import NODES as SIM_NODES
from push_ident_sim.faults.lifecycle import Lifecycle

pytestmark = pytest.mark.alone

ROUNDS = int(os.environ.get("PUSH_IDENT_LIFECYCLE_ROUNDS", "1"))
"""Of all transitions in all states, for each node; 100 take half an hour."""
ALL = tuple({**NODES, **SIM_NODES})


@pytest.fixture(scope="module")
def domain() -> int:
    return own_domain()


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
