"""The SROS 2 policy allows what the nodes do, and nothing beside it is needed: compared with the graph of a live cell."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as xml
from pathlib import Path
from types import ModuleType

import pytest

from helpers.paths import ROOT
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.executables import NODES
from push_ident_sim.executables import NODES as SIM_NODES

POLICY = ROOT / "security" / "policy.xml"
VERBS = {"topics": {"publish", "subscribe"}, "services": {"reply", "request"}, "actions": {"call", "execute"}}


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("security_policy", ROOT / "tools" / "security_policy.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["security_policy"] = module
    spec.loader.exec_module(module)
    return module


def test_policy_keeps_the_rules_of_the_schema_of_sros2() -> None:
    """Rules of policy.xsd of sros2 0.13: order and names of elements, required attributes, values of rights."""
    root = xml.parse(POLICY).getroot()
    assert (root.tag, root.attrib) == ("policy", {"version": "0.2.0"})
    (enclaves,) = root
    assert enclaves.tag == "enclaves" and len(enclaves) and not enclaves.attrib
    paths = [enclave.attrib["path"] for enclave in enclaves]
    assert len(set(paths)) == len(paths) and all(re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", path) for path in paths)
    for enclave in enclaves:
        assert enclave.tag == "enclave" and set(enclave.attrib) == {"path"}
        (profiles,) = enclave
        assert profiles.tag == "profiles" and len(profiles)
        for profile in profiles:
            assert profile.tag == "profile" and set(profile.attrib) == {"ns", "node"}
            for group in profile:
                assert set(group.attrib) <= VERBS[group.tag] and set(group.attrib.values()) == {"ALLOW"} and len(group)
                for entry in group:
                    assert entry.tag + "s" == group.tag and not entry.attrib and not len(entry)
                    # A right for everything is none; `*` stands for the id of an object only.
                    assert re.fullmatch(r"(~/)?[A-Za-z_][\w/]*(/\*/\w+)?", entry.text or ""), entry.text


def test_every_node_has_an_enclave_of_its_own() -> None:
    profiles = {e.attrib["path"]: [p.attrib["node"] for p in e.iter("profile")] for e in xml.parse(POLICY).iter("enclave")}
    expected = {f"/push_ident/{node}": [node] for node in (*NODES, *SIM_NODES)}
    assert profiles == expected | {"/push_ident/command_line": ["push_ident_client", "push_ident_doctor", "push_ident_look"]}


def test_a_right_that_is_missing_is_named(tool: ModuleType) -> None:
    policy = POLICY.read_text(encoding="utf-8")
    graph = tool.rights_in(policy)
    assert tool.lacking(graph, policy) == []
    less = policy.replace("<topic>joint_trajectory</topic>", "<topic>other</topic>")
    assert "push_executor_node: may not publish the topic joint_trajectory" in tool.lacking(graph, less)
    graph["viewer_node"] |= tool.rights_of("viewer_node", "topic", "subscribe", ["/objects/o7/new"])
    assert tool.lacking(graph, policy) == ["viewer_node: may not subscribe the topic objects/*/new"]


@pytest.mark.alone
def test_the_policy_allows_what_the_nodes_of_a_live_cell_do(tool: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(own_domain()))
    graph = tool.live_graph(push=False)  # a push adds nothing to the graph
    assert set(graph) >= {*NODES, *SIM_NODES}
    problems = tool.lacking(graph, POLICY.read_text(encoding="utf-8"))
    assert problems == [], "write the policy again: .venv/bin/python tools/security_policy.py"


@pytest.mark.alone
def test_enforced_security_without_keys_starts_no_node(tmp_path: Path) -> None:
    secure = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce", "ROS_SECURITY_KEYSTORE": str(tmp_path)}
    command = [sys.executable, "-m", "push_ident.nodes", "bag_recorder_node", "--ros-args", "--enclave", "/push_ident/bag_recorder_node"]
    done = subprocess.run(command, env=os.environ | secure, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "SECURITY ERROR" in done.stderr and "Traceback" not in done.stderr
