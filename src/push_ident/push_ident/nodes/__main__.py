"""`python -m push_ident.nodes perception_node --ros-args ...`: as the executable of that name."""

import sys

from push_ident.nodes.executables import NODES, run_executable

if __name__ == "__main__":
    run_executable(sys.argv.pop(1) if len(sys.argv) > 1 else "", NODES)
