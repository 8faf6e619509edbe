"""Whether an arm has missed pieces of its motion: the next one would make it jump to where that begins."""

from __future__ import annotations

from bisect import insort
from typing import Final

import numpy as np

from push_ident.pushing.motion import ArmMotion
from push_ident.pushing.pacing import PathPacing
from push_ident.pushing.ports import ArmState
from push_ident.types import Float64Array

__all__ = ["Standstill"]

_BEHIND: Final = 0.001
"""Way of the tool [m] by which an arm that stands is behind its pieces: it has missed some, and the next one would make it jump there."""
_MOVES: Final = 3e-4
"""A tool that has moved less [m] within `_LOOKED` stands, or goes so slowly that it is behind for no other reason."""
_LOOKED: Final = 0.03
"""[s]"""
_DELAY: Final = 0.03
"""By which an arm may be later than usual [s]: one more state."""


class Standstill:
    """Notices an arm that stands although its pieces lead on: they came so late that they had ended.

    Args:
        lag: largest delay of a healthy arm behind its pieces [s].
        longest: interruption [s].
    """

    def __init__(self, lag: float, longest: float) -> None:
        self._lag, self._longest = lag, longest
        self._delays: list[float] = []
        """Behind the pieces, wherever the tool moved [s], in order of size: controllers differ."""
        self._tip: Float64Array | None = None
        self._since = np.inf

    def where(self, motion: ArmMotion, pacing: PathPacing, state: ArmState, time: float) -> float | None:
        """Path time at which the arm stands [s]; None where it moves, or should stand.

        None, too, where it has stood for longer: something blocks it, and its force and distance from the path tell.
        """
        tip, led_to = state.pose_tip_in_table[:3, 3], pacing.path_time(time)
        found = min(motion.time_at(tip, pacing.path_time(time - self._lag), led_to), led_to)
        if self._tip is None:
            self._tip, self._since = tip, time
        elif np.linalg.norm(tip - self._tip) > _MOVES:
            self._tip, self._since = tip, time
            insort(self._delays, time - pacing.time_of(found))
        if not _LOOKED <= time - self._since <= self._longest:
            return None
        # Before it has moved nobody knows: a controller that is slow to begin has missed nothing.
        delay = self._delays[len(self._delays) // 2] + _DELAY if self._delays else self._lag
        return found if _way(motion, found, pacing.path_time(time - delay)) > _BEHIND else None


def _way(motion: ArmMotion, begin: float, end: float) -> float:
    """Of the tool between two times of the plan [m]."""
    first, last = np.searchsorted(motion.trajectory.time, [begin, end])
    return float(np.sum(np.linalg.norm(np.diff(motion.tip[int(first) : int(last) + 1], axis=0), axis=1)))
