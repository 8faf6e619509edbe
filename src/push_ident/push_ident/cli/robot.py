"""The option `--robot` of `up` and `doctor`, and what the nodes of a cell get from such a file."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from push_ident.cli.supervisor import Kind, node_names
from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident.limits import plain_text

if TYPE_CHECKING:
    from push_ident.pushing.robot.robot_file import Robot

RobotOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Robot file: description, joints, tool, camera and topics of one cell.", show_default=False),
]
_NOT_ALWAYS: Final = ("bag_recorder_node", "viewer_node")
"""Nodes that run only where they are asked for."""


@dataclass(frozen=True, slots=True)
class ChosenRobot:
    """A robot file for the nodes of one kind of cell."""

    kind: Kind
    robot: Robot

    @property
    def remaps(self) -> tuple[str, ...]:
        """Of the topics of a real cell; the simulated one has the names of the bag contract."""
        return () if self.kind == "sim" else tuple(f"{name}:={real}" for name, real in self.robot.file.topics.items())

    def parameters(self, folder: Path, extra: Collection[str]) -> dict[str, dict[str, Any]]:
        """Parameters by node. `folder` gets the robot description of a real cell; `extra` are the nodes that run on demand."""
        from push_ident.pushing.robot.description import cell_description, read_urdf
        from push_ident.pushing.robot.node_parameters import node_parameters

        description = cell_description(self.robot, read_urdf(self.robot))
        file = None
        if self.kind != "sim":
            file = folder / "robot.urdf"
            write_whole(file, description, "the robot description")
        started = set(node_names(self.kind)) - set(_NOT_ALWAYS) | set(extra)
        chosen = {node: values for node, values in node_parameters(self.robot, file).items() if node in started}
        if self.kind == "sim":
            chosen["push_executor_node"]["hand"] = "none"  # that of the simulated cell is rigid, whatever the real one is
        return chosen


def robot_for(kind: Kind, file: Path) -> ChosenRobot:
    """Read a robot file for a cell. Raises InputError where it cannot be used, or the cell has no arm."""
    from push_ident.pushing.robot.robot_file import read_robot

    if kind == "replay":
        raise InputError("--robot is the arm of a cell, and a replay has none; take it out.")
    robot = read_robot(file)
    check_nodes(robot)
    return ChosenRobot(kind, robot)


def check_nodes(robot: Robot) -> None:
    """Raise InputError where the further parameters of a file name a node that there is not."""
    known = dict.fromkeys((*node_names("arm"), *node_names("sim")))
    for node in robot.file.parameters:
        if node not in known:
            raise InputError(f"{robot.path}: parameters has the node {plain_text(node)}, expected one of {', '.join(known)}.")
