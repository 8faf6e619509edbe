"""Settings that must be made before any ROS module is imported and before any process is started."""

from __future__ import annotations

import os
import signal

# Without the check a value of a wrong type is corrupted silently.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")
# Test runs beside each other must not hear each other. 101 is the highest domain whose ports are free on every Linux.
os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
# A shell starts what it runs in the background deaf to Ctrl-C, and so would be all processes of the tests that are ended by it.
signal.signal(signal.SIGINT, signal.default_int_handler)
