"""The robot files of the package, and the same with changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from helpers.paths import SOURCE

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
