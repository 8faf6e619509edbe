"""How the process of a node begins: the table of executables, and the loading of the node that one of them runs."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Final

__all__ = ["NODES", "main", "run_executable"]

NODES: Final = {
    "perception_node": "push_ident.nodes.perception.perception_node",
    "push_executor_node": "push_ident.nodes.push_executor.push_executor_node",
    "identification_node": "push_ident.nodes.identification.identification_node",
    "gap_diagnosis_node": "push_ident.nodes.gap_diagnosis.gap_diagnosis_node",
    "bag_player_node": "push_ident.nodes.bag_player_node",
    "bag_recorder_node": "push_ident.nodes.bag_recorder_node",
    "viewer_node": "push_ident.nodes.viewer.viewer_node",
}
"""Executable and the module whose `main` it runs. `setup.py` names the same executables."""


def main() -> None:
    """Entry point of the executables of this package."""
    run_executable(Path(sys.argv[0]).stem, NODES)


def run_executable(name: str, nodes: Mapping[str, str]) -> None:
    """Load the node that `name` stands for in `nodes` and run it until a signal ends the process.

    Loading takes seconds. SIGINT ends the process with exit code 0 in that time as well, unless the process was started to ignore it.
    """
    if name not in nodes:
        sys.exit(f"there is no executable {name!r}, expected one of {', '.join(nodes)}")
    in_main = threading.current_thread() is threading.main_thread()
    if in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    sys.exit(importlib.import_module(nodes[name]).main())


def _end(number: int, frame: FrameType | None) -> None:
    # Not by an exception: one raised within an import is printed, or caught by the module that is loaded.
    os._exit(0)
