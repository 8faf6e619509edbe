"""`python -m push_ident_sim sim_cell_node --ros-args ...`: as the executable of that name."""

import sys

from push_ident.nodes.executables import run_executable
from push_ident_sim.executables import NODES

if __name__ == "__main__":
    run_executable(sys.argv.pop(1) if len(sys.argv) > 1 else "", NODES)
