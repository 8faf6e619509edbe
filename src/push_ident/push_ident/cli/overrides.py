"""Parameters and names of a cell of one's own: files and remappings that `push-ident up` gives to its nodes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from push_ident.errors import InputError
from push_ident.files import read_regular
from push_ident.limits import plain_text

_NAME: Final = r"~?/?[A-Za-z_][\w]*(?:/[A-Za-z_][\w]*)*"
_REMAP: Final = re.compile(rf"(?:(?P<node>[A-Za-z_]\w*):)?{_NAME}:=/?{_NAME}")
"""`from:=to`, or `node:from:=to` for one node only, as ROS 2 has it."""
_EVERY_NODE: Final = "/**"


@dataclass(frozen=True, slots=True)
class Overrides:
    """What a user gives to all nodes, after what this project gives them."""

    files: tuple[Path, ...] = ()
    """Parameter files of ROS 2; of two that give one parameter the later counts."""
    remaps: tuple[str, ...] = ()
    """Remappings, each `from:=to` or `node:from:=to`."""

    def arguments(self) -> list[str]:
        """For the command line of a node."""
        files = [part for file in self.files for part in ("--params-file", str(file.resolve()))]
        return [*files, *(part for remap in self.remaps for part in ("-r", remap))]


def overrides_of(files: Sequence[Path], remaps: Sequence[str], nodes: Sequence[str]) -> Overrides:
    """Files and remappings of the command line, checked; they may name these `nodes`.

    Raises InputError for a file that is no parameter file, one of a node that does not exist, or text that is no remapping.
    """
    for file in files:
        _check_file(file, nodes)
    for remap in remaps:
        found = _REMAP.fullmatch(remap)
        if found is None:
            raise InputError(f"--remap is {plain_text(remap)!r}, expected FROM:=TO or NODE:FROM:=TO, as joint_states:=/arm/joint_states.")
        if found["node"] and found["node"] not in nodes:
            raise InputError(f"--remap {plain_text(remap)} names the node {found['node']}, expected one of {', '.join(nodes)}.")
    return Overrides(tuple(files), tuple(remaps))


def parameters_of(file: Path, node: str) -> dict[str, Any]:
    """Parameters that a parameter file gives to a node, by name. Raises InputError for a file that is no parameter file."""
    found: dict[str, Any] = {}
    for name, parameters in _read(file).items():
        if _node_of(name) in ("", node):
            found |= parameters
    return found


def _check_file(file: Path, nodes: Sequence[str]) -> None:
    for name in _read(file):
        if _node_of(name) not in ("", *nodes):
            raise InputError(f"--params {file}: names the node {plain_text(name)}, expected /** or one of {', '.join(nodes)}.")


def _node_of(name: str) -> str:
    """The node that a section is for; empty: every node."""
    return name.removeprefix(_EVERY_NODE).strip("/")


def _read(file: Path) -> dict[str, dict[str, Any]]:
    """Parameters by the names of the sections."""
    try:
        content: Any = yaml.safe_load(read_regular(file))
    except (OSError, yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        reason = plain_text(" ".join(str(error).split()))[:150]
        raise InputError(f"--params {file}: cannot be read ({reason}); expected a parameter file of ROS 2 (YAML).") from None
    if not isinstance(content, dict) or not content:
        raise InputError(f"--params {file}: holds no nodes, expected `NODE:` with `ros__parameters:` below it.")
    for name, below in content.items():
        if not isinstance(below, dict) or not isinstance(below.get("ros__parameters"), dict):
            raise InputError(f"--params {file}: {plain_text(str(name))} has no `ros__parameters:` with parameters below it.")
    return {str(name): below["ros__parameters"] for name, below in content.items()}
