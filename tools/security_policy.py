"""The SROS 2 policy of the nodes, from the graph of a live cell. `.venv/bin/python tools/security_policy.py [--check]`.

It starts every node, pushes once, replays a bag, and writes down which topics, services and actions each node has
(`security/policy.xml`). With `--check` it compares instead: exit code 1 where a node has something that the policy does not allow.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
import time
import xml.etree.ElementTree as xml
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
POLICY = ROOT / "security" / "policy.xml"
ENCLAVES = "/push_ident/"
COMMANDS = ("push_ident_client", "push_ident_doctor", "push_ident_look")
"""Nodes of the command line; they share the enclave `command_line`."""
START_WITHIN, PUSH_WITHIN, SETTLED = 60.0, 30.0, 3.0
"""Longest time for all nodes to be there, for a push, and time without a new name after which a graph is complete [s]."""
VERBS = {
    ("topic", "publish"): "topics",
    ("topic", "subscribe"): "topics",
    ("service", "reply"): "services",
    ("service", "request"): "services",
    ("action", "execute"): "actions",
    ("action", "call"): "actions",
}
HEAD = """
  Which topics, services and actions each node may use: SROS 2 of ROS 2 Jazzy (docs/how-to/secure-a-cell.md).
  Made from the graph of a live cell by tools/security_policy.py; a test compares the two. Names hold for the namespace /.
  `*` stands for the id of an object.
"""


class Right(NamedTuple):
    """One thing that a node does."""

    kind: str
    """topic, service or action."""
    verb: str
    """publish, subscribe, reply, request, execute or call."""
    name: str
    """Without the leading slash; `~/` stands for the name of the node, `*` for the id of an object."""


EXTRA = {
    "perception_node": {
        Right("topic", "subscribe", "tf"),
        Right("topic", "subscribe", "tf_static"),
        Right("topic", "publish", "~/done_until"),
    },
    "identification_node": {Right("topic", "subscribe", "bag_player_node/done")},
    "push_ident_client": {Right("topic", "subscribe", f"depth/{name}") for name in ("image_rect", "camera_info", "camera_pose")},
    "push_ident_look": {Right("topic", "subscribe", f"depth/{name}") for name in ("image_rect", "camera_info", "camera_pose")}
    | {Right("topic", "publish", "parameter_events"), Right("service", "reply", "~/get_type_description")},
}
"""What nodes have on machines with tf2_ros only, which the wheels lack; what they have in a replay only; what the demo
has, which draws on the picture of the camera; and what `push-ident look --live` has, which no cell starts."""
Graph = dict[str, set[Right]]
"""Rights of each node, by its name."""


def rights_of(node: str, kind: str, verb: str, names: Iterable[str]) -> set[Right]:
    """Names of the graph as rights; the five services and topics of an action are one."""
    found = set()
    for name in names:
        action, _, hidden = name.partition("/_action/")
        if hidden:
            serves = verb in ("reply", "publish")
            found.add(Right("action", "execute" if serves else "call", _general(node, action)))
        else:
            found.add(Right(kind, verb, _general(node, name)))
    return found


def _general(node: str, name: str) -> str:
    own = f"/{node}/"
    text = "~/" + name.removeprefix(own) if name.startswith(own) else name.removeprefix("/")
    return re.sub(r"^objects/[^/]+/", "objects/*/", re.sub(r"(ground_truth/objects?)/o\d+\b", r"\1/*", text))


def observe(observer: Any, nodes: Iterable[str], graph: Graph) -> None:
    """Add what the nodes have now."""
    from rclpy.node import NodeNameNonExistentError

    ask = (
        ("topic", "publish", observer.get_publisher_names_and_types_by_node),
        ("topic", "subscribe", observer.get_subscriber_names_and_types_by_node),
        ("service", "reply", observer.get_service_names_and_types_by_node),
        ("service", "request", observer.get_client_names_and_types_by_node),
    )
    for node in nodes:
        for kind, verb, names_of in ask:
            try:
                names = [name for name, _ in names_of(node, "/")]
            except NodeNameNonExistentError:
                continue
            graph.setdefault(node, set()).update(rights_of(node, kind, verb, names))


def live_graph(log: Callable[[str], None] = lambda text: None, *, push: bool = True) -> Graph:
    """The graph of every node of the suite: from a simulated cell, which pushes once if `push`, and from a bag that is played."""
    import rclpy
    from rclpy.context import Context
    from rclpy.node import Node

    from push_ident.bags.contract import Role, topic_of
    from push_ident.cli.supervisor import Supervisor, node_command, node_commands
    from push_ident.nodes.client.cell_client import CellClient

    graph: Graph = {}
    context = Context()
    rclpy.init(context=context)
    observer = Node("security_policy", context=context)
    try:
        with tempfile.TemporaryDirectory() as folder:
            view = {"output": "file", "file": f"{folder}/view.rrd"}
            commands = node_commands("sim", record=Path(folder) / "bag", view=True, parameters={"viewer_node": view})
            commands.append(node_command("sim_hand_node", {}))
            nodes = [command.name for command in commands]
            with Supervisor(commands) as supervisor, CellClient(check=supervisor.check) as client:
                log("waiting for an object")
                object_id = client.wait_for_object(START_WITHIN)
                if push:
                    log("pushing")
                    log(_push(client, object_id))
                _until_settled(observer, [*nodes, COMMANDS[0]], graph)
            log("playing a bag")
            bag = ROOT / "bags" / "hammer_depth"
            commands = [c for c in node_commands("replay", bag=bag, parameters={"bag_player_node": {"listeners": 0}}) if c.may_end]
            with Supervisor(commands):
                _until_settled(observer, ["bag_player_node"], graph)
    finally:
        observer.destroy_node()
        context.try_shutdown()
    contract = [topic_of(role, "*") for role in Role]
    graph["bag_player_node"] |= {Right("topic", "publish", topic) for topic in contract}
    graph["bag_recorder_node"] |= {Right("topic", "subscribe", topic) for topic in contract}
    for node, rights in EXTRA.items():
        graph.setdefault(node, set()).update(rights)
    return graph


def _push(client: Any, object_id: str) -> str:
    """Try random pushes until one is made; what became of it."""
    from push_ident_msgs.action import ExecutePush

    deadline, seed = time.monotonic() + PUSH_WITHIN, 0
    while True:
        result = client.execute_push(ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, seed=seed))
        if result.error_code == 0 or time.monotonic() > deadline:
            return f"error code {result.error_code} {result.error_text}"
        time.sleep(0.5)
        seed += 1


def _until_settled(observer: Any, nodes: list[str], graph: Graph) -> None:
    changed = time.monotonic()
    deadline = changed + START_WITHIN
    while time.monotonic() < min(deadline, changed + SETTLED) or not all(graph.get(node) for node in nodes):
        if time.monotonic() > deadline:
            raise SystemExit(f"these nodes did not appear: {[node for node in nodes if not graph.get(node)]}")
        before = {node: len(rights) for node, rights in graph.items()}
        observe(observer, nodes, graph)
        if {node: len(rights) for node, rights in graph.items()} != before:
            changed = time.monotonic()
        time.sleep(0.1)


def policy_of(graph: Mapping[str, set[Right]]) -> str:
    """The policy as XML, in the schema of sros2: one enclave for each node, and one for the command line."""
    root = xml.Element("policy", version="0.2.0")
    root.append(xml.Comment(HEAD))
    enclaves = xml.SubElement(root, "enclaves")
    groups = {node: [node] for node in sorted(graph) if node not in COMMANDS} | {"command_line": list(COMMANDS)}
    for enclave, nodes in groups.items():
        profiles = xml.SubElement(xml.SubElement(enclaves, "enclave", path=ENCLAVES + enclave), "profiles")
        for node in nodes:
            # What `push-ident doctor` listens to follows from the contract: it reads what the recorder does.
            rights = graph.get(node) or graph[COMMANDS[0]] | {r for r in graph["bag_recorder_node"] if r.verb == "subscribe"}
            profile = xml.SubElement(profiles, "profile", ns="/", node=node)
            for (kind, verb), group in VERBS.items():
                names = sorted(right.name.replace("~/", "~/", 1) for right in rights if right[:2] == (kind, verb))
                if names:
                    listed = xml.SubElement(profile, group, {verb: "ALLOW"})
                    for name in names:
                        xml.SubElement(listed, kind).text = name
    xml.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + xml.tostring(root, encoding="unicode") + "\n"


def rights_in(policy: str) -> Graph:
    """Rights of each node in a policy."""
    graph: Graph = {}
    for profile in xml.fromstring(policy).iter("profile"):
        rights = graph.setdefault(profile.attrib["node"], set())
        for group in profile:
            for verb in group.attrib:
                rights |= {Right(entry.tag, verb, entry.text or "") for entry in group}
    return graph


def lacking(graph: Mapping[str, set[Right]], policy: str) -> list[str]:
    """What nodes of a graph have and a policy does not allow, a line each."""
    allowed = rights_in(policy)
    return [
        f"{node}: may not {right.verb} the {right.kind} {right.name}"
        for node, rights in sorted(graph.items())
        for right in sorted(rights - allowed.get(node, set()))
    ]


def main() -> int:
    """Write the policy, or check it; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare with security/policy.xml instead of writing it")
    options = parser.parse_args()
    from push_ident.nodes.base.network import own_domain

    os.environ.setdefault("ROS_DOMAIN_ID", str(own_domain()))
    graph = live_graph(lambda text: print(text, file=sys.stderr))
    if options.check:
        problems = lacking(graph, POLICY.read_text(encoding="utf-8"))
        print("\n".join(problems) or "the policy allows what the nodes do")
        return int(bool(problems))
    POLICY.parent.mkdir(exist_ok=True)
    POLICY.write_text(policy_of(graph), encoding="utf-8")
    print(f"written: {POLICY}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
