"""Parameter files and remapped topics that `push-ident up` passes on to its nodes; mistakes in them are errors before any node starts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import run_here
from push_ident.cli.overrides import Overrides, overrides_of
from push_ident.cli.supervisor import node_commands, node_names

OWN = "/**/push_executor_node:\n  ros__parameters:\n    push_speed: 0.031\n/**:\n  ros__parameters:\n    own: 7\n"


def test_own_file_and_names_reach_a_node_and_count_more_than_the_installed_ones(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(OWN)
    assert overrides_of([file], (), node_names("arm")).files == (file,)
    overrides = Overrides((file,), ("joint_states:=/arm/joint_states", "other_node:tool:=/x"))
    executor = next(node for node in node_commands("arm", overrides=overrides) if node.name == "push_executor_node")
    program = """
import sys, json, rclpy
rclpy.init(args=sys.argv)
node = rclpy.create_node("push_executor_node", automatically_declare_parameters_from_overrides=True)
names = [node.resolve_topic_name(name) for name in ("joint_states", "tool")]
print(json.dumps([node.get_parameter("push_speed").value, node.get_parameter("own").value, *names]))
"""
    call = [sys.executable, "-c", program, *executor.argv[3:]]
    done = subprocess.run(call, capture_output=True, text=True, timeout=60, check=True, env={**os.environ, "HOME": str(tmp_path)})
    assert json.loads(done.stdout) == [0.031, 7, "/arm/joint_states", "/tool"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "cannot be read"),
        ("a: [", "cannot be read"),
        ("", "holds no nodes"),
        ("- 1\n", "holds no nodes"),
        ("push_executor:\n  ros__parameters: {}\n", "names the node push_executor"),
        ("perception_node:\n  parameters: {}\n", "no `ros__parameters:`"),
    ],
)
def test_a_file_that_is_no_parameter_file_is_told_at_once(tmp_path: Path, content: str | None, reason: str) -> None:
    file = tmp_path / "own.yaml"
    if content is not None:
        file.write_text(content)
    done = run_here("up", "arm", "--params", file)
    assert done.returncode == 1 and reason in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "reason"), [("a=b", "FROM:=TO"), (":=b", "FROM:=TO"), ("a:=b c", "FROM:=TO"), ("nobody:a:=b", "names the node nobody")]
)
def test_a_remapping_that_is_none_is_told_at_once(text: str, reason: str) -> None:
    done = run_here("up", "arm", "--remap", text)
    assert done.returncode == 1 and reason in done.stderr and done.stderr.count("\n") == 1
