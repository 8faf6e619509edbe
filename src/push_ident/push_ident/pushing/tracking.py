"""Whether an arm follows its commands, by its states: each of them is judged, and none decides where the arm is sent."""

from __future__ import annotations

from bisect import insort
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.arm_motion import ArmMotion
from push_ident.pushing.pacing import PathPacing
from push_ident.pushing.ports import ArmState
from push_ident.pushing.push import PushCode
from push_ident.types import Float64Array

__all__ = ["Tracking"]

_BEHIND: Final = 0.001
"""Way of the tool [m] by which an arm that stands is behind its pieces: it has missed some, and the next one would make it jump there."""
_MOVES: Final = 3e-4
"""A tool that has moved less [m] within `_LOOKED` stands, or goes so slowly that it is behind for no other reason."""
_LOOKED: Final = 0.03
"""[s]"""
_DELAY: Final = 0.03
"""By which an arm may be later than usual [s]: one more state."""


class Tracking:
    """Compares the states of an arm with the pieces of a motion that it got.

    Args:
        pacing: of the motion.
        tool_tolerance: largest distance of the tool from its path [m].
        joint_tolerance: largest distance of a joint from its path [rad].
        lag: largest delay of a healthy arm behind its pieces [s].
    """

    def __init__(self, pacing: PathPacing, tool_tolerance: float, joint_tolerance: float, lag: float) -> None:
        self._pacing, self._tool_tolerance, self._joint_tolerance, self._lag = pacing, tool_tolerance, joint_tolerance, lag
        self._delays: list[float] = []
        """Behind the pieces, wherever the tool moved [s], in order of size: controllers differ."""
        self._tip: Float64Array | None = None
        self._since = np.inf
        self.stood_at: float | None = None
        """Path time [s] at which an arm stands that is behind its pieces; None where it follows."""

    def take(self, motion: ArmMotion, state: ArmState, time: float) -> None:
        """Judge a state; `time` [s] on the clock of the pieces.

        Raises:
            PlanningError: TRACKING where the arm cannot be there by what it was told.
        """
        earliest, latest = self._pacing.path_time(time - self._lag), self._pacing.path_time(time)
        if self.stood_at is not None:
            earliest = min(earliest, self.stood_at)
        tip, after = state.pose_tip_in_table[:3, 3], f"{time - self._pacing.started:.2f} s"
        if (distance := motion.deviation(tip, earliest, latest)) > self._tool_tolerance:
            limit = f"{1e3 * self._tool_tolerance:.1f} mm"
            raise PlanningError(PushCode.TRACKING, f"the tool is {1e3 * distance:.1f} mm from its path after {after}, limit {limit}.")
        joint, angle = motion.joint_deviation(state.q, earliest, latest)
        if angle > self._joint_tolerance:
            limit = f"{self._joint_tolerance:.3f} rad"
            raise PlanningError(PushCode.TRACKING, f"{joint} is {angle:.3f} rad from its path after {after}, limit {limit}.")
        if self.stood_at is None:
            self.stood_at = self._standstill(motion, tip, time, latest)

    def is_at_end(self, motion: ArmMotion, state: ArmState) -> bool:
        """Whether an arm that stood has come to where its last piece ends."""
        assert self.stood_at is not None, "it stood"
        found = motion.time_at(state.pose_tip_in_table[:3, 3], self.stood_at, self._pacing.reaches)
        return _way(motion, found, self._pacing.reaches) <= _BEHIND

    def go_on(self) -> None:
        """The arm is where its pieces led; it is to follow the next ones."""
        self.stood_at = self._tip = None

    def _standstill(self, motion: ArmMotion, tip: Float64Array, time: float, led_to: float) -> float | None:
        """Path time at which the arm stands although its pieces lead on [s]; None where it moves, or should stand."""
        found = min(motion.time_at(tip, self._pacing.path_time(time - self._lag), led_to), led_to)
        if self._tip is None:
            self._tip, self._since = tip, time
        elif np.linalg.norm(tip - self._tip) > _MOVES:
            self._tip, self._since = tip, time
            insort(self._delays, time - self._pacing.time_of(found))
        if time - self._since < _LOOKED:
            return None
        # Before it has moved nobody knows: a controller that is slow to begin has missed nothing.
        delay = self._delays[len(self._delays) // 2] + _DELAY if self._delays else self._lag
        return found if _way(motion, found, self._pacing.path_time(time - delay)) > _BEHIND else None


def _way(motion: ArmMotion, begin: float, end: float) -> float:
    """Of the tool between two times of the plan [m]."""
    first, last = np.searchsorted(motion.trajectory.time, [begin, end])
    return float(np.sum(np.linalg.norm(np.diff(motion.tip[int(first) : int(last) + 1], axis=0), axis=1)))
