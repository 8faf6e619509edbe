"""Memory, open files and threads of the processes of a cell over time, and whether they grow."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.cli.supervisor import Supervisor
from push_ident_sim.studies.common.base import Json

__all__ = ["QUANTITIES", "Meters", "growth"]

QUANTITIES: Final = {"memory_mb": "private memory [MB]", "files": "open files", "threads": "threads"}
"""What is measured. Memory: pages of the process alone; a share of the libraries would change with the other processes of the machine."""
_PERIOD: Final = 5.0
"""Between two samples [s]."""
_WARM: Final = 60.0
"""A process younger than this is still loading and compiling [s]: its samples do not count for its growth."""


class Meters:
    """Samples all processes of a supervisor."""

    def __init__(self, supervisor: Supervisor, names: Sequence[str]) -> None:
        self._supervisor, self._names = supervisor, names
        self._began = self._last = time.monotonic()
        self._pids: dict[str, tuple[int, float]] = {}
        self.samples: dict[str, list[Json]] = {name: [] for name in names}
        """By node, in the order of time: `time_s` since the start, `life` (which process of that name), `age_s`, and `QUANTITIES`."""

    def tend(self) -> None:
        """To be called often; measures when it is time."""
        now = time.monotonic()
        if now - self._last < _PERIOD:
            return
        self._last = now
        for name in self._names:
            pid = self._supervisor.pid(name)
            if pid != self._pids.get(name, (0, 0.0))[0]:
                self._pids[name] = pid, now
            try:
                measured = _measure(pid)
            except (OSError, ValueError, IndexError):
                continue  # it has just ended
            age = now - self._pids[name][1]
            self.samples[name].append({"time_s": now - self._began, "life": pid, "age_s": age, **measured})


def _measure(pid: int) -> Json:
    process = Path(f"/proc/{pid}")
    rollup = (process / "smaps_rollup").read_text(encoding="ascii")
    kilobytes = sum(int(line.split()[1]) for line in rollup.splitlines() if line.startswith("Private_"))
    threads = int((process / "status").read_text(encoding="utf-8").split("Threads:")[1].split()[0])
    return {"memory_mb": kilobytes / 1024, "files": len(os.listdir(process / "fd")), "threads": threads}


def growth(samples: Sequence[Json], quantity: str) -> Json | None:
    """Growth of a quantity per hour: one slope for all lives, each with a level of its own.

    Returns:
        `per_hour`, its standard error `std` from the scatter of windows of a minute (neighbouring samples are not independent),
        `level` (mean) and `hours` of life observed; None without a life that is long enough.
    """
    parts, lives = [], 0
    for life in sorted({sample["life"] for sample in samples}):
        own = [sample for sample in samples if sample["life"] == life and sample["age_s"] > _WARM]
        minutes = np.array([sample["age_s"] // _WARM for sample in own])
        points = np.array([[sample["age_s"] / 3600.0, sample[quantity]] for sample in own])
        means = np.array([points[minutes == minute].mean(axis=0) for minute in np.unique(minutes)])
        if len(means) > 1:
            lives += 1
            parts.append(means - means.mean(axis=0))
    centred = np.vstack(parts) if parts else np.zeros((0, 2))
    freedom = len(centred) - lives - 1
    if freedom < 1:
        return None
    x, y = centred.T
    slope = float(x @ y / (x @ x))
    residual = y - slope * x
    return {
        "per_hour": slope,
        "std": float(np.sqrt(residual @ residual / freedom / (x @ x))),
        "level": float(np.mean([sample[quantity] for sample in samples])),
        "hours": len(centred) * _WARM / 3600.0,
    }
