"""Settings that must be made before numpy or any ROS module is imported and before any process is started."""

from __future__ import annotations

import os
import signal

import pytest

from push_ident.nodes.base.network import own_domain

# As nodes and commands have it: with several threads the last bits of a sum depend on how they shared it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Without the check a value of a wrong type is corrupted silently.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")
# Test runs beside each other, and a cell that is in use, must not hear each other.
os.environ["ROS_DOMAIN_ID"] = str(own_domain())
# A shell starts what it runs in the background deaf to Ctrl-C, and so would be all processes of the tests that are ended by it.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, so that all workers are done at the same time."""
    items.sort(key=lambda item: "system" not in item.path.parts)
