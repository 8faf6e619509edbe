"""Which module may import which."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from helpers.paths import SOURCE, nodes

CORE = SOURCE / "push_ident" / "push_ident"
SIM = SOURCE / "push_ident_sim" / "push_ident_sim"
ORDER = [
    "types",
    "errors",
    "extras",
    "limits",
    "files",
    "checked_json",
    "threads",
    "pages",
    "geometry",
    "checking",
    "perception",
    "survey",
    "pushing",
    "physics",
    "identification",
    "calibration",
    "simulators",
    "planning",
    "diagnosis",
    "recovery",
    "bags",
    "offline",
    "fleet",
    "api",
    "nodes",
    "cli",
]
"""A stage imports what stands before it; `types`, `errors` and `limits` know each other; `files`, `checked_json` and `threads` serve
all."""
ROOMS = {
    "perception": [
        "kernels refusals settings",
        "frame",
        "known_object",
        "observation tracking",
        "outline",
        "search",
        "calibration pipeline",
        "recording",
    ],
    "identification": [
        "observing unknowns",
        "results",
        "export fitting",
        "predicting solvers",
        "identify report",
        "online",
    ],
    "nodes": [
        "base convert",
        "executables input recording",
        "__main__ client gap_diagnosis goal_pushing identification perception push_executor viewer",
    ],
}
"""Rooms of a stage: its folders and single modules, a level a line. A room imports from levels before its own, not its neighbours."""
ROS = {"rclpy", "push_ident_msgs", "std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs", "diagnostic_msgs", "builtin_interfaces"}


def imported(path: Path) -> Iterator[str]:
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def stage_of(path: Path) -> str:
    return path.relative_to(CORE).parts[0].removesuffix(".py")


CORE_FILES = sorted(p for p in CORE.rglob("*.py") if p.name != "__init__.py" or p.parent != CORE)


def test_stage_imports_only_earlier_stages() -> None:
    for path in CORE_FILES:
        own = ORDER.index(stage_of(path))
        for name in imported(path):
            parts = name.split(".")
            if parts[0] == "push_ident" and len(parts) > 1 and parts[1] in ORDER:
                other = ORDER.index(parts[1])
                assert other <= max(own, 3), f"{path.name} ({ORDER[own]}) imports {name}, which stands below it"
            assert parts[0] != "push_ident_sim", f"{path.name} imports the simulated cell"


def rooms_of(stage: str) -> set[str]:
    """Folders and modules of a stage."""
    return {p.stem for p in (CORE / stage).iterdir() if p.suffix == ".py" or any(p.glob("*.py"))} - {"__init__"}


@pytest.mark.parametrize("stage", ROOMS)
def test_rooms_of_a_stage_import_only_earlier_rooms(stage: str) -> None:
    levels = {room: level for level, rooms in enumerate(ROOMS[stage]) for room in rooms.split()}
    assert set(levels) == rooms_of(stage), f"ROOMS names the rooms of {stage}"
    for path in sorted((CORE / stage).rglob("*.py")):
        room = path.relative_to(CORE / stage).parts[0].removesuffix(".py")
        for name in imported(path):
            parts = name.split(".")
            if room in levels and parts[:2] == ["push_ident", stage] and len(parts) > 2 and parts[2] in levels and parts[2] != room:
                assert levels[parts[2]] < levels[room], f"{path.relative_to(CORE)} imports {name}, which is not in a room before its own"


def test_no_ros_outside_the_nodes_and_the_command_line_reaches_it_only_through_them() -> None:
    """The command line may fill plain messages; the middleware is the nodes' business. `doctor` asks whether it is there at all."""
    for path in CORE_FILES:
        found = {name.split(".")[0] for name in imported(path)}
        if stage_of(path) == "cli":
            assert "rclpy" not in found or path.name == "live.py", path
        elif stage_of(path) != "nodes":
            assert not ROS & found, path


def test_only_the_simulated_cell_and_a_users_own_object_import_pybullet() -> None:
    own = CORE / "simulators" / "bullet_scene.py"
    users = {p for p in SOURCE.rglob("*.py") if {"pybullet", "pybullet_data"} & {n.split(".")[0] for n in imported(p)}}
    assert users
    assert all(SIM in p.parents or p == own for p in users)
