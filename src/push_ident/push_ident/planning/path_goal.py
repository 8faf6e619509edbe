"""A path that an object shall follow: poses in a row, and the speed along them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.geometry.se2 import compose, transform_points, wrap_angle
from push_ident.planning.goal import GoalCode, GoalRefusedError
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, ObjectShape

_SPACING: Final = 0.004
"""Between the poses that the path is sampled at [m]: that of the lengths of pushes in the library."""
_LEVER: Final = 0.05
"""Length of path that a turn by one radian counts as [m], so that a turn on the spot is a path as well."""


@dataclass(frozen=True, slots=True)
class PathGoal:
    """Poses joined by straight lines, the heading turning evenly between them.

    Raises:
        InputError: fewer than two poses, numbers that are not finite, no length, or a speed or tolerance that is not positive.
    """

    poses: Float64Array
    """Of the object frame in the table frame, shape (n, 3); sampled anew here, evenly."""
    speed: float = 0.05
    """Of the object along the path [m/s]."""
    position: float = 0.005
    """Distance from the path that counts as one tolerance [m]."""
    yaw: float = float(np.radians(4.0))
    """Angle to the path that counts as one tolerance [rad]."""
    along: Float64Array = field(init=False)
    """Length of path to each pose [m], shape (n,), with a turn counted at a lever of 5 cm."""
    headings: Float64Array = field(init=False)
    """Lengths of path [m] and the directions there [rad], shape (2, n); empty where it turns on the spot."""

    def __post_init__(self) -> None:
        poses = np.array(self.poses, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1:] != (3,) or len(poses) < 2 or not np.isfinite(poses).all():
            raise InputError(f"A path of shape {poses.shape} is no path: expected two poses (x, y, yaw) or more, all finite.")
        for name, unit in (("speed", "m/s"), ("position", "m"), ("yaw", "rad")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"The {name} of a path is {value}, expected a positive number [{unit}].")
        poses[:, 2] = np.unwrap(poses[:, 2])
        step = np.diff(poses, axis=0)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(np.linalg.norm(step[:, :2], axis=1), _LEVER * step[:, 2]))])
        if along[-1] < _SPACING:
            raise InputError(f"The path is {1e3 * along[-1]:.1f} mm long, expected {1e3 * _SPACING:.0f} mm or more.")
        even = np.linspace(0.0, along[-1], round(along[-1] / _SPACING) + 1)
        sampled = np.column_stack([np.interp(even, along, c) for c in poses.T])
        for name, values in (("poses", sampled), ("along", even), ("headings", _headings(sampled, even))):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @property
    def length(self) -> float:
        """Of all of it [m]."""
        return float(self.along[-1])

    @property
    def tolerance(self) -> Float64Array:
        """(x, y, yaw) [m, m, rad], shape (3,)."""
        return np.array([self.position, self.position, self.yaw])

    def at(self, lengths: ArrayLike) -> Float64Array:
        """Poses at lengths of path [m] of any shape, shape (..., 3); before its start and beyond its end those of the ends."""
        at = np.asarray(lengths, dtype=np.float64)
        return np.stack([np.interp(at, self.along, column) for column in self.poses.T], axis=-1)

    def direction(self, lengths: ArrayLike) -> Float64Array:
        """Of the path in the table frame [rad], at lengths of path of any shape; where it turns on the spot, from before to after."""
        if self.headings.shape[1] == 0:
            return np.zeros(np.shape(lengths))
        return np.asarray(np.interp(np.asarray(lengths, dtype=np.float64), *self.headings))

    def waypoints(self, spacing: float) -> Float64Array:
        """Poses that are evenly spread, at most `spacing` [m] of path apart, the end among them, the start not: shape (n, 3).

        Raises:
            InputError: a spacing that is not positive.
        """
        if not (np.isfinite(spacing) and spacing > 0):
            raise InputError(f"The spacing along the path is {spacing} m, expected a positive number.")
        n = int(np.ceil(self.length / spacing - 1e-9))
        return self.at(self.length * np.arange(1, n + 1) / n)

    def in_frame(self, frame: Float64Array) -> PathGoal:
        """The same in another frame; `frame` places this one in it, shape (3,)."""
        return self if not np.any(frame) else replace(self, poses=compose(frame, self.poses))

    def error(self, pose: Float64Array, done: float, ahead: float) -> tuple[Float64Array, Float64Array]:
        """Of poses, shape (..., 3), the length of path of the nearest point, shape (...), and distance [m] and angle [rad] from it.

        `done`: length of path that is behind [m]; `ahead`: how far beyond that poses may have come [m]. NaN poses are at the start and
        infinitely far.
        """
        # Errors of poses may go back along the path by a centimetre.
        window = (self.along >= done - 0.01) & (self.along <= done + ahead)
        poses, along = self.poses[window], self.along[window]
        flat = np.asarray(pose).reshape(-1, 3)
        known = np.asarray(np.all(np.isfinite(flat), axis=1))
        difference = np.where(known[:, None], flat, 0.0)[:, None] - poses
        error = np.stack([np.linalg.norm(difference[..., :2], axis=2), np.abs(wrap_angle(difference[..., 2]))], axis=-1)
        nearest = np.argmin(np.sum((error / [self.position, self.yaw]) ** 2, axis=2), axis=1)
        length, nearest_error = self._between(poses, along, nearest, difference[np.arange(len(flat)), nearest])
        nearest_error[~known] = np.inf
        length = np.where(known, length, done)
        shape = np.shape(pose)[:-1]
        return length.reshape(shape), nearest_error.reshape(*shape, 2)

    def _between(
        self, poses: Float64Array, along: Float64Array, nearest: np.ndarray, difference: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Length of path of the nearest point on the lines from the `nearest` of the `poses`, and distance and angle from it.

        `difference`: of each pose from its nearest one, shape (n, 3).
        """
        difference = np.column_stack([difference[:, :2], wrap_angle(difference[:, 2])])
        best, length, weight = difference, along[nearest], self.tolerance**-2.0
        for side in (-1, 1):
            other = np.clip(nearest + side, 0, len(poses) - 1)
            step = poses[other] - poses[nearest]
            share = np.clip(np.sum(weight * difference * step, axis=1) / np.maximum(np.sum(weight * step**2, axis=1), 1e-12), 0.0, 1.0)
            moved = difference - share[:, None] * step
            better = np.sum(weight * moved**2, axis=1) < np.sum(weight * best**2, axis=1)
            best = np.where(better[:, None], moved, best)
            length = np.where(better, along[nearest] + share * (along[other] - along[nearest]), length)
        return length, np.column_stack([np.linalg.norm(best[:, :2], axis=1), np.abs(best[:, 2])])


def _headings(poses: Float64Array, along: Float64Array) -> Float64Array:
    step = np.diff(poses[:, :2], axis=0)
    # Two poses within a micrometre have no direction.
    moves = np.flatnonzero(np.linalg.norm(step, axis=1) > 1e-6)
    middle = 0.5 * (along[moves] + along[moves + 1])
    return np.stack([middle, np.unwrap(np.arctan2(step[moves, 1], step[moves, 0]))])


def check_path(path: PathGoal, shape: ObjectShape, settings: PushSettings) -> None:
    """Refuse a path that cannot be followed.

    Raises:
        GoalRefusedError: it leaves the workspace, or some point of the object would be faster than the tool may be.
    """
    worst = max(settings.excess(transform_points(pose, shape.outline)) for pose in path.poses)
    if worst > 0:
        raise GoalRefusedError(
            GoalCode.OUTSIDE_WORKSPACE,
            f"on the path the object would reach {1e3 * worst:.0f} mm out of the workspace {settings.workspace} m; "
            "move or shrink the path.",
        )
    reach = float(np.max(np.linalg.norm(shape.outline, axis=1)))
    step = np.diff(path.poses, axis=0)
    straight, turned = np.linalg.norm(step[:, :2], axis=1), np.abs(step[:, 2])
    fastest = path.speed * float(np.max((straight + reach * turned) / np.hypot(straight, _LEVER * turned)))
    if fastest > settings.max_speed:
        raise GoalRefusedError(
            GoalCode.INVALID_GOAL,
            f"at {path.speed:.3f} m/s along the path the object's rim would move at {fastest:.3f} m/s, the tool at "
            f"{settings.max_speed:.3f} at most; go at {path.speed * settings.max_speed / fastest:.3f} m/s or less, or round its turns.",
        )


def read_path(file: Path, speed: float = 0.05) -> PathGoal:
    """A path from a text file: a line for each pose, `x, y, yaw` in metres and radians; empty lines and those with # are skipped.

    Raises:
        InputError: the file cannot be read, or a line is no pose; with its number.
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"Cannot read the path in {file}: {error}.") from None
    rows = [(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip() and not line.strip().startswith("#")]
    if len(rows) > 10_000:
        raise InputError(f"{file} has {len(rows)} poses, expected 10000 at most; thin them out.")
    return PathGoal(np.array([_numbers(file, number, row) for number, row in rows]).reshape(-1, 3), speed)


def _numbers(file: Path, number: int, row: str) -> Iterable[float]:
    try:
        values = [float(part) for part in row.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not np.isfinite(values).all():
        raise InputError(f"Line {number} of {file} is {row[:60]!r}, expected x, y, yaw in metres and radians, such as 0.05, -0.1, 1.57.")
    if abs(values[2]) > 2.0 * np.pi:
        raise InputError(
            f"Line {number} of {file} has the yaw {values[2]:g}, expected radians within one turn; {values[2]:g} degrees are "
            f"{np.radians(values[2]):.4g} rad."
        )
    return values
