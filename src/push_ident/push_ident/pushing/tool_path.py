"""Paths of the tool over the table, the corridor of its corrections, and the motion that an arm can make of a path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.limits import LIMITS
from push_ident.pushing.trajectory import SAMPLE_PERIOD
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class PathControl:
    """How a tool keeps to a path, and stops."""

    rate: float = 40.0
    """Rate at which an error from the path decays [1/s]: to a tenth within 0.1 s, and 0.4 in a sample is far from instable."""
    path_share: float = 0.8
    """Share of the acceleration that the path itself may need [1]; the rest corrects errors."""
    arrival_distance: float = 1e-4
    """Distance from the end at which the motion has arrived [m]."""
    catch_up_time: float = 2.0
    """Longest time to catch up with a path that is over [s]."""
    n_braking_points: int = 16
    """Points of the path of a tool that brakes, and as many before."""


_CONTROL: Final = PathControl()


@dataclass(frozen=True, slots=True)
class Corridor:
    """A strip along a line of the table.

    Raises InputError: less than two points, numbers that are not finite, or a width that is not positive.
    """

    line: Float64Array
    """Middle of the strip [m], shape (n, 2), table frame."""
    half_width: float
    """Largest distance from the line [m]."""

    def __post_init__(self) -> None:
        line = np.array(self.line, dtype=np.float64)
        if line.ndim != 2 or line.shape[1:] != (2,) or len(line) < 2 or not np.isfinite(line).all():
            raise InputError(f"The line of a corridor has shape {line.shape}, expected two points (x, y) or more, all finite, in metres.")
        if not (np.isfinite(self.half_width) and self.half_width > 0):
            raise InputError(f"Half the width of a corridor is {self.half_width} m, expected a positive number.")
        line.setflags(write=False)
        object.__setattr__(self, "line", line)

    def outline(self) -> Float64Array:
        """Border of the strip for drawing [m], shape (n, 2), with flat ends, and without what lies within it inside of a bend."""
        tangent = np.gradient(self.line, axis=0)
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        aside = self.half_width * np.column_stack([-tangent[:, 1], tangent[:, 0]])
        border = np.vstack([self.line + aside, (self.line - aside)[::-1]])
        # Inside a bend, the offset lines cross; 0.95 allows for rounding and the pieces of the bend.
        return border[Corridor(self.line, 0.95 * self.half_width).excess(border) > 0.0]

    def excess(self, points: Float64Array) -> Float64Array:
        """Distance of points, shape (..., 2), out of the strip [m], shape (...); 0 inside."""
        # By coordinates: an axis of two would cost more than the arithmetic, for hundreds of tools in each correction.
        (x, y), (along_x, along_y) = self.line[:-1].T, np.diff(self.line, axis=0).T
        points = np.asarray(points)
        away_x, away_y = points[..., :1] - x, points[..., 1:] - y
        share = np.clip((away_x * along_x + away_y * along_y) / np.maximum(along_x**2 + along_y**2, 1e-18), 0.0, 1.0)
        away_x, away_y = away_x - share * along_x, away_y - share * along_y
        distance = np.sqrt(np.min(away_x * away_x + away_y * away_y, axis=-1))
        return np.asarray(np.maximum(distance - self.half_width, 0.0))


@dataclass(frozen=True, slots=True)
class ToolPath:
    """Points joined by straight lines.

    Raises InputError: less than two points, shapes that do not fit, numbers that are not finite, times that do not increase, or a path that
    is longer or lasts longer than a push may: it is sampled every 4 mm and every 10 ms.
    """

    time: Float64Array
    """[s], shape (n,), ascending."""
    position: Float64Array
    """Axis of the tool [m], shape (n, 2), table frame."""
    yaw: Float64Array | None = None
    """Of the frame of a tool with two contacts, which is between them, in the table frame [rad], shape (n,), not wrapped; None of a
    cylinder."""

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
        yaw = None if self.yaw is None else self._checked_yaw(len(time))
        for name, values in (("time", time), ("position", position), ("yaw", yaw)):
            if values is not None:
                values.setflags(write=False)
                object.__setattr__(self, name, values)

    def _checked_yaw(self, n: int) -> Float64Array:
        yaw = np.array(self.yaw, dtype=np.float64)
        if yaw.shape != (n,) or not np.isfinite(yaw).all():
            raise InputError(f"A path of the tool has yaws of shape {yaw.shape}, expected ({n},), all finite, in radians.")
        LIMITS.YAW.check(float(np.abs(yaw).max()), "A path of the tool")
        if (turn := float(np.abs(np.diff(yaw)).max())) > np.pi:
            raise InputError(f"A tool turns by {turn:.2f} rad from one point to the next, expected half a turn at most; do not wrap yaws.")
        return yaw

    @property
    def poses(self) -> Float64Array:
        """Poses of the frame (x, y, yaw) at the points, shape (n, 3). For a path with yaws."""
        assert self.yaw is not None, "of a tool with two contacts"
        return np.column_stack([self.position, self.yaw])

    def dense_poses(self, spacing: float, reach: float) -> tuple[Float64Array, Float64Array]:
        """Times [s], even over the path, shape (n,), and poses then, shape (n, 3), between which no point within `reach` [m] of the axis
        moves by more than `spacing` [m]. For a path with yaws."""
        moved = np.linalg.norm(np.diff(self.position, axis=0), axis=1) + reach * np.abs(np.diff(self.poses[:, 2]))
        duration = float(self.time[-1] - self.time[0])
        n = max(2, math.ceil(duration * float(np.max(moved / np.diff(self.time))) / spacing))
        LIMITS.POINTS.check(n, "A path of the tool, with points between which it moves by less than a straight line is cut into,")
        time = np.linspace(float(self.time[0]), float(self.time[-1]), n + 1)
        return time, np.column_stack([np.interp(time, self.time, column) for column in self.poses.T])

    @property
    def speed(self) -> float:
        """Largest speed [m/s]."""
        return float(np.max(np.linalg.norm(np.diff(self.position, axis=0), axis=1) / np.diff(self.time)))

    def at(self, time: Float64Array) -> Float64Array:
        """Points at times [s] of any shape, shape (..., 2); the end points outside of the path's times."""
        return np.stack([np.interp(time, self.time, column) for column in self.position.T], axis=-1)

    def later(self, delay: float) -> ToolPath:
        """The path, `delay` [s] later."""
        return ToolPath(self.time + delay, self.position)

    def dense(self, spacing: float = 0.004) -> Float64Array:
        """Points at most `spacing` [m] apart, shape (n, 2), the corners among them."""
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.position, axis=0), axis=1))])
        even = np.linspace(0.0, length[-1], max(2, int(np.ceil(length[-1] / spacing)) + 1))
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
        """Unit vector of the motion before it comes to rest, or at the time `until` [s] if it was stopped then, shape (2,)."""
        speed = np.linalg.norm(self.velocity, axis=1)
        moves = np.flatnonzero(speed > 0.2 * max(float(speed.max()), 1e-9))
        if len(moves) == 0:
            return np.array([1.0, 0.0])
        k = moves[max(int(np.searchsorted(self.time[moves], until, side="right")) - 1, 0)]
        return np.asarray(self.velocity[k] / speed[k])


def stopping(motion: ToolMotion, begin: float, acceleration: float) -> ToolPath:
    """Path of a tool that brakes to rest along its present motion, which was checked; a straight line would leave it in a bend.

    Args:
        begin: when the tool begins to brake [s].
        acceleration: largest acceleration [m/s^2].
    """
    k = min(int(np.searchsorted(motion.time, begin)), len(motion.time) - 1)
    braking = max(float(np.linalg.norm(motion.velocity[k])) / (_CONTROL.path_share * acceleration), SAMPLE_PERIOD)
    after = np.linspace(-braking, braking, 2 * _CONTROL.n_braking_points + 1)
    # `rounded` averages over a window: the path begins before `begin`, on the motion made so far.
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
        begin: when the motion begins [s].
        position: of the tool then [m], shape (2,).
        velocity: of the tool then [m/s], shape (2,).
        acceleration: largest acceleration [m/s^2].
        speed: largest speed [m/s].
    """
    control, period = _CONTROL, SAMPLE_PERIOD
    window = max(path.speed, float(np.linalg.norm(velocity))) / (control.path_share * acceleration)
    end = max(float(path.time[-1]) + 0.5 * window, begin) + 5.0 / control.rate
    time = np.asarray(begin + period * np.arange(int(np.ceil((end - begin) / period)) + 1), dtype=np.float64)
    mean = path.at(time[:, None] + window * np.linspace(-0.5, 0.5, 9)).mean(axis=1)
    ends = path.at(time[:, None] + window * np.array([-0.5, 0.5]))
    wanted = (ends[:, 1] - ends[:, 0]) / max(window, period)
    bend = np.gradient(wanted, period, axis=0)
    x, y, vx, vy = (float(number) for number in (*position, *velocity))
    states, last = [(x, y, vx, vy)], len(time) - 1
    wanted[-1] = bend[-1] = 0.0
    for i in range(last + round(control.catch_up_time / period)):
        k = min(i, last)
        error = (float(mean[k, 0]) - x, float(mean[k, 1]) - y)
        if i >= last and math.hypot(*error) < control.arrival_distance and math.hypot(vx, vy) < acceleration * period:
            break
        # Critically damped near the path; from further away no faster than what the path leaves of the acceleration can brake again.
        gain = min(0.5 * control.rate, math.sqrt(2.0 * (1.0 - control.path_share) * acceleration / max(math.hypot(*error), 1e-12)))
        ax, ay = (float(bend[k, j]) + 2.0 * control.rate * (float(wanted[k, j]) + gain * error[j] - v) for j, v in enumerate((vx, vy)))
        ax, ay = _at_most(ax, ay, acceleration)
        before = vx, vy
        vx, vy = _at_most(vx + period * ax, vy + period * ay, speed)
        # As a cubic between both samples moves.
        x, y = x + 0.5 * period * (before[0] + vx), y + 0.5 * period * (before[1] + vy)
        states.append((x, y, vx, vy))
    motion = np.array(states)
    motion[-1, 2:] = 0.0
    return ToolMotion(np.asarray(begin + period * np.arange(len(motion)), dtype=np.float64), motion[:, :2], motion[:, 2:])


def _at_most(x: float, y: float, length: float) -> tuple[float, float]:
    """A vector, cut off at a length."""
    share = min(1.0, length / max(math.hypot(x, y), 1e-12))
    return share * x, share * y
