"""How fast simulated time goes: its pace, and the processor time of its parts."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["Meter", "Pace"]


class Meter:
    """Speed of the simulation and processor time of its parts."""

    def __init__(self) -> None:
        self.simulated = 0.0
        """Simulated time [s]."""
        self.n_images = 0
        self._used: defaultdict[str, float] = defaultdict(float)
        self._last = (time.perf_counter(), 0.0, 0, self._used.copy())

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Count the processor time that this thread spends inside; only one thread may measure each part."""
        begin = time.thread_time()
        yield
        self._used[part] += time.thread_time() - begin

    def read(self) -> dict[str, str]:
        """Since the last call, as text: real-time factor, images per simulated second, seconds of the processor per simulated second."""
        before = self._last
        self._last = now = (time.perf_counter(), self.simulated, self.n_images, self._used.copy())
        wall, simulated = now[0] - before[0], now[1] - before[1]
        values = {"real time factor": f"{simulated / wall:.3f}", "simulated time [s]": f"{now[1]:.2f}"}
        if simulated > 0:
            values["images [1/s]"] = f"{(now[2] - before[2]) / simulated:.1f}"
            values |= {f"processor, {part} [s/s]": f"{(now[3][part] - before[3][part]) / simulated:.3f}" for part in sorted(now[3])}
        return values


class Pace:
    """Keeps simulated time from running ahead of the wall clock."""

    def __init__(self) -> None:
        self._wall: float | None = None
        self._sim = self._factor = 0.0

    def wait(self, now: float, factor: float) -> None:
        """Sleep until `factor` times the wall time since the reference has reached `now` [s]; 0 never sleeps."""
        if self._wall is None or factor != self._factor:
            self._wall, self._sim, self._factor = time.perf_counter(), now, factor
        if factor == 0:
            return
        ahead = (now - self._sim) / factor - (time.perf_counter() - self._wall)
        if ahead > 0:
            time.sleep(ahead)
        elif ahead < -0.02:
            # It does not catch up: what it catches up goes by at once, without news from other processes. An arm that gets its motion in
            # pieces of 0.08 s would come to their ends, and brake.
            self._wall, self._sim = time.perf_counter(), now
