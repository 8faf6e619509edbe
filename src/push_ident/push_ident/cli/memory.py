"""The memory that a command may take: what the machine can spare, so that a damaged bag ends the command and nothing else."""

from __future__ import annotations

import re
import resource
from pathlib import Path


def limit_memory() -> None:
    """Let this process take the memory that is free now, and no more; beyond it allocations raise MemoryError.

    The limit is on private data, RLIMIT_DATA: libraries map files and shared memory far beyond what they use. Without /proc there is none.
    """
    try:
        free = _kilobytes(Path("/proc/meminfo"), "MemAvailable") + _kilobytes(Path("/proc/meminfo"), "SwapFree")
        taken = _kilobytes(Path("/proc/self/status"), "VmData")
    except (OSError, LookupError):
        return
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = 1024 * (free + taken)
    resource.setrlimit(resource.RLIMIT_DATA, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def _kilobytes(file: Path, name: str) -> int:
    match = re.search(rf"^{name}:\s*(\d+) kB", file.read_text(), re.MULTILINE)
    if match is None:
        raise LookupError(name)
    return int(match[1])
