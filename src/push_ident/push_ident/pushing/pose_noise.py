"""Noise of poses that come without a covariance, from the frames in which their object rests.

Zero stands for a variance that nobody stated, as in ROS: of the positions, of the yaw, or of both. What other poses of the object state is
taken for it, else the scatter at rest. Of blocks of some ten frames the median is taken, each divided by the median scatter of so few
frames (of chi square): between pushes an object may be put elsewhere by hand, which few blocks show. Scatter shows neither errors that all
poses share nor noise that a filter has smoothed.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from scipy.special import gammaincinv

from push_ident.checking.overlap import NOISE_FACTOR
from push_ident.types import BoolArray, Float64Array

LEAST_POSITION_STD, LEAST_YAW_STD = 1e-4, float(np.radians(0.05))
"""Least standard deviations that are taken from the scatter at rest: the error that all poses share does not scatter."""
PAUSE: Final = 0.5
"""Longest time between two frames of one rest [s], as between two samples of one push."""
_BLOCK: Final = 10
"""Frames of a block of a long rest."""
_ENOUGH: Final = _BLOCK - 1
"""Degrees of freedom of the yaw from which its standard deviation is known to a quarter, 1 / sqrt(2 n)."""
_KEPT: Final = 1000
"""Blocks, and stated variances, that are kept, the latest: 10 000 frames show a standard deviation to 1 %."""


class PoseNoise:
    """Noise of the poses of one object. Takes in its frames in order of time."""

    def __init__(self, given: tuple[float, float] | None = None) -> None:
        """`given`: standard deviations of position [m] and yaw [rad] that the user states; None: they are looked for."""
        self._given = given
        self._rest: list[Float64Array] = []
        self._blocks: deque[tuple[int, float, float]] = deque(maxlen=_KEPT)
        """Frames, and unbiased variances of position and yaw, of each block."""
        self._scatter: tuple[float, float] | None = None
        self._stated: tuple[deque[float], deque[float]] = deque(maxlen=_KEPT), deque(maxlen=_KEPT)
        """Variances of position and of yaw."""
        self.is_needed = False
        """Whether a pose came that does not state all of its covariance."""
        self.latest = -np.inf
        """Time of the latest frame that was taken in [s]."""

    def state(self, covariance: Float64Array) -> None:
        """Take in the covariance of a pose, shape (3, 3), zero where it is unknown."""
        variances = 0.5 * (covariance[0, 0] + covariance[1, 1]), covariance[2, 2]
        for kept, variance in zip(self._stated, variances, strict=True):
            if variance > 0:
                kept.append(float(variance))
            else:
                self.is_needed = True

    def add(self, time: float, pose: Float64Array, *, moves: bool, pause: float) -> None:
        """A frame, (x, y, yaw), in which the object may move, or rests; after a `pause` [s] it begins another rest."""
        if moves or time > self.latest + pause:
            self.end_rest()
        self.latest = time
        if moves:
            return
        self._rest.append(pose)
        # As long as the next block is not sure to be whole, its frames may have to belong to this one.
        if len(self._rest) >= 2 * _BLOCK:
            self._close(self._rest[:_BLOCK])
            del self._rest[:_BLOCK]

    def end_rest(self) -> None:
        """What comes next is another rest, of any time."""
        self._close(self._rest)
        self._rest, self.latest = [], -np.inf

    def _close(self, frames: list[Float64Array]) -> None:
        if block := _block_of(frames):
            self._blocks += block
            self._scatter = None

    def scatter(self) -> tuple[float, float] | None:
        """Standard deviations of position [m] and yaw [rad] from the frames at rest; None where these are too few."""
        if self._scatter is not None or self._freedom < _ENOUGH:
            return self._scatter
        n, position, yaw = np.array([*self._blocks, *_block_of(self._rest)]).T
        self._scatter = _median_std(position, 2.0 * (n - 1.0)), _median_std(yaw, n - 1.0)
        return self._scatter

    def std(self) -> tuple[float, float] | None:
        """Standard deviations of position [m] and yaw [rad] where a pose states none; None while nothing shows them."""
        if self._given is not None:
            return self._given
        found, of_rests, least = [], self.scatter(), (LEAST_POSITION_STD, LEAST_YAW_STD)
        for k, stated in enumerate(self._stated):
            if stated:
                found.append(float(np.sqrt(np.median(stated))))
            elif of_rests is not None:
                found.append(max(of_rests[k], least[k]))
            else:
                return None
        return found[0], found[1]

    def filled(self, covariance: Float64Array) -> Float64Array | None:
        """Covariances, shape (..., 3, 3), with what was not stated; None where that is unknown."""
        no_position, no_yaw = covariance[..., 0, 0] == 0, covariance[..., 2, 2] == 0
        if not (np.any(no_position) or np.any(no_yaw)):
            return covariance
        if (std := self.std()) is None:
            return None
        filled = covariance.copy()
        filled[no_position, 0, 0] = filled[no_position, 1, 1] = std[0] ** 2
        filled[no_yaw, 2, 2] = std[1] ** 2
        return filled

    def text(self) -> str:
        """What is taken for poses without a covariance, or what is missing for it."""
        if (std := self.std()) is None:
            return f"its poses lack a covariance, and {self._freedom} of its frames at rest follow another one, expected at least {_ENOUGH}"
        taken = f"{1e3 * std[0]:.2f} mm and {np.degrees(std[1]):.3f} degrees are taken as standard deviations that its poses lack"
        if self._given is not None or all(self._stated):
            return f"{taken}, as {'given' if self._given is not None else 'its other poses state'}"
        n = sum(frames for frames, *_ in self._blocks) + len(self._rest)
        return f"{taken}, from the scatter of {n} frames at rest, which shows no error that all poses share"

    @property
    def _freedom(self) -> int:
        return sum(n - 1 for n, *_ in self._blocks) + max(len(self._rest) - 1, 0)


def _block_of(frames: list[Float64Array]) -> list[tuple[int, float, float]]:
    """The block of frames that follow each other, if there are two."""
    if len(frames) < 2:
        return []
    pose = np.array(frames)
    return [(len(pose), float(pose[:, :2].var(axis=0, ddof=1).mean()), float(np.unwrap(pose[:, 2]).var(ddof=1)))]


def _median_std(variance: Float64Array, freedom: Float64Array) -> float:
    """Weighted median of the standard deviations that blocks show, shapes (n_blocks,)."""
    unbiased = variance * freedom / (2.0 * gammaincinv(0.5 * freedom, 0.5))  # by the median of chi square
    order = np.argsort(unbiased)
    below = np.cumsum(freedom[order]) - 0.5 * freedom[order]
    return float(np.sqrt(np.interp(0.5 * freedom.sum(), below, unbiased[order])))


def pusher_moves(time: Float64Array, path: Float64Array, pause: float) -> BoolArray:
    """Whether the pusher moves around each time [s], shape (n,): within a `pause` [s] by more than its noise and 0.5 mm.

    `path`: rows (time, x, y) of the pusher [s, m, m], shape (m, 3); where it pauses for longer, it does not move.
    """
    moves: BoolArray = np.zeros(len(time), dtype=np.bool_)
    for run in np.split(path, np.flatnonzero(np.diff(path[:, 0]) > pause) + 1):
        if len(run) < 2:
            continue
        early, late = (np.clip(time + shift, run[0, 0], run[-1, 0]) for shift in (-0.5 * pause, 0.5 * pause))
        way = [np.interp(late, run[:, 0], run[:, axis]) - np.interp(early, run[:, 0], run[:, axis]) for axis in (1, 2)]
        moves |= np.hypot(*way) > max(0.5e-3, NOISE_FACTOR * np.sqrt(2.0) * _path_noise(run[:, 1:]))
    return moves


def _path_noise(position: Float64Array) -> float:
    """Standard deviation of the noise of a path [m], shape (n, 2), from its second differences."""
    if len(position) < 3:
        return 0.0
    bend = position[2:] - 2.0 * position[1:-1] + position[:-2]
    # Median of the absolute value and variance of a second difference of independent normal numbers.
    return float(np.median(np.abs(bend)) / (0.6745 * np.sqrt(6.0)))
