"""Ground truth for experiments: random pushes of known objects in Bullet, stored in files, and their observation by a camera.

Motions are simulated once and stored without noise; noise is added from a seed when they are read.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.files import replaced
from push_ident.physics.kernel import extra_effect_files
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.sampling import sample_push
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PoseTrack, PusherPath, PushRecord, WrenchTrack
from push_ident_sim.code_digest import CORE, SIM, code_digest, code_of
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.injected.equations import reported_forces, times_of_forces
from push_ident_sim.injected.sensing import correlated, flipped, kept_frames, measured_at, observed_poses
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object

_LARGE_TABLE = (-0.6, 0.6, -0.6, 0.6)
_ARRAYS = ("time", "pose", "pusher", "force")
_REPORTED = "reported"
"""One more array, in files of pushes whose pusher is not at its reported place."""


def _paper_pushes() -> PushSettings:
    return PushSettings(
        workspace=_LARGE_TABLE,
        pusher_radius=0.008,
        clearance=0.02,
        distance_range=(0.06, 0.10),
        speed_range=(0.1, 0.2),
        cone=float(np.radians(40.0)),
    )


@dataclass(frozen=True, slots=True)
class TruthSettings:
    """How pushes are drawn and simulated."""

    n_train: int = 8
    n_test: int = 12
    """As in the paper."""
    pushes: PushSettings = field(default_factory=_paper_pushes)
    time_step: float = 1.0 / 240.0
    """Of the engine [s]."""
    start_range: float = 0.15
    """First positions of the object lie within this distance of the middle of the table along x and y [m]; its yaw is uniform."""
    acceleration: float = 2.0
    """Of the pusher at the start and at the end of a push [m/s^2]."""
    min_travel: float = 0.010
    min_turn: float = 0.1
    """A push that moves the object's frame by less than this [m] and turns it by less than this [rad] is drawn again."""
    effects: InjectedEffects = field(default_factory=InjectedEffects)
    """Injected into the simulation and into its observation."""


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """Noise and rates of a camera and of a force sensor."""

    position_std: float = 1e-3
    """Of x and y, independent from frame to frame [m]."""
    yaw_std: float = float(np.radians(0.5))
    """[rad]"""
    rate: float = 30.0
    """[Hz]"""
    rest: float = 0.4
    """Frames are recorded for this long before and after the motion [s]."""
    force_std: float | None = None
    """Standard deviation of the measured force [N]; None: there is no force sensor."""
    force_rate: float = 120.0
    """[Hz]"""


class Engine(Protocol):
    """What simulates one push: `PushWorld` or `PlanarWorld`."""

    def push(self, pose_object_in_table: ArrayLike, path: PusherPath, *, pushes_done: int = 0) -> TrueMotion:
        """Put the object down at (x, y, yaw) and lead the pusher along `path`."""
        ...


def true_model(sim_object: SimObject) -> ObjectModel:
    """The true model of a simulated object, which identification should find."""
    shape = ObjectShape(CellGrid(sim_object.cells, sim_object.cell_size), sim_object.outline)
    return ObjectModel(shape, sim_object.mass, sim_object.friction, sim_object.pusher_friction)


def make_pushes(
    sim_object: SimObject,
    seed: Sequence[int],
    settings: TruthSettings | None = None,
    *,
    in_a_row: bool = False,
    engine: Engine | None = None,
) -> list[TrueMotion]:
    """Random pushes as in the paper: any pose on the table, contact uniform over the outline, direction in a cone about its normal.

    Gives `settings.n_train + settings.n_test` motions. Push number i depends only on the integers >= 0 of `seed` and on i. With `in_a_row`
    the object is placed once, at (0, 0, 0), and each push starts where the last one ended. `engine`: Bullet by default.
    """
    settings = settings or TruthSettings()
    if engine is not None:
        return _make_each(engine, sim_object, seed, settings, in_a_row)
    # Imported here, so that reading pushes and drawing results does not need Bullet.
    from push_ident_sim.engines.bullet.push_world import PushWorld

    world = PushWorld(sim_object, settings.pushes.pusher_radius, time_step=settings.time_step, effects=settings.effects)
    try:
        return _make_each(world, sim_object, seed, settings, in_a_row)
    finally:
        world.close()


def _make_each(engine: Engine, sim_object: SimObject, seed: Sequence[int], settings: TruthSettings, in_a_row: bool) -> list[TrueMotion]:
    shape = true_model(sim_object).shape
    motions: list[TrueMotion] = []
    for i in range(settings.n_train + settings.n_test):
        pose = (motions[-1].pose[-1] if motions else np.zeros(3)) if in_a_row else None
        motions.append(_one_push(engine, shape, [*seed, i], i, settings, pose))
    return motions


def _one_push(
    world: Engine, shape: ObjectShape, seed: Sequence[int], number: int, settings: TruthSettings, pose: Float64Array | None
) -> TrueMotion:
    rng = np.random.default_rng(seed)
    while True:
        start = pose
        if start is None:
            start = np.array([*rng.uniform(-settings.start_range, settings.start_range, 2), rng.uniform(-np.pi, np.pi)])
        plan = sample_push(shape, start, rng, settings.pushes)
        motion = world.push(start, path_of_plan(plan, settings), pushes_done=number)
        moved = np.abs(motion.pose[-1] - motion.pose[0])
        if np.hypot(moved[0], moved[1]) >= settings.min_travel or moved[2] >= settings.min_turn:
            return motion


def path_of_plan(plan: PushPlan2D, settings: TruthSettings) -> PusherPath:
    """Straight path with constant acceleration at both ends, sampled at each time step."""
    length = settings.pushes.clearance + plan.distance
    speed = min(plan.speed, float(np.sqrt(settings.acceleration * length)))
    ramp = speed / settings.acceleration
    total = length / speed + ramp
    time = np.append(np.arange(0.0, total, settings.time_step), total)
    speeding_up = 0.5 * settings.acceleration * np.minimum(time, ramp) ** 2
    cruise = speed * np.clip(time - ramp, 0.0, total - 2 * ramp)
    slowing = np.clip(time - (total - ramp), 0.0, ramp)
    travel = speeding_up + cruise + speed * slowing - 0.5 * settings.acceleration * slowing**2
    return PusherPath(time, plan.tool_start(settings.pushes.clearance) + travel[:, None] * plan.heading, settings.pushes.pusher_radius)


# --- files ---------------------------------------------------------------------------------------------------------------


def truth_file(folder: Path, name: str, seed: int, settings: TruthSettings | None = None) -> Path:
    """File of the pushes of `make_object(name, seed)`; its name differs for other settings, another object or other code."""
    sim_object = make_object(name, seed)
    values = [
        sim_object.cells,
        sim_object.height,
        sim_object.mass,
        sim_object.friction,
        np.array([sim_object.cell_size, sim_object.pusher_friction]),
    ]
    by_equation = {file for file in extra_effect_files() if settings is not None and file.stem in settings.effects.as_dict()}
    of_sim = code_of(SIM, ("engines", "injected", "objects.py", "recordings/truth.py"))
    code = code_digest(of_sim | code_of(CORE, ("geometry", "physics", "pushing")) | by_equation)
    content = json.dumps([code, asdict(settings or TruthSettings())], sort_keys=True).encode() + b"".join(v.tobytes() for v in values)
    return folder / f"{name}-{seed:04d}-{hashlib.sha256(content).hexdigest()[:12]}.npz"


def generate_truth(folder: Path, name: str, seed: int, settings: TruthSettings | None = None) -> Path:
    """Simulate the pushes of `make_object(name, seed)` into `folder`, unless they exist.

    The file appears complete or not at all. Raises PushIdentError where it cannot be written.
    """
    path = truth_file(folder, name, seed, settings)
    if path.exists():
        return path
    motions = make_pushes(make_object(name, seed), [seed, OBJECT_NAMES.index(name)], settings)
    keys = _ARRAYS if all(m.reported is m.pusher for m in motions) else (*_ARRAYS, _REPORTED)
    arrays = {key: np.concatenate([getattr(m, key) for m in motions]) for key in keys}
    with replaced(path, "the pushes") as file:
        np.savez_compressed(file, allow_pickle=False, n_rows=np.array([len(m.time) for m in motions]), **arrays)
    return path


def _read_motions(path: Path) -> list[TrueMotion]:
    try:
        with np.load(path, allow_pickle=False) as file:
            ends = np.cumsum(file["n_rows"])[:-1]
            columns = {key: np.split(file[key], ends) for key in _ARRAYS}
            columns[_REPORTED] = np.split(file[_REPORTED], ends) if _REPORTED in file else columns["pusher"]
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise InputError(f"Cannot read the pushes in {path}: {error}; delete the file to simulate them again.") from None
    return [TrueMotion(**dict(zip(columns, arrays, strict=True))) for arrays in zip(*columns.values(), strict=True)]


def load_truth(
    folder: Path, name: str, seed: int, settings: TruthSettings | None = None, noise: CameraNoise | None = None
) -> tuple[list[PushRecord], list[PushRecord], SimObject]:
    """Training pushes, test pushes and the truth of `make_object(name, seed)`; they are simulated first where `folder` has none.

    `seed`: of the object, its pushes and their noise; `noise`: of their observation.
    """
    settings, noise = settings or TruthSettings(), noise or CameraNoise()
    sim_object = make_object(name, seed)
    motions = _read_motions(generate_truth(folder, name, seed, settings))
    shape = true_model(sim_object).shape
    radius, number = settings.pushes.pusher_radius, OBJECT_NAMES.index(name)
    records = []
    for i, motion in enumerate(motions):
        observed = observe_motion(motion, radius, noise, np.random.default_rng([seed, number, i, 1]), settings.effects)
        records.append(PushRecord(name, shape, *observed, f"{name} {seed}, push {i}"))
    return records[: settings.n_train], records[settings.n_train :], sim_object


def observe_motion(
    motion: TrueMotion, radius: float, noise: CameraNoise, rng: np.random.Generator, effects: InjectedEffects | None = None
) -> tuple[PoseTrack, PusherPath, WrenchTrack | None]:
    """The sensors' record of a true motion; before and after it everything is at rest. `radius` of the pusher [m]; effects on poses and
    camera act here.
    """
    effects = effects or InjectedEffects()
    # A generator of its own, so that lost frames do not change the noise.
    frame_rng = rng.spawn(1)[0]
    rest, end = noise.rest, float(motion.time[-1])
    clock = np.concatenate([[0.0], rest + motion.time, [2 * rest + end]])
    hold = np.r_[0, 0 : len(motion.time), len(motion.time) - 1]

    def at(time: Float64Array, values: Float64Array) -> Float64Array:
        return np.column_stack([np.interp(time, clock, column) for column in values[hold].T])

    frames = np.arange(0.0, clock[-1], 1.0 / noise.rate)
    std = np.array([noise.position_std, noise.position_std, noise.yaw_std])
    observed = observed_poses(effects, at(measured_at(effects, frames), motion.pose))
    observed = observed + std * correlated(effects, rng.normal(size=(len(frames), 3)))
    observed = flipped(effects, observed, frame_rng)
    kept = kept_frames(effects, len(frames), frame_rng)
    poses = PoseTrack(frames[kept], observed[kept], np.broadcast_to(np.diag(std**2), (int(kept.sum()), 3, 3)))
    wrench = None
    if noise.force_std is not None:
        # The sensor averages over its sampling time: a difference of the impulse so far.
        steps = np.diff(motion.time, prepend=0.0)
        impulse = np.cumsum(motion.force * steps[:, None], axis=0)
        bounds = np.arange(0.0, clock[-1], 1.0 / noise.force_rate)
        force = np.diff(at(times_of_forces(effects, bounds), impulse), axis=0) * noise.force_rate
        wrench = WrenchTrack(bounds[1:], reported_forces(effects, force) + noise.force_std * rng.normal(size=force.shape))
    return poses, PusherPath(clock, motion.reported[hold], radius), wrench
