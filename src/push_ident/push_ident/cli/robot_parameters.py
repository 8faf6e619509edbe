"""Whether the nodes take the values of a robot file: their names, types and ranges."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from push_ident.limits import plain_text
from push_ident.nodes.executables import NODES
from push_ident.pushing.robot.finding import Finding, Level
from push_ident.pushing.robot.node_parameters import node_parameters
from push_ident.pushing.robot.robot_file import Robot

if TYPE_CHECKING:
    from push_ident.nodes.base.parameters import Parameter

__all__ = ["check_parameters"]


def check_parameters(robot: Robot) -> list[Finding]:
    """Compare each value with the table of its node. Raises InputError where the file gives a value twice."""
    values = {node: given for node, given in node_parameters(robot, Path("robot.urdf")).items() if node in NODES}
    try:
        tables = {node: {row.name: row for row in importlib.import_module(NODES[node]).PARAMETERS} for node in values}
    except ImportError as error:
        return [Finding("parameters", Level.NOT_CHECKED, f"ROS cannot be imported ({error})", remedy="run `make setup`, or source ROS 2")]
    found = [finding for node, given in values.items() for finding in _of_node(node, given, tables[node])]
    return found or [
        Finding("parameters", Level.OK, f"{sum(map(len, values.values()))} values for {len(values)} nodes, within their ranges")
    ]


def _of_node(node: str, given: dict[str, Any], table: dict[str, Parameter]) -> Iterator[Finding]:
    for name, value in given.items():
        row = table.get(name)
        if row is None:
            near = difflib.get_close_matches(name, table, n=1)
            remedy = f"did you mean {near[0]}?" if near else "take it out"
            yield Finding("parameters", Level.WRONG, f"{node} has no parameter {plain_text(name)}", remedy=remedy)
            continue
        fault = row.fault(value) if row.has_type(value) else row.expected_type(value)
        if fault:
            what = f"{node}.{name} is {plain_text(repr(value))} ({row.description})"
            yield Finding("parameters", Level.WRONG, what, fault.removeprefix("expected "), "correct it")
