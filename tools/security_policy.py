"""The policy for SROS 2, from the graph of a live cell. `.venv/bin/python tools/security_policy.py > security/policy.xml`."""

from __future__ import annotations

import os
import re
import tempfile
import time
import xml.etree.ElementTree as xml
from itertools import groupby
from operator import itemgetter
from pathlib import Path

from push_ident.bags.contract import Role, topic_of
from push_ident.cli.supervisor import Supervisor, node_command, node_commands
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.client.cell_client import CellClient

ROOT = Path(__file__).resolve().parent.parent
SETTLED, PATIENCE = 3.0, 60.0
"""Time without a new name after which a graph is complete, and the longest time until then [s]."""
KINDS = {
    "publisher": ("topic", "publish", "execute"),
    "subscriber": ("topic", "subscribe", "call"),
    "service": ("service", "reply", "execute"),
    "client": ("service", "request", "call"),
}
"""Kind and verb of what rclpy lists, and the verb where it is part of an action."""
EXTRA = {
    "bag_player_node": "topic publish tf",
    "perception_node": "topic subscribe tf, topic subscribe tf_static, topic publish ~/done_until",
    "identification_node": "topic subscribe bag_player_node/done",
    "push_ident_doctor": "topic subscribe joint_states",
    "push_ident_look": "topic subscribe depth/camera_info, topic subscribe depth/camera_pose, topic subscribe depth/image_rect, "
    "topic publish parameter_events, service reply ~/get_type_description",
}
"""Of a bag with poses; with tf2_ros, which the wheels lack; in a replay; of `doctor --robot` and `look --live`, which no cell starts."""
Graph = dict[str, set[tuple[str, ...]]]
"""Rights of each node, by its name: kind, verb, and a name in which `~` stands for that of the node and `*` for the id of an object."""


def live_graph() -> Graph:
    """The graph of every node of the suite: of a simulated cell and of a bag that is played. A push adds nothing to it."""
    graph: Graph = {node: {tuple(right.split()) for right in text.split(", ")} for node, text in EXTRA.items()}
    with tempfile.TemporaryDirectory() as folder:
        view = {"viewer_node": {"output": "file", "file": f"{folder}/view.rrd"}}
        cell = [*node_commands("sim", record=Path(folder) / "bag", view=True, parameters=view), node_command("sim_hand_node", {})]
        with Supervisor(cell) as supervisor, CellClient(check=supervisor.check) as client:
            client.wait_for_object()
            observe(client, {*(command.name for command in cell), "push_ident_client"}, graph)
        replay = node_commands("replay", bag=ROOT / "bags" / "hammer_depth", parameters={"bag_player_node": {"listeners": 0}})
        with Supervisor([command for command in replay if command.may_end]), CellClient() as client:
            observe(client, {"bag_player_node"}, graph)
    for node, verb in (("bag_player_node", "publish"), ("bag_recorder_node", "subscribe")):
        graph[node] |= {("topic", verb, topic_of(role, "*")) for role in Role}
    client, recorder = graph["push_ident_client"], graph["bag_recorder_node"]
    graph["push_ident_doctor"] |= {right for right in client | recorder if right[1] == "subscribe"} | (client & recorder)  # only listens
    return graph


def observe(client: CellClient, nodes: set[str], graph: Graph) -> None:
    """Add what nodes have, until all are there and none has had a new name for a while."""
    changed = time.monotonic()

    def settled() -> bool:
        nonlocal changed
        for node in nodes & set(client.node.get_node_names()):
            for of_rclpy, (kind, verb, verb_of_action) in KINDS.items():
                for name, _ in getattr(client.node, f"get_{of_rclpy}_names_and_types_by_node")(node, "/"):
                    name, _, is_of_action = name.partition("/_action/")  # the services and topics of an action are one right
                    name = re.sub(r"\b(objects?)/o\d+\b", r"\1/*", re.sub(rf"^/{node}/", "~/", name).removeprefix("/"))
                    right = ("action", verb_of_action, name) if is_of_action else (kind, verb, name)
                    if right not in graph.setdefault(node, set()):
                        graph[node].add(right)
                        changed = time.monotonic()
        return nodes <= set(client.node.get_node_names()) and time.monotonic() > changed + SETTLED

    client.wait(settled, PATIENCE, "a node did not appear, or names come and go")


def policy_of(graph: Graph) -> str:
    """The policy in the schema of sros2: one enclave for each node, and one for the command line."""
    root = xml.Element("policy", version="0.2.0")
    enclaves = xml.SubElement(root, "enclaves")
    commands = sorted(node for node in graph if node.startswith("push_ident_"))
    groups = {node: [node] for node in sorted(graph) if node not in commands} | {"command_line": commands}
    for enclave, nodes in groups.items():
        profiles = xml.SubElement(xml.SubElement(enclaves, "enclave", path=f"/push_ident/{enclave}"), "profiles")
        for node in nodes:
            profile = xml.SubElement(profiles, "profile", ns="/", node=node)
            for (kind, verb), names in groupby(sorted(sorted(graph[node]), key=itemgetter(0), reverse=True), itemgetter(0, 1)):
                listed = xml.SubElement(profile, f"{kind}s", {verb: "ALLOW"})
                for *_, name in names:
                    xml.SubElement(listed, kind).text = name
    xml.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<!-- Made by tools/security_policy.py. -->\n{xml.tostring(root, encoding="unicode")}'


if __name__ == "__main__":
    os.environ.setdefault("ROS_DOMAIN_ID", str(own_domain()))
    print(policy_of(live_graph()))
