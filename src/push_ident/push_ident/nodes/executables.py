"""How the process of a node begins: the table of executables, and the loading of the node that one of them runs."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NoReturn

from push_ident.extras import how_to_get
from push_ident.nodes.base.lifetime import LIFETIME

NODES: Final = {
    "perception_node": "push_ident.nodes.perception.perception_node",
    "push_executor_node": "push_ident.nodes.push_executor.push_executor_node",
    "identification_node": "push_ident.nodes.identification.identification_node",
    "gap_diagnosis_node": "push_ident.nodes.gap_diagnosis.gap_diagnosis_node",
    "bag_player_node": "push_ident.nodes.recording.bag_player_node",
    "bag_recorder_node": "push_ident.nodes.recording.bag_recorder_node",
    "goal_pushing_node": "push_ident.nodes.goal_pushing.goal_pushing_node",
    "viewer_node": "push_ident.nodes.viewer.viewer_node",
}
"""Executable and the module with its node, `perception_node` with `PerceptionNode`. `setup.py` names the same executables."""


def main() -> None:
    """Entry point of the executables of this package."""
    run_executable(Path(sys.argv[0]).stem, NODES)


def run_executable(name: str, nodes: Mapping[str, str]) -> NoReturn:
    """Load the node that `name` stands for in `nodes` and run it until a signal, or the end of its starter, ends the process.

    Loading takes seconds; a signal ends the process with exit code 0 in that time as well.
    """
    # What a node writes is for its user alone: bags, checkpoints, logs of ROS, and the shared memory that carries the depth images.
    os.umask(0o077)
    LIFETIME.begin()
    if name not in nodes:
        sys.exit(f"there is no executable {name!r}, expected one of {', '.join(nodes)}")
    try:
        from push_ident.nodes.base.run import run_node

        kind = getattr(importlib.import_module(nodes[name]), name.title().replace("_", ""))
    except ModuleNotFoundError as error:
        sys.exit(how_to_get(error.name or "") or f"{name} cannot be loaded: {error}")
    sys.setswitchinterval(kind.switch_interval)
    LIFETIME.leave(run_node(kind, n_threads=kind.n_threads, yields=kind.yields, in_turn=kind.in_turn))
