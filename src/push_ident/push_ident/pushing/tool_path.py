"""Where the tool goes over the table at which time, and the motion that an arm can make of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.limits import LIMITS
from push_ident.types import Float64Array

__all__ = ["ToolMotion", "ToolPath", "rounded", "stopping"]

_PERIOD: Final = 0.01
"""Between samples of a motion [s], as of joint trajectories."""
_DENSE: Final = 0.004
"""Between the points of `ToolPath.dense` [m]."""
_RATE: Final = 40.0
"""With which a motion comes back to its path [1/s]: an error falls to a tenth within 0.1 s, and 0.4 in a sample is far from instable."""
_SHARE: Final = 0.8
"""Of the acceleration that a path may need [1]: the rest leads back to it."""
_THERE, _CATCH_UP = 1e-4, 2.0
"""Distance from the end at which a motion is there [m], and the longest time to catch up with a path that is over [s]."""
_BRAKING: Final = 16
"""Points of a tool that brakes, and as many before."""
_WINDOW: Final = np.linspace(-0.5, 0.5, 9)
"""Of the mean that rounds corners [1]."""


@dataclass(frozen=True, slots=True)
class ToolPath:
    """Points joined by straight lines.

    Raises:
        InputError: less than two points, shapes that do not fit, numbers that are not finite, times that do not increase, or a path that is
            longer or lasts longer than a push may: whoever makes it takes points every 4 mm and every 10 ms.
    """

    time: Float64Array
    """[s], shape (n,), ascending."""
    position: Float64Array
    """Axis of the tool [m], shape (n, 2), table frame."""

    def __post_init__(self) -> None:
        time, position = np.array(self.time, dtype=np.float64), np.array(self.position, dtype=np.float64)
        if time.ndim != 1 or len(time) < 2 or position.shape != (len(time), 2):
            raise InputError(
                f"A path of the tool has times of shape {time.shape} and points of shape {position.shape}, expected (n,), (n, 2)."
            )
        if not (np.isfinite(time).all() and np.isfinite(position).all()):
            raise InputError("A path of the tool has numbers that are not finite; give seconds and metres.")
        if np.any(np.diff(time) <= 0):
            raise InputError(f"The times of a path of the tool do not increase at point {int(np.argmax(np.diff(time) <= 0)) + 2}.")
        LIMITS.PUSH_SECONDS.check(float(time[-1] - time[0]), "A path of the tool")
        with np.errstate(over="ignore"):
            LIMITS.PUSH_TRAVEL.check(float(np.sum(np.linalg.norm(np.diff(position, axis=0), axis=1))), "A path of the tool")
        for name, values in (("time", time), ("position", position)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @property
    def speed(self) -> float:
        """The largest one [m/s]."""
        return float(np.max(np.linalg.norm(np.diff(self.position, axis=0), axis=1) / np.diff(self.time)))

    def at(self, time: Float64Array) -> Float64Array:
        """Points at times [s] of any shape, shape (..., 2); before the first and after the last those."""
        return np.stack([np.interp(time, self.time, column) for column in self.position.T], axis=-1)

    def later(self, delay: float) -> ToolPath:
        """The same, `delay` [s] later."""
        return ToolPath(self.time + delay, self.position)

    def dense(self) -> Float64Array:
        """Points at most 4 mm apart, shape (n, 2)."""
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.position, axis=0), axis=1))])
        even = np.linspace(0.0, length[-1], max(2, int(np.ceil(length[-1] / _DENSE)) + 1))
        # The corners are points too.
        return np.stack([np.interp(np.sort(np.append(even, length)), length, column) for column in self.position.T], axis=-1)


@dataclass(frozen=True, slots=True)
class ToolMotion:
    """Samples of a motion, 100 a second; the last one is at rest."""

    time: Float64Array
    """[s], shape (n,)."""
    position: Float64Array
    """[m], shape (n, 2), table frame."""
    velocity: Float64Array
    """[m/s], shape (n, 2)."""

    def heading(self, until: float = np.inf) -> Float64Array:
        """Unit vector of the motion before it comes to rest, or where it was broken off [s], shape (2,)."""
        speed = np.linalg.norm(self.velocity, axis=1)
        moves = np.flatnonzero(speed > 0.2 * max(float(speed.max()), 1e-9))
        if len(moves) == 0:
            return np.array([1.0, 0.0])
        k = moves[max(int(np.searchsorted(self.time[moves], until, side="right")) - 1, 0)]
        return np.asarray(self.velocity[k] / speed[k])


def stopping(motion: ToolMotion, begin: float, acceleration: float) -> ToolPath:
    """The path of a tool that brakes to rest along the motion that it makes: that was checked, a straight line would leave it in a bend.

    Args:
        motion: under way.
        begin: when it begins to brake [s].
        acceleration: largest [m/s^2].
    """
    k = min(int(np.searchsorted(motion.time, begin)), len(motion.time) - 1)
    braking = max(float(np.linalg.norm(motion.velocity[k])) / (_SHARE * acceleration), _PERIOD)
    after = np.linspace(-braking, braking, 2 * _BRAKING + 1)
    # What rounds a path looks back: up to now, the tool comes along the motion.
    reached = begin + np.where(after > 0.0, after - 0.5 * after**2 / braking, after)
    return ToolPath(begin + after, np.column_stack([np.interp(reached, motion.time, column) for column in motion.position.T]))


def rounded(
    path: ToolPath, begin: float, position: Float64Array, velocity: Float64Array, acceleration: float, speed: float = np.inf
) -> ToolMotion:
    """A motion that keeps to a path as closely as its acceleration allows, and ends at rest at the end of it.

    Corners are rounded by the mean over a window in which the largest speed can be reached. From where the tool is, which may be beside the
    path when that comes late, a controller with the path's own acceleration leads onto it, no faster than it can still brake before it. A
    tool that is behind at the end goes on until it is there.

    Args:
        path: to be made.
        begin: when the motion begins [s].
        position: of the tool then [m], shape (2,).
        velocity: and its velocity [m/s], shape (2,).
        acceleration: largest [m/s^2].
        speed: largest [m/s].
    """
    window = max(path.speed, float(np.linalg.norm(velocity))) / (_SHARE * acceleration)
    end = max(float(path.time[-1]) + 0.5 * window, begin) + 5.0 / _RATE
    time = np.asarray(begin + _PERIOD * np.arange(int(np.ceil((end - begin) / _PERIOD)) + 1), dtype=np.float64)
    mean = path.at(time[:, None] + window * _WINDOW).mean(axis=1)
    ends = path.at(time[:, None] + window * np.array([-0.5, 0.5]))
    wanted = (ends[:, 1] - ends[:, 0]) / max(window, _PERIOD)
    bend = np.gradient(wanted, _PERIOD, axis=0)
    x, y, vx, vy = (float(number) for number in (*position, *velocity))
    found, last = [(x, y, vx, vy)], len(time) - 1
    wanted[-1] = bend[-1] = 0.0
    for i in range(last + round(_CATCH_UP / _PERIOD)):
        k = min(i, last)
        away = (float(mean[k, 0]) - x, float(mean[k, 1]) - y)
        if i >= last and math.hypot(*away) < _THERE and math.hypot(vx, vy) < acceleration * _PERIOD:
            break
        # Critically damped near the path; from further away no faster than what the path leaves of the acceleration can brake again.
        nearer = min(0.5 * _RATE, math.sqrt(2.0 * (1.0 - _SHARE) * acceleration / max(math.hypot(*away), 1e-12)))
        ax, ay = (float(bend[k, j]) + 2.0 * _RATE * (float(wanted[k, j]) + nearer * away[j] - v) for j, v in enumerate((vx, vy)))
        ax, ay = _at_most(ax, ay, acceleration)
        before = vx, vy
        vx, vy = _at_most(vx + _PERIOD * ax, vy + _PERIOD * ay, speed)
        # As a cubic between both samples moves.
        x, y = x + 0.5 * _PERIOD * (before[0] + vx), y + 0.5 * _PERIOD * (before[1] + vy)
        found.append((x, y, vx, vy))
    made = np.array(found)
    made[-1, 2:] = 0.0
    return ToolMotion(np.asarray(begin + _PERIOD * np.arange(len(made)), dtype=np.float64), made[:, :2], made[:, 2:])


def _at_most(x: float, y: float, length: float) -> tuple[float, float]:
    """A vector, cut off at a length."""
    share = min(1.0, length / max(math.hypot(x, y), 1e-12))
    return share * x, share * y
