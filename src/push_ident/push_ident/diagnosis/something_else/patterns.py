"""What something outside the catalogue could do: patterns of small forces and displacements, and how they would change the poses.

A pattern is a force on the object, a displacement of the pusher, or a factor of the friction of some cells, that follows one coordinate of
the motion: the position on the table, a heading, the order of the pushes, the time since contact, the travel, the speed, the side of the
object that is touched, or the time within each push. The derivative of the motion by a force in any step is known (`StepResponse`), so
that the change of all poses by any pattern is a product, whatever law it stands for.

Amplitudes are forces in friction limits of the whole object, torques in that times its radius of gyration, shares of the friction, and
displacements in millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.diagnosis.something_else.family import (
    Acts,
    Family,
    Rows,
    VariesWith,
    all_of,
    from_push,
    parts,
    parts_of_pushes,
    separate,
    shared,
    singles,
)  # fmt: skip
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effect import STILL
from push_ident.physics.simulation import Motion, StepResponse
from push_ident.threads import map_in_threads
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class PatternSettings:
    """Which patterns are looked for. Judgement, where no reason is given."""

    spacing: float = 0.03
    """Distance of neighbouring positions on the table [m]."""
    width: float = 0.03
    """Standard deviation of the bell over a position [m], about the size of two cells."""
    max_positions: int = 120
    """Where the pushes reach further, positions lie further apart."""
    stride: int = 4
    """Steps from one to the next for which the friction of cells by their position is computed (17 ms): less than a cell's size at any
    speed."""
    harmonics: tuple[int, ...] = (1, 2, 3, 4)
    """Of a heading."""
    decay_times: tuple[float, ...] = (0.1, 0.3, 0.9)
    """Since contact [s]."""
    decay_lengths: tuple[float, ...] = (0.005, 0.02, 0.05)
    """Of the travel [m]."""
    speeds: tuple[float, ...] = (0.01, 0.03, 0.1, 0.3)
    """Between which a function of the speed is interpolated by their logarithm [m/s]."""
    n_sides: int = 12
    """Directions from the centre of mass to the contact, object axes."""
    frequencies: tuple[float, ...] = tuple(0.75 * k + 1.0 for k in range(13))
    """Of an oscillation [Hz]. A push of 0.7 s, which is short, resolves their distance; below, it is a motion once to and fro, and
    above, few cameras see it."""
    knot_interval: float = 0.08
    """Between the knots of a function of the time within a push [s]: it follows changes up to about 4 Hz."""
    max_knots: int = 24
    """Of a push."""
    force_stds: tuple[float, ...] = (0.01, 0.03, 0.1, 0.3)
    """Prior standard deviations of a force, in friction limits of the object, and of a torque, in those times the radius of gyration
    [1]."""
    friction_stds: tuple[float, ...] = (0.1, 0.3, 1.0)
    """Prior standard deviations of a share of the friction [1]."""
    length_stds: tuple[float, ...] = (0.3, 1.0, 3.0)
    """Prior standard deviations of a displacement [mm]."""

    @property
    def radius(self) -> float:
        """Distance at which a bell over a position has fallen to an eighth [m]: what "within" means."""
        return 2 * self.width


PATTERNS: Final = PatternSettings()


@dataclass(frozen=True, slots=True)
class _Path:
    """A simulated push step by step."""

    response: StepResponse
    along: Float64Array
    """Unit vector of the motion, fading at rest, shape (n_steps, 2)."""
    speed: Float64Array
    """Of the object, rotation counted [m/s], shape (n_steps,)."""
    turning: Float64Array
    """Share of the rotation in it, signed, shape (n_steps,)."""
    radius: float
    """Of gyration of the cells [m]."""
    friction: float
    """Friction limit of the object [N]."""
    since: Float64Array
    """Time since the first contact [s], below 0 before it, shape (n_steps,)."""
    travel: Float64Array
    """Since then [m], shape (n_steps,)."""

    @classmethod
    def of(cls, response: StepResponse) -> _Path:
        arms = response.arms
        radius = float(np.sqrt(np.mean(np.sum(arms**2, axis=1))))
        velocity, turn = response.twist[:, :2], radius * response.twist[:, 2]
        speed = np.sqrt(np.sum(velocity**2, axis=1) + turn**2 + STILL**2)
        steps = np.diff(response.time, prepend=2 * response.time[0] - response.time[1])
        first = response.time[np.argmax(response.touches)] if np.any(response.touches) else np.inf
        return cls(
            response, velocity / speed[:, None], speed, turn / speed, radius, float(response.limit.sum()), response.time - first,
            np.cumsum((speed - STILL) * steps),
        )  # fmt: skip

    def motion_wrench(self) -> Float64Array:
        """Forces along and across the motion, and a torque, each of unit size while the object moves, shape (n_steps, 3, 3)."""
        x, y = self.along.T
        moves = np.sqrt(x**2 + y**2 + self.turning**2)
        wrench = np.zeros((len(x), 3, 3))
        wrench[:, 0, 0], wrench[:, 1, 0], wrench[:, 2, 0] = -x, -y, -self.radius * self.turning
        wrench[:, 0, 1], wrench[:, 1, 1] = -y, x
        wrench[:, 2, 2] = self.radius * moves
        return self.friction * wrench

    def load_wrench(self) -> Float64Array:
        """Torques of a centre of friction that moves in the object by a radius of gyration, along its axes, shape (n_steps, 3, 2)."""
        x, y, yaw = *self.along.T, self.response.pose[:, 2]
        object_x, object_y = np.cos(yaw) * x + np.sin(yaw) * y, -np.sin(yaw) * x + np.cos(yaw) * y
        wrench = np.zeros((len(x), 3, 2))
        wrench[:, 2, 0], wrench[:, 2, 1] = -object_y, object_x
        return self.friction * self.radius * wrench

    def table_wrench(self) -> Float64Array:
        """Forces along the axes of the table and a torque, while the object moves, shape (n_steps, 3, 3)."""
        moves = np.sqrt(np.sum(self.along**2, axis=1) + self.turning**2)
        return self.friction * moves[:, None, None] * np.diag([1.0, 1.0, self.radius])


@dataclass(frozen=True, slots=True)
class _Block:
    """Patterns of one push: their forces and displacements step by step."""

    wrench: Float64Array
    """Shape (n_steps, 3, n)."""
    displacement: Float64Array
    """Shape (n_steps, 2, n)."""

    @classmethod
    def forces(cls, wrench: Float64Array) -> _Block:
        return cls(wrench, np.zeros((len(wrench), 2, wrench.shape[2])))

    @classmethod
    def pusher_path(cls, displacement: Float64Array) -> _Block:
        return cls(np.zeros((len(displacement), 3, displacement.shape[2])), displacement)


def _times(wrench: Float64Array, functions: Float64Array) -> Float64Array:
    """Each pattern times each function, shapes (n_steps, 3, n) and (n_steps, m): (n_steps, 3, m n), the patterns of a function together."""
    return np.asarray(np.einsum("tip,tm->timp", wrench, functions)).reshape(len(wrench), wrench.shape[1], -1)


def pattern_families(fit: Fit) -> tuple[Family, ...] | None:
    """The change of the residuals of a fit by every pattern; None where a push cannot be simulated."""
    problem = fit.problem
    simulated = map_in_threads(partial(problem.respond, fit.x), range(len(problem.records)))
    if any(response is None for _, response in simulated):
        return None
    paths = [_Path.of(response) for _, response in simulated if response is not None]
    positions = _positions(paths)
    responses = map_in_threads(lambda push: _respond(fit, push, simulated[push][0], paths[push], positions), range(len(paths)))
    return tuple(_families(responses, positions, [_knot_times(path) for path in paths]))


def _respond(fit: Fit, push: int, motion: Motion, path: _Path, positions: Float64Array) -> dict[str, Rows]:
    """Change of the residuals of one push by every pattern."""
    problem, mechanics = fit.problem, fit.problem.mechanics_at(fit.x)[push]
    blocks = _blocks_of(path, positions, fit.problem.uses_forces)
    wrench = np.concatenate([b.wrench for b in blocks.values()], axis=2)
    displacement = np.concatenate([b.displacement for b in blocks.values()], axis=2)
    by_pose, by_impulse = path.response(wrench, displacement)
    weight = np.sqrt(problem.frame_weight(problem.residual(fit.x, motion, push)))
    whitening = weight[:, None, None] * problem.observations[push].whitening
    of_poses = np.einsum("fij,fjp->fip", whitening, by_pose).reshape(3 * len(whitening), -1)
    weight = np.sqrt(problem.frame_weight(problem.force_residual(mechanics, motion, push)))
    of_forces = weight[:, None, None] * problem.force_change(mechanics, motion, push, by_impulse)
    ends = np.cumsum([b.wrench.shape[2] for b in blocks.values()])
    parts = [np.split(rows, ends[:-1], axis=1) for rows in (of_poses, of_forces.reshape(-1, ends[-1]))]
    return dict(zip(blocks, zip(*parts, strict=True), strict=True))


def _positions(paths: Sequence[_Path]) -> Float64Array:
    """Positions on the table that an object came over, shape (n, 2)."""
    centres = np.concatenate([p.response.pose[np.append(np.maximum(_samples(p.response, 4 * PATTERNS.stride), 0), -1), :2] for p in paths])
    reach = max(float(np.max(np.linalg.norm(p.response.arms, axis=1))) for p in paths)
    low, high = centres.min(axis=0) - reach, centres.max(axis=0) + reach
    spacing = PATTERNS.spacing
    while True:
        axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        near = np.min(np.linalg.norm(grid[:, None] - centres, axis=2), axis=1) < reach
        if np.count_nonzero(near) <= PATTERNS.max_positions:
            return grid[near]
        spacing *= 1.1


def _blocks_of(path: _Path, positions: Float64Array, with_forces: bool) -> dict[str, _Block]:
    """Patterns of one push; with measured forces also friction of all cells alike, which hardly changes a slow motion."""
    motion, load, table = path.motion_wrench(), path.load_wrench(), path.table_wrench()
    acting = np.concatenate([motion, load], axis=2)
    after = np.asarray(path.since > 0.0, dtype=np.float64)
    heading = np.arctan2(path.along[:, 1], path.along[:, 0])
    first = np.column_stack([after * np.exp(-np.maximum(path.since, 0.0) / t) for t in PATTERNS.decay_times])
    first_travel = np.column_stack([np.exp(-path.travel / w) for w in PATTERNS.decay_lengths])
    by_speed = np.column_stack([np.interp(np.log(path.speed), np.log(PATTERNS.speeds), row) for row in np.eye(len(PATTERNS.speeds))])
    bells = _bells(path)
    pusher_path = np.zeros((len(bells), 2, 2)) + 1e-3 * np.eye(2)
    blocks = {
        "friction": _Block.forces(_friction_by_position(path, positions)),
        "field": _Block.forces(_field(path, positions)),
        "order_motion": _Block.forces(motion),
        "order_table": _Block.forces(table),
        "order_pusher": _Block.pusher_path(pusher_path),
        "since": _Block.forces(_times(acting, first)),
        "travel": _Block.forces(_times(acting, first_travel)),
        "speed": _Block.forces(_times(acting, by_speed)),
        "heading": _Block.forces(_times(motion, waves(heading))),
        "heading_in_object": _Block.forces(_times(motion, waves(heading - path.response.pose[:, 2]))),
        "side": _Block.pusher_path(_sides(path)),
        "time": _Block.forces(_times(table, bells)),
        "frequency": _Block.pusher_path(_times(pusher_path, _oscillations(path))),
    }
    if with_forces:
        friction = _friction_of(path, lambda steps, x, y: np.ones((*x.shape, 1)), 1)
        blocks["order_friction"] = _Block.forces(friction)
        for name, function in (("since", first), ("travel", first_travel), ("speed", by_speed)):
            blocks[f"friction_{name}"] = _Block.forces(_times(friction, function))
    return blocks


def waves(angle: Float64Array) -> Float64Array:
    """Waves of a heading [rad], higher ones weaker, shape (len(angle), n)."""
    return np.column_stack([wave(k * angle) / k for k in PATTERNS.harmonics for wave in (np.cos, np.sin)])


def _knot_times(path: _Path) -> Float64Array:
    """Knots of a function of the time while the pusher acts [s], shape (n,)."""
    acts = np.flatnonzero(path.response.touches)
    if not len(acts):
        return path.response.time[:1]
    start, end = path.response.time[acts[[0, -1]]]
    return np.linspace(start, end, int(np.clip(np.ceil((end - start) / PATTERNS.knot_interval), 1, PATTERNS.max_knots)) + 1)


def _bells(path: _Path) -> Float64Array:
    """Bells over the knots, shape (n_steps, n)."""
    knots = _knot_times(path)
    width = max(PATTERNS.knot_interval, float(knots[-1] - knots[0]) / max(1, len(knots) - 1))
    return np.asarray(np.exp(-0.5 * ((path.response.time[:, None] - knots) / width) ** 2))


def _oscillations(path: _Path) -> Float64Array:
    """Of each frequency, from the contact on, shape (n_steps, 2 n)."""
    since = np.maximum(np.nan_to_num(path.since, neginf=0.0), 0.0)
    return np.column_stack([wave(2.0 * np.pi * f * since) for f in PATTERNS.frequencies for wave in (np.cos, np.sin)])


def _friction_by_position(path: _Path, positions: Float64Array) -> Float64Array:
    """Friction of the cells within a bell over each position, shape (n_steps, 3, n_positions)."""
    pose = path.response.pose

    def near(steps: NDArray[np.int64], x: Float64Array, y: Float64Array) -> Float64Array:
        # A bell over a position is a product over the two axes, on which positions of a grid repeat.
        bell_x, bell_y = (_bells_over(arm + pose[steps, axis][:, None], positions[:, axis]) for axis, arm in ((0, x), (1, y)))
        return bell_x * bell_y

    return _friction_of(path, near, len(positions))


_Weigh = Callable[[NDArray[np.int64], Float64Array, Float64Array], Float64Array]
"""Weights of the cells in some steps, shape (n, n_cells, n_patterns), by their positions from the centre of mass, table axes."""


def _friction_of(path: _Path, weigh: _Weigh, n_patterns: int) -> Float64Array:
    """Friction of the cells times weights, shape (n_steps, 3, n_patterns)."""
    response, arms = path.response, path.response.arms
    sampled = _samples(response, PATTERNS.stride)
    moves = (sampled >= 0) & (path.speed[np.maximum(sampled, 0)] > 2.0 * STILL)
    steps = sampled[moves]
    cos, sin = np.cos(response.pose[steps, 2])[:, None], np.sin(response.pose[steps, 2])[:, None]
    x, y = cos * arms[:, 0] - sin * arms[:, 1], sin * arms[:, 0] + cos * arms[:, 1]
    turn = response.twist[steps, 2][:, None]
    vx, vy = response.twist[steps, 0][:, None] - turn * y, response.twist[steps, 1][:, None] + turn * x
    size = np.sqrt(vx**2 + vy**2 + STILL**2)
    fx, fy = -response.limit * vx / size, -response.limit * vy / size
    force = np.stack([fx, fy, x * fy - y * fx], axis=1)
    wrench = np.zeros((len(sampled), 3, n_patterns))
    wrench[moves] = np.matmul(force, weigh(steps, x, y))
    return np.repeat(wrench, PATTERNS.stride, axis=0)[-sampled[0] :][: len(response.time)]


def _samples(response: StepResponse, every: int) -> NDArray[np.int64]:
    """Every so many steps of a rollout, as numbers of the steps of its response; the first one may be below 0, where the object rests."""
    return np.arange(-(response.steps.start % every), len(response.time), every)


def _bells_over(at: Float64Array, centres: Float64Array) -> Float64Array:
    """exp(-1/2 (at - centre)^2 / width^2), shape (*at.shape, n_centres)."""
    different, number = np.unique(centres, return_inverse=True)
    return np.asarray(np.exp(-0.5 * ((at[..., None] - different) / PATTERNS.width) ** 2)[..., number])


def _field(path: _Path, positions: Float64Array) -> Float64Array:
    """Pull of the centre of mass towards each position, largest 4 cm from it, shape (n_steps, 3, n_positions)."""
    away = path.response.pose[:, None, :2] - positions
    width = np.sqrt(2.0) * PATTERNS.width
    strength = np.exp(0.5 - 0.5 * np.sum(away**2, axis=2) / width**2)
    wrench = np.zeros((len(away), 3, len(positions)))
    wrench[:, :2] = np.moveaxis(-away / width * strength[..., None], 2, 1)
    return path.friction * wrench * np.sqrt(np.sum(path.along**2, axis=1) + path.turning**2)[:, None, None]


def _sides(path: _Path) -> Float64Array:
    """Displacement of the pusher towards the centre of mass by 1 mm, by the direction of the contact in the object, (n_steps, 2, n)."""
    offset = path.response.pusher - path.response.pose[:, :2]
    direction = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-9)[:, None]
    angle = np.arctan2(offset[:, 1], offset[:, 0]) - path.response.pose[:, 2]
    at = 2.0 * np.pi * np.arange(PATTERNS.n_sides) / PATTERNS.n_sides
    bell = np.exp((np.cos(angle[:, None] - at) - 1.0) / (2.0 * np.pi / PATTERNS.n_sides) ** 2)
    return np.asarray(-1e-3 * direction[:, :, None] * bell[:, None, :])


def _families(responses: Sequence[dict[str, Rows]], positions: Float64Array, knots: Sequence[Float64Array]) -> list[Family]:
    n, sides = len(responses), 2.0 * np.pi * np.arange(PATTERNS.n_sides)[:, None] / PATTERNS.n_sides
    times = np.concatenate(
        [np.column_stack([np.full(len(knots_of_push), push), knots_of_push]) for push, knots_of_push in enumerate(knots)]
    )
    friction, field, heading, heading_in_object, side = (
        shared(responses, name) for name in ("friction", "field", "heading", "heading_in_object", "side")
    )
    (by_motion, of_3), (by_table, _), (by_tool, of_2) = (
        separate(responses, name) for name in ("order_motion", "order_table", "order_pusher")
    )
    (time, of_time), (frequency, of_frequency) = (separate(responses, name) for name in ("time", "frequency"))
    since, travel, speed = (shared(responses, name) for name in ("since", "travel", "speed"))
    n_acting = since.shape[1] // len(PATTERNS.decay_times)
    speeds = np.repeat(PATTERNS.speeds, speed.shape[1] // len(PATTERNS.speeds))[:, None]
    families = [
        Family(Acts.FRICTION, VariesWith.POINT, friction, singles(positions), PATTERNS.friction_stds, positions),
        Family(Acts.FRICTION, VariesWith.POSITION, friction, all_of(), PATTERNS.friction_stds, positions),
        Family(Acts.FORCE, VariesWith.POINT, field, singles(positions), PATTERNS.force_stds, positions),
        Family(Acts.FORCE, VariesWith.POSITION, field, all_of(), PATTERNS.force_stds, positions),
        Family(Acts.FORCE, VariesWith.FROM_PUSH, by_table, from_push(n, 3), PATTERNS.force_stds, columns_of_push=of_3),
        Family(Acts.FORCE_ON_MOTION, VariesWith.FROM_PUSH, by_motion, from_push(n, 3), PATTERNS.force_stds, columns_of_push=of_3),
        Family(Acts.PUSHER, VariesWith.FROM_PUSH, by_tool, from_push(n, 2), PATTERNS.length_stds, columns_of_push=of_2),
        Family(Acts.FORCE_ON_MOTION, VariesWith.SINCE_CONTACT, since, parts(PATTERNS.decay_times, n_acting), PATTERNS.force_stds),
        Family(Acts.FORCE_ON_MOTION, VariesWith.TRAVEL, travel, parts(PATTERNS.decay_lengths, n_acting), PATTERNS.force_stds),
        Family(Acts.FORCE_ON_MOTION, VariesWith.SPEED, speed, all_of(), PATTERNS.force_stds, speeds),
        Family(Acts.FORCE_ON_MOTION, VariesWith.HEADING, heading, all_of(), PATTERNS.force_stds),
        Family(Acts.FORCE_ON_MOTION, VariesWith.HEADING_IN_OBJECT, heading_in_object, all_of(), PATTERNS.force_stds),
        Family(Acts.PUSHER, VariesWith.SIDE, side, all_of(), PATTERNS.length_stds, sides),
        Family(Acts.FORCE, VariesWith.TIME, time, all_of(), PATTERNS.force_stds, np.repeat(times, 3, axis=0), of_time),
        Family(
            Acts.PUSHER,
            VariesWith.FREQUENCY,
            frequency,
            parts_of_pushes(PATTERNS.frequencies, 4, n),
            PATTERNS.length_stds,
            columns_of_push=of_frequency,
        ),
    ]
    if "order_friction" in responses[0]:
        by_push, columns = separate(responses, "order_friction")
        since, travel, speed = (shared(responses, name) for name in ("friction_since", "friction_travel", "friction_speed"))
        families += [
            Family(Acts.FRICTION, VariesWith.FROM_PUSH, by_push, from_push(n, 1), PATTERNS.friction_stds, columns_of_push=columns),
            Family(Acts.FRICTION, VariesWith.SINCE_CONTACT, since, parts(PATTERNS.decay_times, 1), PATTERNS.friction_stds),
            Family(Acts.FRICTION, VariesWith.TRAVEL, travel, parts(PATTERNS.decay_lengths, 1), PATTERNS.friction_stds),
            Family(Acts.FRICTION, VariesWith.SPEED, speed, all_of(), PATTERNS.friction_stds, np.array(PATTERNS.speeds)[:, None]),
        ]
    return families
