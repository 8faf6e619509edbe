"""Every node as a real process under mutated messages: all that ever made one fail, then a fast sample of new ones.

`make fuzz` sends some 100 000.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from push_ident.errors import InputError
from push_ident.nodes.base.network import own_domain
from push_ident_sim.fuzz.cases import read_case, read_cases
from push_ident_sim.fuzz.run import FUZZED, Settings, fuzz_messages, nodes_of

CASES = Path(__file__).with_name("cases")


# Times are granted by load, but an arm that is played by a starved process makes no push at all.
@pytest.mark.skipif(os.getloadavg()[0] > 4.0 * (os.cpu_count() or 1), reason="far more processes than processors")
@pytest.mark.long
@pytest.mark.alone
def test_every_node_lives_answers_and_works_through_earlier_failures_and_a_sample_of_mutated_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = own_domain(), own_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(first))
    settings = Settings(
        minutes=20.0, seed=1, out=tmp_path / "out", cases=_copied(tmp_path / "cases"), messages=60, jobs=2, domains=(first, second)
    )
    content = fuzz_messages(settings)
    assert content["findings"] == []
    by_node = {node["node"]: node for node in content["nodes"]}
    assert set(by_node) == set(FUZZED)
    for name, node in by_node.items():
        assert node["mutated"] >= 60 and node["works"] >= 1, name
    # What must be refused is counted by the node.
    assert by_node["identification_node"]["refused"] >= 4
    subscribed = by_node["push_executor_node"]["topics"]
    assert {"/joint_states", "/objects/box/pose"} <= set(subscribed)


def _copied(folder: Path) -> Path:
    """New failures are written beside the cases: not into the sources while they are tested."""
    folder.mkdir()
    for path in CASES.glob("*.json"):
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def test_cases_are_files_of_nodes_and_messages() -> None:
    assert set(read_cases(CASES)) <= set(FUZZED)
    node, messages = read_case(CASES / "executor_impossible_joints.json")
    assert node == "push_executor_node" and {sent.to for sent in messages} == {"/joint_states"}


def test_file_that_is_no_case_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(json.dumps({"node": "viewer_node", "messages": [{"to": "/a", "type": "no_such/msg/Thing", "cdr": ""}]}))
    with pytest.raises(InputError, match=os.fspath(path)):
        read_case(path)


def test_unknown_node_is_named() -> None:
    assert nodes_of(()) == FUZZED
    with pytest.raises(InputError, match="arm_node"):
        nodes_of(("arm_node",))
