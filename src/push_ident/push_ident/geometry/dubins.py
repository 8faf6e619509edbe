"""Shortest paths of a point that goes forward only and turns with a least radius (L. E. Dubins, 1957).

A path is three parts, each an arc to the left (L), to the right (R) or straight (S). The six words and their lengths are those of Shkel &
Lumelsky, Classification of the Dubins set, Robotics and Autonomous Systems 34, 2001.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.types import Float64Array

_Lengths = tuple[float, float, float]
_TURN = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class DubinsPath:
    """Arcs and straight parts from one pose to another."""

    start: Float64Array
    """(x, y, heading) [m, m, rad], shape (3,)."""
    radius: float
    """Of the arcs [m]."""
    word: str
    """Three letters of L, S, R."""
    lengths: _Lengths
    """Of the parts [m]."""

    @property
    def length(self) -> float:
        """[m]"""
        return sum(self.lengths)

    def poses(self, spacing: float) -> Float64Array:
        """Poses (x, y, heading) along it, no farther apart than `spacing` [m], shape (n, 3), heading not wrapped."""
        rows = [np.asarray(self.start, dtype=np.float64)]
        for letter, length in zip(self.word, self.lengths, strict=True):
            curvature = {"L": 1.0, "S": 0.0, "R": -1.0}[letter] / self.radius
            if length > 0.0:
                travelled = np.linspace(0.0, length, 1 + math.ceil(length / spacing))[1:]
                rows += list(_along(rows[-1], curvature, travelled))
        return np.array(rows)


def dubins_path(start: Float64Array, end: Float64Array, radius: float) -> DubinsPath:
    """The shortest of `dubins_paths`."""
    return dubins_paths(start, end, radius)[0]


def dubins_paths(start: Float64Array, end: Float64Array, radius: float) -> list[DubinsPath]:
    """A path of each word that leads from one pose (x, y, heading) [m, m, rad], shape (3,), to another with arcs of `radius` [m], the
    shortest first.

    Raises InputError for poses that are not finite, or no positive radius.
    """
    if not (np.isfinite([*start, *end]).all() and math.isfinite(radius) and radius > 0.0):
        raise InputError(f"A path from {start} to {end} with radius {radius} has no finite poses or no radius > 0 m.")
    dx, dy = (end[0] - start[0]) / radius, (end[1] - start[1]) / radius
    distance, bearing = math.hypot(dx, dy), math.atan2(dy, dx)
    alpha, beta = (start[2] - bearing) % _TURN, (end[2] - bearing) % _TURN
    first = np.array(start, dtype=np.float64)
    paths = [DubinsPath(first, radius, word, (radius * t, radius * p, radius * q)) for word, (t, p, q) in _words(alpha, beta, distance)]
    return sorted(paths, key=lambda path: path.length)


def _along(pose: Float64Array, curvature: float, travelled: Float64Array) -> Float64Array:
    heading = pose[2] + curvature * travelled
    if curvature == 0.0:
        step = travelled[:, None] * np.array([math.cos(pose[2]), math.sin(pose[2])])
    else:
        step = np.column_stack([np.sin(heading) - math.sin(pose[2]), math.cos(pose[2]) - np.cos(heading)]) / curvature
    return np.column_stack([pose[:2] + step, heading])


def _words(a: float, b: float, d: float) -> Iterator[tuple[str, _Lengths]]:
    """Words that reach the end, with their lengths over the radius."""
    for word, solve in _SOLUTIONS.items():
        if (lengths := solve(a, b, d)) is not None:
            yield word, lengths


def _turn(angle: float) -> float:
    """To the left, from 0 to a whole turn [rad]; what rounding keeps from being 0 is no whole turn."""
    turn = angle % _TURN
    return 0.0 if _TURN - turn < 1e-9 else turn


def _lsl(a: float, b: float, d: float) -> _Lengths | None:
    p2 = 2.0 + d * d - 2.0 * math.cos(a - b) + 2.0 * d * (math.sin(a) - math.sin(b))
    if p2 < 1e-12:  # one arc: the direction of a straight part that has no length is rounding
        return _turn(b - a), 0.0, 0.0
    turn = math.atan2(math.cos(b) - math.cos(a), d + math.sin(a) - math.sin(b))
    return _turn(turn - a), math.sqrt(p2), _turn(b - turn)


def _lsr(a: float, b: float, d: float) -> _Lengths | None:
    p2 = -2.0 + d * d + 2.0 * math.cos(a - b) + 2.0 * d * (math.sin(a) + math.sin(b))
    if p2 < 0.0:
        return None
    p = math.sqrt(p2)
    turn = math.atan2(-math.cos(a) - math.cos(b), d + math.sin(a) + math.sin(b)) - math.atan2(-2.0, p)
    return _turn(turn - a), p, _turn(turn - b)


def _lrl(a: float, b: float, d: float) -> _Lengths | None:
    cosine = (6.0 - d * d + 2.0 * math.cos(a - b) + 2.0 * d * (math.sin(b) - math.sin(a))) / 8.0
    if abs(cosine) > 1.0:
        return None
    p = _TURN - math.acos(cosine)
    t = _turn(-a - math.atan2(math.cos(a) - math.cos(b), d + math.sin(a) - math.sin(b)) + 0.5 * p)
    return t, p, _turn(b - a - t + p)


def _mirrored(solve: Callable[[float, float, float], _Lengths | None]) -> Callable[[float, float, float], _Lengths | None]:
    """The word with left and right exchanged."""
    return lambda a, b, d: solve(-a, -b, d)


_SOLUTIONS: dict[str, Callable[[float, float, float], _Lengths | None]] = {
    "LSL": _lsl, "RSR": _mirrored(_lsl), "LSR": _lsr, "RSL": _mirrored(_lsr), "LRL": _lrl, "RLR": _mirrored(_lrl),
}  # fmt: skip
