"""The robot files of the package, and the same with changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from helpers.paths import SOURCE
from push_ident.pushing.robot.description import read_urdf
from push_ident.pushing.robot.robot_file import read_robot

ROBOTS = SOURCE / "push_ident" / "config" / "robots"
NAMES = ("iiwa", "ur5e", "franka")


def robot_path(name: str) -> Path:
    return ROBOTS / f"{name}.yaml"


def changed(folder: Path, change: Callable[[dict[str, Any]], object], name: str = "ur5e") -> Path:
    """A copy of an example that `change` has changed."""
    content = yaml.safe_load(robot_path(name).read_text())
    change(content)
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def with_urdf(folder: Path, edit: Callable[[str], str], change: Callable[[dict[str, Any]], object] = lambda content: None) -> Path:
    """The UR5e by an edited copy of its URDF, whose meshes are not beside it."""
    (folder / "arm.urdf").write_text(edit(read_urdf(read_robot(robot_path("ur5e"))).path.read_text()))
    return changed(folder, lambda content: (content.update(description={"file": "arm.urdf", "root": "base_link"}), change(content)))


def endless(urdf: str) -> str:
    """The UR5e whose last joint turns without end."""
    return urdf.replace('name="wrist_3_joint" type="revolute"', 'name="wrist_3_joint" type="continuous"')
