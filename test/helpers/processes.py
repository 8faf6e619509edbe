"""Waiting for processes and for what they do."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

__all__ = ["is_alive", "wait_until"]


def wait_until(condition: Callable[[], object], timeout: Callable[[], float] = lambda: 60.0) -> None:
    """`timeout` [s] may grow while it waits, with what the machine lets threads wait."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < timeout(), "waited too long"
        time.sleep(0.02)


def is_alive(process: int) -> bool:
    """Whether a process runs, one that has ended and waits for its parent excepted."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
