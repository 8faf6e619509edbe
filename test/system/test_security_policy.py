"""The SROS 2 policy allows what the nodes do, and nothing beside it is needed: compared with the graph of a live cell."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import xml.etree.ElementTree as xml
from pathlib import Path

import pytest

from helpers.paths import ROOT
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.executables import NODES
from push_ident_sim.executables import NODES as SIM_NODES

POLICY = ROOT / "security" / "policy.xml"
VERBS = {"topics": {"publish", "subscribe"}, "services": {"reply", "request"}, "actions": {"call", "execute"}}


def rights(policy: str) -> set[tuple[str, ...]]:
    """Node, kind, verb and name of each right."""
    groups = [(profile.attrib["node"], group) for profile in xml.fromstring(policy).iter("profile") for group in profile]
    return {(node, entry.tag, verb, entry.text or "") for node, group in groups for verb in group.attrib for entry in group}


def test_policy_keeps_the_rules_of_the_schema_of_sros2_and_gives_every_node_an_enclave() -> None:
    """Rules of policy.xsd of sros2 0.13: order and names of elements, required attributes, values of rights."""
    root = xml.parse(POLICY).getroot()
    (enclaves,) = root
    assert (root.tag, root.attrib, enclaves.tag, enclaves.attrib) == ("policy", {"version": "0.2.0"}, "enclaves", {})
    nodes = {}
    for enclave in enclaves:
        (profiles,) = enclave
        assert (enclave.tag, set(enclave.attrib), profiles.tag) == ("enclave", {"path"}, "profiles")
        nodes[enclave.attrib["path"]] = [profile.attrib["node"] for profile in profiles]
        for profile in profiles:
            assert profile.tag == "profile" and set(profile.attrib) == {"ns", "node"}
            for group in profile:
                assert set(group.attrib) <= VERBS[group.tag] and set(group.attrib.values()) == {"ALLOW"} and len(group)
                for entry in group:
                    assert entry.tag + "s" == group.tag and not entry.attrib and not len(entry)
                    # A right for everything is none; `*` stands for the id of an object only.
                    assert re.fullmatch(r"(~/)?[A-Za-z_][\w/]*(/\*/\w+)?", entry.text or ""), entry.text
    expected = {f"/push_ident/{node}": [node] for node in (*NODES, *SIM_NODES)}
    assert nodes == expected | {"/push_ident/command_line": ["push_ident_client", "push_ident_doctor", "push_ident_look"]}
    assert len(enclaves) == len(nodes)


@pytest.mark.release
def test_policy_is_the_one_that_is_made_from_a_live_cell() -> None:
    environ = os.environ | {"ROS_DOMAIN_ID": str(own_domain())}
    made = subprocess.run(
        [sys.executable, ROOT / "tools" / "security_policy.py"], env=environ, check=True, timeout=300, stdout=subprocess.PIPE
    )
    assert rights(made.stdout.decode()) == rights(POLICY.read_text()), "tools/security_policy.py writes the policy again"


@pytest.mark.release
def test_enforced_security_without_keys_starts_no_node(tmp_path: Path) -> None:
    secure = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce", "ROS_SECURITY_KEYSTORE": str(tmp_path)}
    command = [sys.executable, "-m", "push_ident.nodes", "bag_recorder_node", "--ros-args", "--enclave", "/push_ident/bag_recorder_node"]
    done = subprocess.run(command, env=os.environ | secure, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "SECURITY ERROR" in done.stderr and "Traceback" not in done.stderr
