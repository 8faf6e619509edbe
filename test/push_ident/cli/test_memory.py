"""A command that reads files of others cannot take more memory than is free."""

from __future__ import annotations

import os
import subprocess
import sys

PROGRAM = """
import resource
from push_ident.cli.memory import limit_memory
limit_memory()
limit, _ = resource.getrlimit(resource.RLIMIT_DATA)
try:
    bytearray(limit)
except MemoryError:
    print(len(bytearray(2**20)))
"""


def test_an_allocation_beyond_free_memory_is_an_error_and_the_next_one_succeeds() -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, env=environment)
    assert int(done.stdout) == 2**20
