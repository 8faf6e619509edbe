"""Many pushes of many models in one compiled call, on all cores.

A planner asks what thousands of pushes do to dozens of models that may be true. Here all of them are simulated with nothing of Python in
between; the threads share the tasks, since kernels release Python's lock. Poses only, without derivatives. Effects of a model act on its
motion; with them, tasks are shared within a model. The table may have an edge that the object overhangs. A push may begin in contact, with
the object in motion: what is asked while the tool moves. Who asks the same models again and again makes them ready once (`ModelBatch`), and
the times of their pushes too (`BatchClock`).
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from push_ident.errors import InputError
from push_ident.physics.active_effects import N_SUMS, ActiveEffects, active_effects
from push_ident.physics.body import BodyParameters, check_body, owned
from push_ident.physics.effect_values import NO_EFFECTS, EffectValues, changed_friction, driven_path
from push_ident.physics.kernel import kernel
from push_ident.physics.measurement import StepClock
from push_ident.physics.overhang import Overhang, TableEdge
from push_ident.physics.rollout import Numerics, Push, new_effect_scratch, rollout
from push_ident.physics.simulation import SimulationSettings
from push_ident.physics.tape import Frames, Tape, new_tape
from push_ident.types import Float64Array, ObjectShape, PusherPath


class BatchModel(NamedTuple):
    """A model of the object."""

    body: BodyParameters
    pusher_friction: float
    surface: float = 0.0
    """How far the surface lies outside the outline [m], as the effect `outline_error` says it."""
    weight: Float64Array | None = None
    """Of each cell as a share of the whole, shape (n_cells,); needed at an edge of the table."""
    displacement: Float64Array | None = None
    """Of the object at the start from the first pose of a push, in the frame of that pose (x, y, yaw), shape (3,): an error of the pose,
    which the path of the pusher does not follow. None: the object is there."""
    effects: EffectValues = NO_EFFECTS
    """Beside that of the surface; those that only change what is reported are left out."""


class BatchPush(NamedTuple):
    """A push, as `PushScenario` without its checks."""

    pusher: PusherPath
    pose_object_in_table: Float64Array
    """First pose, shape (3,)."""
    time: Float64Array
    """When to report the pose [s], ascending, shape (n_frames,)."""
    velocity: Float64Array | None = None
    """Of the object frame at the start (vx, vy, yaw rate) [m/s, m/s, rad/s], table frame, shape (3,). None: at rest."""


class _Models(NamedTuple):
    """Models in arrays, the first axis is the model."""

    arms: Float64Array
    """(n_models, 2, n_cells)"""
    limit: Float64Array
    """(n_models, n_cells)"""
    centre: Float64Array
    """(n_models, 2)"""
    inertia: Float64Array
    """(n_models, 3)"""
    mu: Float64Array
    """(n_models,)"""
    surface: Float64Array
    """(n_models,)"""
    displacement: Float64Array
    """(n_models, 3)"""


class _Pushes(NamedTuple):
    """Pushes in arrays, the first axis is the push; those with fewer steps are padded."""

    n_steps: np.ndarray
    """(n_pushes,)"""
    path: Float64Array
    """Of the pusher at the steps' ends, (n_pushes, max_steps + 1, 3)"""
    dt: Float64Array
    """(n_pushes, max_steps)"""
    pose: Float64Array
    """(n_pushes, 3)"""
    velocity: Float64Array
    """Of the object frame, (n_pushes, 3)"""
    step: np.ndarray
    """Of `Frames`, (n_pushes, n_frames)"""
    fraction: Float64Array
    """(n_pushes, n_frames)"""


class _Shape(NamedTuple):
    outline: Float64Array
    corners: Float64Array
    radius: float
    separate: bool


class _Range(NamedTuple):
    """Tasks that a thread takes at a time."""

    first: int
    last: int
    pushes: _Pushes
    """As these models drive them."""
    active: ActiveEffects | None
    """Of all models of the range."""


@kernel
def _roll_range(
    first: int,
    last: int,
    shape: _Shape,
    models: _Models,
    pushes: _Pushes,
    edges: Overhang | None,
    active: ActiveEffects | None,
    eps: float,
    quasi_static: bool,
    scratch: Any,
    tape: Tape,
    poses: Float64Array,
) -> None:
    """Tasks `first` to `last` of model x push; a push that fails is NaN."""
    n_pushes = pushes.pose.shape[0]
    force, first_pose = np.empty((pushes.dt.shape[1], 2)), np.empty(3)
    for task in range(first, last):
        m, p = task // n_pushes, task % n_pushes
        n = pushes.n_steps[p]
        cos, sin, moved = math.cos(pushes.pose[p, 2]), math.sin(pushes.pose[p, 2]), models.displacement[m]
        first_pose[0] = pushes.pose[p, 0] + cos * moved[0] - sin * moved[1]
        first_pose[1] = pushes.pose[p, 1] + sin * moved[0] + cos * moved[1]
        first_pose[2] = pushes.pose[p, 2] + moved[2]
        cos, sin, centre, velocity = math.cos(first_pose[2]), math.sin(first_pose[2]), models.centre[m], pushes.velocity[p]
        of_centre = (
            velocity[0] - velocity[2] * (sin * centre[0] + cos * centre[1]),
            velocity[1] + velocity[2] * (cos * centre[0] - sin * centre[1]),
            velocity[2],
        )
        push = Push(
            first_pose, pushes.path[p, : n + 1], shape.corners, shape.radius, shape.outline, models.arms[m], models.limit[m],
            models.centre[m], models.inertia[m], models.mu[m], models.surface[m], of_centre, shape.separate,
        )  # fmt: skip
        numerics = Numerics(pushes.dt[p, :n], eps, False, quasi_static, True)
        frames = Frames(pushes.step[p], pushes.fraction[p])
        if edges is None:
            failed_at, _ = rollout(push, numerics, active, None, frames, poses[m, p], force[:n], tape, scratch)
        else:
            edge = Overhang(edges.outward, edges.offset, edges.weight[m])
            failed_at, _ = rollout(push, numerics, active, edge, frames, poses[m, p], force[:n], tape, scratch)
        if failed_at >= 0:
            poses[m, p] = np.nan


def rollouts(
    shape: ObjectShape,
    models: Sequence[BatchModel],
    pushes: Sequence[BatchPush],
    *,
    step: float,
    edge: TableEdge | None = None,
    smoothing_speed: float | None = None,
    quasi_static: bool = False,
    n_threads: int | None = None,
) -> Float64Array:
    """Poses of every model under every push.

    Args:
        shape: of the object.
        models: that may be true.
        pushes: all with one pusher, and with one number of frames.
        step: longest time step [s]; the first contact is resolved within its step.
        edge: of the table; all models have a `weight` then.
        smoothing_speed: of the support friction [m/s]; by default that of `SimulationSettings`.
        quasi_static: leave inertia out.
        n_threads: by default as many as the processor has cores for this process.

    Returns:
        Poses in the table frame, shape (n_models, n_pushes, n_frames, 3); NaN where a simulation failed.

    Raises:
        InputError: nothing to simulate, a body that cannot be simulated, pushes of different pushers or numbers of frames, or models
            without weights at an edge.
    """
    _check(shape, models, pushes)
    pusher = pushes[0].pusher
    geometry = _Shape(owned(shape.outline), owned(pusher.shape.core), float(pusher.radius), pusher.fingers is not None)
    edges = None if edge is None else _edges(edge, models)
    eps = SimulationSettings().smoothing_speed if smoothing_speed is None else smoothing_speed
    prepared = _Prepared(len(shape.cells), geometry, _models(shape, models), _actives(shape, models), eps, quasi_static)
    return _roll(prepared, _pushes(pushes, step), len(pushes[0].time), edges, n_threads)


@dataclass(frozen=True, slots=True, eq=False)
class BatchClock:
    """Times that pushes of a batch have in common, made ready once."""

    clock: StepClock
    """Of the simulation."""
    frames: Frames
    """When poses are reported."""
    before: np.ndarray
    """Number of the knot before each end of a step, shape (n_steps + 1,)."""
    share: Float64Array
    """How far each end is from it to the next knot [1], shape (n_steps + 1, 1)."""

    @classmethod
    def of(cls, knots: Float64Array, frames: Float64Array, step: float) -> BatchClock:
        """For tools that are at points of their paths at `knots` [s], ascending, and poses reported at `frames` [s]; longest step [s]."""
        clock = StepClock.through(knots, max(float(frames[-1]), float(knots[-1])), step)
        before = np.clip(np.searchsorted(knots, clock.ends, side="right") - 1, 0, len(knots) - 2)
        share = np.clip((clock.ends - knots[before]) / np.diff(knots)[before], 0.0, 1.0)
        return cls(clock, clock.frames(frames)[0], before, share[:, None])

    def pushes(self, tool: Float64Array, pose: Float64Array, velocity: Float64Array) -> _Pushes:
        """Pushes as the kernel takes them; arguments as those of `ModelBatch.roll`."""
        n = len(tool)
        path = np.zeros((n, self.clock.n_steps + 1, 3))
        path[..., :2] = (1.0 - self.share) * tool[:, self.before] + self.share * tool[:, self.before + 1]
        dt, fraction = (np.tile(array, (n, 1)).astype(np.float64) for array in (self.clock.lengths, self.frames.fraction))
        step = np.tile(self.frames.step, (n, 1))
        return _Pushes(np.full(n, self.clock.n_steps), path, dt, owned(pose), owned(velocity), step, fraction)


class ModelBatch:
    """Models of one object that is pushed by a cylinder, made ready for many calls.

    Args:
        shape: of the object.
        models: that may be true.
        pusher_radius: [m].

    Raises:
        InputError: no model, or a body that cannot be simulated.
    """

    def __init__(self, shape: ObjectShape, models: Sequence[BatchModel], pusher_radius: float) -> None:
        _check_models(shape, models)
        self.shape = shape
        self.models = tuple(models)
        geometry = _Shape(owned(shape.outline), np.zeros((1, 2)), float(pusher_radius), False)
        smoothing = SimulationSettings().smoothing_speed
        self._prepared = _Prepared(len(shape.cells), geometry, _models(shape, models), _actives(shape, models), smoothing, False)

    def __len__(self) -> int:
        return len(self.models)

    def picked(self, numbers: Sequence[int]) -> ModelBatch:
        """Some of them, in the order of their `numbers`."""
        prepared, batch = self._prepared, object.__new__(ModelBatch)
        batch.shape, batch.models = self.shape, tuple(self.models[k] for k in numbers)
        models = _Models(*(array[list(numbers)] for array in prepared.models))
        batch._prepared = prepared._replace(models=models, actives=[prepared.actives[k] for k in numbers])
        return batch

    def displaced(self, displacement: Float64Array) -> ModelBatch:
        """The same with `BatchModel.displacement` of each, shape (n_models, 3)."""
        batch = object.__new__(ModelBatch)
        batch.shape, batch.models = self.shape, self.models
        batch._prepared = self._prepared._replace(models=self._prepared.models._replace(displacement=owned(displacement)))
        return batch

    def roll(self, clock: BatchClock, tool: Float64Array, pose: Float64Array, velocity: Float64Array) -> Float64Array:
        """Poses of every model under every push, shape (n_models, n_pushes, n_frames, 3); NaN where a simulation failed.

        Args:
            clock: of all pushes.
            tool: axis of the tool at its knots, table frame [m], shape (n_pushes, n_knots, 2).
            pose: of the object at the start, shape (n_pushes, 3).
            velocity: of the object frame then [m/s, m/s, rad/s], shape (n_pushes, 3).
        """
        return _roll(self._prepared, clock.pushes(tool, pose, velocity), len(clock.frames.step), None, None)


class _Prepared(NamedTuple):
    """What does not depend on the pushes."""

    n_cells: int
    geometry: _Shape
    models: _Models
    actives: list[tuple[EffectValues, ActiveEffects] | None]
    """Effects of each model on its motion; None where it has none."""
    eps: float
    quasi_static: bool


def _roll(prepared: _Prepared, pushes: _Pushes, n_frames: int, edges: Overhang | None, n_threads: int | None) -> Float64Array:
    n_models, n_pushes = len(prepared.actives), len(pushes.pose)
    poses = np.empty((n_models, n_pushes, n_frames, 3))
    n_tasks = n_models * n_pushes
    # A thread is worth starting for 16 simulations, which take some 2 ms. It takes up to 64 at a time: enough that the call costs nothing,
    # few enough that all threads end together.
    threads = min(n_threads or _n_cores(), -(-n_tasks // 16))
    remaining = deque(_ranges(prepared, pushes, min(64, -(-n_tasks // threads))))

    def roll(tasks: _Range) -> None:
        scratch, tape = None, new_tape(0)
        if tasks.active is not None:
            scratch, tape = new_effect_scratch(prepared.n_cells, tasks.active), _tape(prepared.n_cells, tasks.active)
        _roll_range(
            tasks.first, tasks.last, prepared.geometry, prepared.models, tasks.pushes, edges, tasks.active, prepared.eps,
            prepared.quasi_static, scratch, tape, poses,
        )  # fmt: skip

    def roll_remaining() -> None:
        while remaining:
            try:
                tasks = remaining.popleft()
            except IndexError:  # another thread was first
                return
            roll(tasks)

    # This thread works too: on a busy machine others may get a core only when nothing is left to be done.
    others = [_pool(threads - 1, os.getpid()).submit(roll_remaining) for _ in range(threads - 1)]
    roll_remaining()
    for other in others:
        if not other.cancel():
            other.result()
    return poses


@cache
def _n_cores() -> int:
    return len(os.sched_getaffinity(0))


@cache
def _pool(n_threads: int, process: int) -> ThreadPoolExecutor:
    """Threads that stay: to start them takes as long as some simulations. A forked process needs its own."""
    return ThreadPoolExecutor(n_threads, thread_name_prefix="rollouts")


def _check(shape: ObjectShape, models: Sequence[BatchModel], pushes: Sequence[BatchPush]) -> None:
    """Raise InputError for what `rollouts` does not simulate."""
    if not pushes:
        raise InputError("There are no pushes, expected one at least.")
    _check_models(shape, models)
    by_pusher = {(push.pusher.radius, push.pusher.fingers is None, push.pusher.shape.core.tobytes(), len(push.time)) for push in pushes}
    if len(by_pusher) > 1:
        raise InputError("The pushes of a batch differ in their pusher or in their number of frames; give them one by one.")


def _check_models(shape: ObjectShape, models: Sequence[BatchModel]) -> None:
    if not models:
        raise InputError("There are no models, expected one at least.")
    for model in models:
        check_body(shape, model.body, model.pusher_friction)


def _tape(n_cells: int, active: ActiveEffects) -> Tape:
    """A tape that keeps nothing, of the form that the effects need."""
    n_loaded, n_sums = n_cells if active.loads else 0, N_SUMS if active.shifts else 0
    return new_tape(0, n_loaded, active.n_memory, len(active.values), n_sums, skewed=active.skews)


def _actives(shape: ObjectShape, models: Sequence[BatchModel]) -> list[tuple[EffectValues, ActiveEffects] | None]:
    """Effects of each model on its motion; None for all where no model has any, since models without effects share a faster kernel."""
    if all(len(model.effects) == 0 for model in models):
        return [None] * len(models)
    actives: list[tuple[EffectValues, ActiveEffects] | None] = []
    for model in models:
        acting, arms = model.effects.of_motion, owned((shape.cells.centres - model.body.centre).T)
        no_derivative = np.zeros((len(acting), 0, 3))
        actives.append((acting, active_effects(acting, no_derivative, arms, shape.cells, 0.0)))
    return actives


def _ranges(prepared: _Prepared, pushes: _Pushes, at_once: int) -> Iterator[_Range]:
    """All tasks, at most `at_once` together; where a model has effects, those of each model by themselves."""
    n = len(pushes.pose)
    if all(effects is None for effects in prepared.actives):
        n_tasks = len(prepared.actives) * n
        yield from (_Range(first, min(first + at_once, n_tasks), pushes, None) for first in range(0, n_tasks, at_once))
        return
    for m, effects in enumerate(prepared.actives):
        assert effects is not None, "all have effects, or none"
        acting, active = effects
        driven = pushes._replace(path=_driven(acting, pushes)) if acting.move_pusher else pushes
        for first in range(m * n, (m + 1) * n, at_once):
            yield _Range(first, min(first + at_once, (m + 1) * n), driven, active)


def _driven(effects: EffectValues, pushes: _Pushes) -> Float64Array:
    """The paths that the pusher drives where those of the pushes are reported."""
    path = pushes.path.copy()
    for driven, n, dt in zip(path, pushes.n_steps, pushes.dt, strict=True):
        driven[: n + 1] = driven_path(effects, dt[:n], driven[: n + 1])[0]
    return path


def _models(shape: ObjectShape, models: Sequence[BatchModel]) -> _Models:
    bodies = [model.body for model in models]
    return _Models(
        arms=np.array([(shape.cells.centres - body.centre).T for body in bodies], order="C"),
        limit=np.array([body.limit for body in bodies]),
        centre=np.array([body.centre for body in bodies]),
        inertia=np.array([[body.mass, body.mass, body.inertia] for body in bodies]),
        mu=np.array([changed_friction(model.effects, model.pusher_friction)[0] for model in models], dtype=np.float64),
        surface=np.array([model.surface for model in models], dtype=np.float64),
        displacement=np.array([np.zeros(3) if model.displacement is None else model.displacement for model in models], dtype=np.float64),
    )


def _edges(edge: TableEdge, models: Sequence[BatchModel]) -> Overhang:
    """The edge and the weights of the cells in all models, shape (n_models, n_cells)."""
    weights = [model.weight for model in models if model.weight is not None]
    if len(weights) < len(models):
        raise InputError("A model has no weights of its cells; at an edge of the table they say who bears the load.")
    return Overhang(owned(edge.outward), float(edge.offset), owned(weights))


def _pushes(pushes: Sequence[BatchPush], step: float) -> _Pushes:
    clocks: dict[tuple[bytes, bytes], tuple[StepClock, Frames]] = {}
    each = [_clock(push, step, clocks) for push in pushes]
    n, n_frames, longest = len(pushes), len(pushes[0].time), max(clock.n_steps for clock, _ in each)
    path, dt = np.zeros((n, longest + 1, 3)), np.zeros((n, longest))
    frame_step, fraction = np.zeros((n, n_frames), dtype=np.int64), np.zeros((n, n_frames))
    for i, (push, (clock, frames)) in enumerate(zip(pushes, each, strict=True)):
        steps = slice(0, clock.n_steps + 1)
        for axis in (0, 1):
            path[i, steps, axis] = np.interp(clock.ends, push.pusher.time, push.pusher.position[:, axis])
        if push.pusher.yaw is not None:
            path[i, steps, 2] = np.interp(clock.ends, push.pusher.time, push.pusher.yaw)
        dt[i, : clock.n_steps] = clock.lengths
        frame_step[i], fraction[i] = frames.step, frames.fraction
    first = np.array([push.pose_object_in_table for push in pushes], dtype=np.float64)
    velocity = np.array([np.zeros(3) if push.velocity is None else push.velocity for push in pushes], dtype=np.float64)
    return _Pushes(np.array([clock.n_steps for clock, _ in each]), path, dt, first, velocity, frame_step, fraction)


def _clock(push: BatchPush, step: float, known: dict[tuple[bytes, bytes], tuple[StepClock, Frames]]) -> tuple[StepClock, Frames]:
    """Steps and frames of a push; pushes of a library have the same times, and share those `known`."""
    key = push.pusher.time.tobytes(), push.time.tobytes()
    if key not in known:
        clock = StepClock.through(push.pusher.time, max(float(push.time[-1]), float(push.pusher.time[-1])), step)
        known[key] = clock, clock.frames(push.time)[0]
    return known[key]
