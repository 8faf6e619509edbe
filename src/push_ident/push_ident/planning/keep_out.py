"""What a push must not touch, how surely it does not, and the way round it.

Outlines of obstacles are given with the clearance that the uncertainty of their place asks for. On top of it an object and its pushes are
uncertain themselves: a push is made only where the chance that the object enters an outline, by the models that may be true, is at most
`RISK`.

The way round is found on a grid of poses (x, y, yaw): the shortest way to the goal of each pose, over poses at which the object enters no
outline. Its length above that of the way without obstacles is `WayRound.extra`; the planner adds it to the way that is left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.special import ndtr

from push_ident.geometry.distance_field import RESOLUTION, DistanceField
from push_ident.geometry.outline import dense, signed_distance
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.physics.kernel import kernel
from push_ident.planning.goal import Goal
from push_ident.planning.obstacle import Obstacle
from push_ident.pushing.push import PushSettings
from push_ident.types import BoolArray, CellGrid, Float64Array, ObjectShape

_FAR: Final = 0.05
"""Distance of an object from all obstacles above which a lower bound of it is enough [m]."""
_BETWEEN: Final = 8
"""Poses at which the object is compared with obstacles, from each simulated one to the next [1]: 2.5 mm apart in the longest push."""
_SPACING: Final = 0.01
"""Of points along the outline of the object beside its corners [m]: nothing thinner crosses it unnoticed."""


class KeepOut:
    """Distances of one object and of the tool from obstacles.

    Args:
        outlines: of the obstacles, at least one, each of shape (n_vertices, 2), in the frame of the poses [m]; what of them is further from
            the workspace than the object reaches does not count.
    """

    def __init__(self, shape: ObjectShape, outlines: Sequence[Float64Array], settings: PushSettings) -> None:
        x_min, x_max, y_min, y_max = settings.workspace
        low, high = np.array([x_min, y_min]), np.array([x_max, y_max])
        self._outline, self._settings = dense(shape.outline, _SPACING), settings
        self._reach = float(np.max(np.linalg.norm(shape.outline, axis=1)))
        self.lever = float(np.sqrt(np.mean(np.sum(shape.outline**2, axis=1))))
        """Root mean square distance of the corners of the object from its origin [m]."""
        self._around = DistanceField.of(outlines, low - self._reach, high + self._reach)
        self._within = DistanceField.of([shape.outline], np.full(2, -self._reach - 2 * _FAR), np.full(2, self._reach + 2 * _FAR))
        self._corners = np.concatenate(outlines)

    def gaps(self, poses: Float64Array) -> Float64Array:
        """Distance of the object from the obstacles at poses, shape (..., 3): shape (...) [m], negative where it enters one; -inf for a
        pose that is not finite. Above 5 cm it is a lower bound."""
        flat = np.ascontiguousarray(poses, dtype=np.float64).reshape(-1, 3)
        found, around, within = np.empty(len(flat)), self._around, self._within
        fields = (around.distance, around.low, around.size), (within.distance, within.low, within.size)
        _gaps(flat, *fields, self._outline, self._corners, self._reach, found)
        return found.reshape(np.shape(poses)[:-1])

    def tool_gaps(self, tool: Float64Array) -> Float64Array:
        """Distance of the tool from the obstacles with its axis at points, shape (..., 2): shape (...) [m]."""
        return self._around.at(tool) - self._settings.pusher_radius

    def is_tool_clear(self, start: Float64Array, path: Float64Array) -> BoolArray:
        """Whether the tool can be lowered at `start`, shape (..., n, 2), along all of it, and be moved along points, shape
        (..., n_points, 2): shape (..., n_points), for the path up to each point."""
        lowered = np.min(self.tool_gaps(start), axis=-1) >= self._settings.lowering_gap
        return np.asarray(lowered[..., None] & (np.minimum.accumulate(self.tool_gaps(path), axis=-1) >= 0.0))

    def risk(self, poses: Float64Array) -> Float64Array:
        """Chance that the object enters an obstacle during pushes, by poses under models, shape (n_models, ..., n_poses, 3), the first one
        before the push: shape (...)."""
        return risk_of(np.min(self.gaps(_between(poses, _BETWEEN)), axis=-1), self.gaps(poses[..., 0, :]))


def risk_of(least: Float64Array, now: Float64Array, std: float | Float64Array = 0.0) -> Float64Array:
    """Chance that an object enters an obstacle, from its least distance during pushes under models [m], shape (n_models, ...): (...).

    `now`: its distance before them [m], of a shape that fits; where it is nearer than its clearance, it may stay as near. `std`: deviation
    of the least distance beside that over the models [m], shape (...).
    """
    finite = np.all(np.isfinite(least), axis=0)
    # A push that leads away, or along, enters nothing, however near the object lies: only models that come nearer count.
    nearer = np.where(np.isfinite(least), least < now - RESOLUTION, True)
    room = np.where(nearer & np.isfinite(least), least - np.minimum(now, 0.0), 0.0)
    n, of = np.sum(nearer, axis=0), np.maximum(np.sum(nearer, axis=0), 1)
    mean = np.sum(room, axis=0) / of
    deviation = np.sqrt(np.sum(np.where(nearer, room - mean, 0.0) ** 2, axis=0) / of)
    spread = np.hypot(np.hypot(deviation, std), 0.5 * RESOLUTION)
    # Few models have no tail of their own: that of a normal distribution, or the models themselves where these are worse.
    chance = np.maximum(n / len(least) * ndtr(-mean / spread), np.mean(nearer & (room < -RESOLUTION), axis=0))
    return np.asarray(np.where(finite, chance, 1.0))


def distance_between(one: Float64Array, other: Float64Array) -> float:
    """Least distance of two outlines, each of shape (n, 2) [m]; negative where they overlap."""
    near = (np.min(signed_distance(dense(line, _SPACING), of)) for line, of in ((one, other), (other, one)))
    return float(min(near))


def overlapping(outline: Float64Array, poses: Float64Array, obstacles: Sequence[Obstacle]) -> list[str]:
    """Names of the obstacles that an outline, shape (n, 2), object frame, enters at one of some poses, shape (n_poses, 3)."""
    placed = transform_points(np.reshape(poses, (-1, 3)), outline)
    return [one.name for one in obstacles if any(distance_between(each, one.outline) < 0.0 for each in placed)]


@kernel
def _at(field: tuple[NDArray[np.float32], Float64Array, float], x: float, y: float) -> float:
    """As `DistanceField.at`."""
    distance, low, size = field
    rows, columns = distance.shape
    row, column = round((y - low[1]) / size), round((x - low[0]) / size)
    return float(distance[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)])


@kernel
def _gaps(
    poses: Float64Array,
    around: tuple[NDArray[np.float32], Float64Array, float],
    within: tuple[NDArray[np.float32], Float64Array, float],
    outline: Float64Array,
    corners: Float64Array,
    reach: float,
    found: Float64Array,
) -> None:
    """Fill `found`, shape (n,), for poses, shape (n, 3): see `KeepOut.gaps`."""
    for k in range(len(poses)):
        x, y, yaw = poses[k]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(yaw)):
            found[k] = -math.inf
            continue
        least = _at(around, x, y) - reach
        if least < _FAR:
            # Of two polygons that do not overlap, a corner of one is where they are nearest; the other points find those that cross.
            cosine, sine, least = math.cos(yaw), math.sin(yaw), math.inf
            for u, v in outline:
                least = min(least, _at(around, x + cosine * u - sine * v, y + sine * u + cosine * v))
            for px, py in corners:
                u, v = px - x, py - y
                least = min(least, _at(within, cosine * u + sine * v, cosine * v - sine * u))
        found[k] = least


def compile_keep_out() -> None:
    """Compile the kernels, or load them."""
    square = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])
    KeepOut(ObjectShape(CellGrid(np.zeros((1, 2)), 0.02), square), [square], PushSettings()).gaps(np.zeros((1, 3)))


def _between(poses: Float64Array, n: int) -> Float64Array:
    """`n` poses from each to the next along the second to last axis, shape (..., m, 3): shape (..., (m - 1) n, 3), the first left out."""
    share = (np.arange(n) + 1.0) / n
    step = np.diff(poses, axis=-2)
    step[..., 2] = wrap_angle(step[..., 2])
    all_of = poses[..., :-1, None, :] + share[:, None] * step[..., None, :]
    return np.asarray(all_of.reshape(*poses.shape[:-2], -1, 3))


_CELLS_ALONG: Final = 80
"""Largest number of cells along a side of the workspace [1]."""
_STEP: Final = 0.01
"""Spacing of the grid of poses where that allows it [m]: half the default tolerance of a goal."""
_HEADINGS: Final = 24
"""Headings of the grid [1]: 15 degrees apart, a corner at 8 cm moves by 2 cm."""
_NOWHERE: Final = 1e3
"""Length of a way that does not exist [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class WayRound:
    """Shortest ways to one goal on a grid of poses."""

    low: Float64Array
    """Position of the first pose [m], shape (2,)."""
    step: float
    """Spacing of positions [m]."""
    longer: NDArray[np.float32] = field(repr=False)
    """Length of the way above that without obstacles [m], shape (n_x, n_y, n_headings + 1): the last heading is the first one again."""

    @classmethod
    def to(cls, goal: Goal, keep_out: KeepOut, shape: ObjectShape, settings: PushSettings, room: float) -> WayRound | None:
        """The ways to a goal; None where its surroundings are not connected with any other pose.

        `room`: distance from obstacles in which pushes of usual length are possible [m]. Where there is less, they are shorter, and
        the way counts by as much more.
        """
        x_min, x_max, y_min, y_max = settings.workspace
        step = max(_STEP, max(x_max - x_min, y_max - y_min) / _CELLS_ALONG)
        x, y = np.arange(x_min, x_max + step, step), np.arange(y_min, y_max + step, step)
        yaw = 2 * np.pi * np.arange(_HEADINGS) / _HEADINGS
        poses = np.stack(np.meshgrid(x, y, yaw, indexing="ij"), axis=-1)
        gaps = keep_out.gaps(poses)
        free = (gaps > 0.0) & _is_inside(shape.outline, poses, settings)
        turn = goal.position / goal.yaw
        offset = poses - goal.pose
        offset[..., 2] = wrap_angle(offset[..., 2])
        away = np.linalg.norm(offset * [1.0, 1.0, turn], axis=-1)
        at_goal = np.unravel_index(np.argmin(np.where(free, away, np.inf)), free.shape)
        if not free[at_goal] or away[at_goal] > 3.0 * step + turn * 2 * np.pi / _HEADINGS:
            return None
        weight = np.maximum(1.0, room / np.maximum(gaps, RESOLUTION))
        length = _lengths(free, weight, np.array([step, turn * 2 * np.pi / _HEADINGS]), np.ravel_multi_index(at_goal, free.shape))
        dx, dy, dyaw = np.moveaxis(np.abs(poses - poses[at_goal]), -1, 0)
        plain = np.maximum(dx, dy) + (np.sqrt(2.0) - 1.0) * np.minimum(dx, dy) + turn * np.abs(wrap_angle(dyaw))
        longer = np.where(np.isfinite(length), np.maximum(length - plain, 0.0), _NOWHERE)
        if np.count_nonzero(longer < _NOWHERE) < 2:
            return None
        return cls(np.array([x[0], y[0]]), step, _filled(longer, free))

    def extra(self, poses: Float64Array) -> Float64Array:
        """Length of the way from poses, shape (..., 3), above that without obstacles [m], shape (...); inf where there is no way, or the
        pose is not finite."""
        finite: BoolArray = np.all(np.isfinite(poses), axis=-1)
        safe = np.where(finite[..., None], poses, 0.0)
        at = (safe[..., :2] - self.low) / self.step
        heading = np.mod(safe[..., 2], 2 * np.pi) / (2 * np.pi) * _HEADINGS
        where = np.stack([at[..., 0], at[..., 1], heading]).reshape(3, -1)
        found = map_coordinates(self.longer, where, order=1, mode="nearest").reshape(finite.shape)
        return np.asarray(np.where(finite & (found < 0.01 * _NOWHERE), found, np.inf), dtype=np.float64)


def _is_inside(outline: Float64Array, poses: Float64Array, settings: PushSettings) -> BoolArray:
    """Whether an outline, shape (n, 2), is in the workspace at poses of a grid, shape (n_x, n_y, n_headings, 3)."""
    x_min, x_max, y_min, y_max = settings.workspace
    inside = np.empty(poses.shape[:3], dtype=np.bool_)
    for k in range(poses.shape[2]):
        at = transform_points(np.array([0.0, 0.0, poses[0, 0, k, 2]]), outline)
        low, high = poses[:, :, k, :2] + at.min(axis=0), poses[:, :, k, :2] + at.max(axis=0)
        inside[:, :, k] = np.all((low >= [x_min, y_min]) & (high <= [x_max, y_max]), axis=-1)
    return inside


def _lengths(free: BoolArray, weight: Float64Array, steps: Float64Array, goal: np.intp) -> Float64Array:
    """Length of the shortest way between each free pose of a grid and the goal [m], inf where there is none, of the shape of `free`.

    Neighbours differ by one step along x, y or both, or by one heading; `steps`: [m] of a position and of a heading.
    """
    number, goes_down = np.arange(free.size).reshape(free.shape), slice(None, -1)
    all_of, after = slice(None), slice(1, None)
    moves = [((goes_down, all_of), (after, all_of)), ((all_of, goes_down), (all_of, after))]
    moves += [((goes_down, goes_down), (after, after)), ((goes_down, after), (after, goes_down))]
    pairs = [(number[here].ravel(), number[there].ravel()) for here, there in moves]
    pairs.append((number.ravel(), np.roll(number, -1, axis=2).ravel()))
    root = float(np.sqrt(2.0)) * steps[0]
    along = np.concatenate(
        [np.full(len(pair[0]), length) for pair, length in zip(pairs, (steps[0], steps[0], root, root, steps[1]), strict=True)]
    )
    row, column = (np.concatenate(part) for part in zip(*pairs, strict=True))
    joined = free.ravel()[row] & free.ravel()[column]
    row, column = row[joined], column[joined]
    length = along[joined] * 0.5 * (weight.ravel()[row] + weight.ravel()[column])
    both = np.concatenate([row, column]), np.concatenate([column, row])
    graph = csr_array((np.tile(length, 2), both), shape=(free.size, free.size))
    return np.asarray(dijkstra(graph, indices=int(goal))).reshape(free.shape)


def _filled(longer: Float64Array, free: BoolArray) -> NDArray[np.float32]:
    """The same with the value of the nearest free pose where there is none, and the first heading once more at the end."""
    repeated = np.concatenate([longer, longer[:, :, :1]], axis=2)
    blocked = ~np.concatenate([free, free[:, :, :1]], axis=2)
    nearest = distance_transform_edt(blocked, return_distances=False, return_indices=True)
    return np.asarray(repeated[tuple(nearest)], dtype=np.float32)
