"""The executables of this package."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

from push_ident.nodes.executables import run_executable

NODES: Final = {
    "sim_cell_node": "push_ident_sim.cell.sim_cell_node",
    "sim_hand_node": "push_ident_sim.cell.sim_hand_node",
}
"""As `push_ident.nodes.executables.NODES`."""


def main() -> None:
    """Entry point of the executables of this package."""
    run_executable(Path(sys.argv[0]).stem, NODES)
