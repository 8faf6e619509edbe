"""The live cells go before other work of the machine, as on the computer of a robot, where this process has the right to decide so."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

__all__ = ["as_urgent_as_this_one", "set_priority", "urgent"]

_PRIORITY: Final = -15
"""Niceness of the cells and of what observes them."""


@contextmanager
def urgent() -> Iterator[None]:
    """This process, and all that it starts meanwhile; without the right to, they go with the others."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    set_priority(os.getpid(), _PRIORITY)
    try:
        yield
    finally:
        set_priority(os.getpid(), before)


def as_urgent_as_this_one(pid: int) -> None:
    """A process that was started in a session of its own is as urgent as the one that started it."""
    set_priority(pid, os.getpriority(os.PRIO_PROCESS, 0))


def set_priority(pid: int, niceness: int) -> None:
    """Of all threads of a process, as far as this one has the right to."""
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            os.setpriority(os.PRIO_PROCESS, int(task.name), niceness)
        # Linux schedules sessions against each other first: niceness alone counts only within one.
        Path(f"/proc/{pid}/autogroup").write_text(str(niceness), encoding="ascii")
