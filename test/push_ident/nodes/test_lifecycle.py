"""Every node answers every lifecycle transition in every state, and goes on."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from helpers.domains import own_domain
from helpers.node_process import NodeProcess, node_commands
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


@pytest.mark.parametrize("name", ALL)
def test_every_transition_in_every_state_is_answered_and_the_node_lives(nodes: dict[str, NodeProcess], domain: int, name: str) -> None:
    with Lifecycle.of(name, domain) as lifecycle:
        lifecycle.wait(240.0)  # all nodes load at once
        assert lifecycle.state() == "active", nodes[name].output
        assert lifecycle.exercise(ROUNDS) == []
        assert lifecycle.shut_down() == []
    assert nodes[name].runs
    assert "is not possible in state" in nodes[name].output
