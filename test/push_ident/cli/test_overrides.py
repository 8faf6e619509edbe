"""Parameter files and remapped topics that `push-ident up` passes on to its nodes; mistakes in them are errors before any node starts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from helpers.commands import check_refused
from push_ident.cli.overrides import Overrides, overrides_of
from push_ident.cli.supervisor import node_commands, node_names


def test_parameters_reach_a_node_with_their_types_and_those_of_the_user_count_more_than_the_installed_ones(tmp_path: Path) -> None:
    file, bag = tmp_path / "own.yaml", tmp_path / "2024"
    file.write_text("/**/bag_player_node:\n  ros__parameters:\n    rate: 0.5\n/**:\n  ros__parameters:\n    own: 7\n")
    remaps = ("joint_states:=/arm/joint_states", "other_node:tool:=/x")
    assert overrides_of([file], (), node_names("replay")) == Overrides((file,))
    values = {"rate": 2.0, "loop": False, "wait": 1e-05, "names": ["a", "1"]}
    player = node_commands("replay", bag=bag, parameters={"bag_player_node": values}, overrides=Overrides((file,), remaps))[-1]
    program = """
import sys, json, rclpy
rclpy.init(args=sys.argv)
node = rclpy.create_node("bag_player_node", automatically_declare_parameters_from_overrides=True)
names = [node.resolve_topic_name(name) for name in ("joint_states", "tool")]
print(json.dumps([{name: node.get_parameter(name).value for name in ("bag", "rate", "loop", "wait", "names", "own")}, *names]))
"""
    call = [sys.executable, "-c", program, *player.argv[3:]]
    done = subprocess.run(call, capture_output=True, text=True, timeout=60, check=True, env={**os.environ, "HOME": str(tmp_path)})
    assert json.loads(done.stdout) == [{"bag": str(bag), **values, "rate": 0.5, "own": 7}, "/arm/joint_states", "/tool"]


def test_files_and_remappings_that_are_none_are_told_at_once(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    for content, reason in (
        (None, "cannot be read"),
        ("a: [", "cannot be read"),
        ("", "holds no nodes"),
        ("- 1\n", "holds no nodes"),
        ("push_executor:\n  ros__parameters: {}\n", "names the node push_executor"),
        ("perception_node:\n  parameters: {}\n", "no `ros__parameters:`"),
    ):
        if content is not None:
            file.write_text(content)
        check_refused(reason, "up", "arm", "--params", file)
    for text, reason in (("a=b", "FROM:=TO"), (":=b", "FROM:=TO"), ("a:=b c", "FROM:=TO"), ("nobody:a:=b", "names the node nobody")):
        check_refused(reason, "up", "arm", "--remap", text)
