"""The arm's clock between two of its states."""

from __future__ import annotations

import threading
from collections import deque
from typing import Final

__all__ = ["ArmClock"]

_WINDOW: Final = 32
"""States of the fit: a third of a second at 100 Hz, in which jitter of 1 ms in their receipt averages to 0.4 ms at the end."""
_AHEAD: Final = 0.05
"""The clock is at most so much later than the latest stamp [s]: a simulation may pause."""
_JUMP: Final = 0.25
"""A stamp so far from its neighbour, beyond the time between them, is of another setting of the clock [s]."""


class ArmClock:
    """Estimates what the arm's clock shows, by a straight line through stamps over times of receipt.

    A simulated arm's clock may be slower or faster than wall time. May be used by several threads.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen: deque[tuple[float, float]] = deque(maxlen=_WINDOW)

    def observe(self, received: float, stamp: float) -> None:
        """Process the stamp [s] of a state and its receipt [s], wall time."""
        with self._lock:
            if self._seen and self._is_jump(received, stamp):
                self._seen.clear()
            self._seen.append((received, stamp))

    def at(self, wall: float) -> tuple[float, bool]:
        """Time of the arm's clock [s] at a wall time [s] after the latest state, and whether that is known: a state is overdue where not.

        There must have been a state.
        """
        with self._lock:
            latest = self._seen[-1][1]
            mean_wall, mean_stamp, rate = self._fit()
        time = max(mean_stamp + rate * (wall - mean_wall), latest)
        return min(time, latest + _AHEAD), time <= latest + _AHEAD

    @property
    def rate(self) -> float:
        """Seconds of the arm's clock per second of wall time; 1 before it is known."""
        with self._lock:
            return self._fit()[2]

    def _is_jump(self, received: float, stamp: float) -> bool:
        wall_before, stamp_before = self._seen[-1]
        passed = stamp - stamp_before
        return passed < -_JUMP or passed > _JUMP + max(self._fit()[2], 1.0) * (received - wall_before)

    def _fit(self) -> tuple[float, float, float]:
        """Mean wall time, mean stamp and slope."""
        seen, n = self._seen, len(self._seen)
        if n == 0:
            return 0.0, 0.0, 1.0
        wall = sum(w for w, _ in seen) / n
        stamp = sum(s for _, s in seen) / n
        spread = sum((w - wall) ** 2 for w, _ in seen)
        if n < 4 or spread <= 0.0:
            return seen[-1][0], seen[-1][1], 1.0
        return wall, stamp, max(sum((w - wall) * (s - stamp) for w, s in seen) / spread, 0.0)
