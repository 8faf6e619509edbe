"""Which module may import which."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from helpers.paths import SOURCE, nodes, tree

CORE = SOURCE / "push_ident" / "push_ident"
SIM = SOURCE / "push_ident_sim" / "push_ident_sim"
ORDER = [
    "types",
    "errors",
    "extras",
    "limits",
    "files",
    "checked_json",
    "pages",
    "geometry",
    "perception",
    "survey",
    "pushing",
    "physics",
    "identification",
    "planning",
    "diagnosis",
    "bags",
    "offline",
    "fleet",
    "api",
    "nodes",
    "cli",
]
"""A stage imports what stands before it; `types`, `errors` and `limits` know each other; `files` and `checked_json` serve all."""
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


@pytest.mark.parametrize("path", CORE_FILES, ids=lambda p: str(p.relative_to(CORE)))
def test_stage_imports_only_earlier_stages(path: Path) -> None:
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


@pytest.mark.parametrize("path", [p for p in CORE_FILES if stage_of(p) not in ("nodes", "cli")], ids=lambda p: str(p.relative_to(CORE)))
def test_no_ros_outside_the_nodes(path: Path) -> None:
    assert not ROS & {name.split(".")[0] for name in imported(path)}


@pytest.mark.parametrize("path", [p for p in CORE_FILES if stage_of(p) == "cli"], ids=lambda p: str(p.relative_to(CORE)))
def test_command_line_reaches_ros_only_through_the_nodes(path: Path) -> None:
    """Plain messages may be filled there; the middleware is the nodes' business. `doctor` asks whether it is there at all."""
    if path.name != "live.py":
        assert "rclpy" not in {name.split(".")[0] for name in imported(path)}


def test_only_the_simulated_cell_imports_pybullet() -> None:
    users = {p for p in SOURCE.rglob("*.py") if {"pybullet", "pybullet_data"} & {n.split(".")[0] for n in imported(p)}}
    assert users
    assert all(SIM in p.parents for p in users)


def test_every_public_name_exists() -> None:
    for path in CORE_FILES:
        module = tree(path)
        exported: list[str] = []
        defined: set[str] = set()
        for node in module.body:
            if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets):
                exported = [c.value for c in getattr(node.value, "elts", []) if isinstance(c, ast.Constant)]
            for target in getattr(node, "targets", [getattr(node, "target", None)]):
                defined |= {name.id for name in ast.walk(target or ast.Pass()) if isinstance(name, ast.Name)}
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                defined.add(node.name)
            if isinstance(node, ast.ImportFrom | ast.Import):
                defined |= {alias.asname or alias.name for alias in node.names}
        assert set(exported) <= defined, path
