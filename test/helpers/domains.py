"""ROS domains that no other test of this machine uses at the same time."""

from __future__ import annotations

import fcntl
import random
import tempfile
from pathlib import Path
from typing import IO

_HELD: list[IO[str]] = []
"""Locked files; the kernel releases them when the process ends."""


def own_domain() -> int:
    """A domain that stays this process's own until it ends. 101 is the highest one whose ports are free on every Linux."""
    for domain in random.SystemRandom().sample(range(1, 102), 101):
        file = (Path(tempfile.gettempdir()) / f"push_ident_test_domain_{domain}").open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            continue
        _HELD.append(file)
        return domain
    raise RuntimeError("All ROS domains from 1 to 101 are used by running tests.")
