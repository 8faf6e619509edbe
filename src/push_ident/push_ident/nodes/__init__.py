"""ROS 2 nodes around the other stages: they convert, call and publish.

Importing one chooses the network of the process and the threads of its linear algebra, no more.
"""

import os

from push_ident.nodes.base.network import choose_network

# Before any node is created, in whatever process it is.
choose_network(os.environ)
# Before numpy is loaded. The matrices of an identification are small: several threads of OpenBLAS wait for each other for longer than they
# calculate, the more so while other processes compute, and how they share a sum decides how it is rounded: a restarted node might not go on
# bit by bit.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
