"""ROS 2 nodes around the other stages: they convert, call and publish. Importing one chooses the network of the process, no more."""

import os

from push_ident.nodes.network import choose_network

# Before any node is created, in whatever process it is.
choose_network(os.environ)
