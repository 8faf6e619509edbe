"""The push to make next: the one after which other pushes would be predicted best.

Around a model z, the frames of a push depend linearly on the unknowns, with the noise that the fit assumes. The posterior covariance S
after the push then does not depend on its outcome, and is known before the push:

    S' = (S^-1 + H(z))^-1            H: expected contribution of the push to the Hessian of the fit, its own first pose marginalised
    error(S) = mean over reference pushes of sqrt(tr(Q G S G')),   G = d(last pose) / dz,   Q: mean square over the cells

The push with the least error(S') is Bayesian A-optimal, not for the maps but for their purpose, predictions (Chaloner and Verdinelli,
Bayesian Experimental Design, 1995).

A linearisation describes one side of a switch only (stick or slip, left or right of the centre of friction). So H and G are taken at
several draws from the posterior as well as at its mean, and the criteria are averaged over them. A model for which the simulation of a
push fails, or chatters, counts as one to which that push adds nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from push_ident.errors import InputError, PlanningError, PushIdentError
from push_ident.geometry.cells import cell_displacement
from push_ident.identification.fitting.problem import RunAll
from push_ident.identification.observing.observation import NoiseModel, Observation, observe_push
from push_ident.identification.results.posterior import ModelPosterior, lower_root, square_root
from push_ident.identification.unknowns.mechanics import Mechanics, mechanics_at
from push_ident.pages.tables import html_table
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import Motion, SimulationSettings
from push_ident.physics.tape import Param
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.sampling import sample_push
from push_ident.types import CellGrid, Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord, SolveStatus, short_repr

CHATTER = 10.0
"""Largest derivative of the last pose by the first one [-]. It is 1 to 8 in ordinary pushes. Where it is larger, the motion chatters
between modes of contact: its derivative, though exact, holds over micrometres only and predicts no observation."""
N_CANDIDATES = 40
"""Random pushes of which the best is proposed: one of the best tenth is among them with a probability of 0.985."""


class UnwantedError(PushIdentError):
    """Work was stopped before its end because nobody wants its result any more."""


@dataclass(frozen=True, slots=True)
class PlannedPush:
    """A possible push."""

    __repr__ = short_repr

    pose_object_in_table: Float64Array
    """Of the object before the push, shape (3,)."""
    pusher: PusherPath
    plan: PushPlan2D | None = None
    """The plan behind the path, for the arm."""

    def __post_init__(self) -> None:
        _freeze(self, "pose_object_in_table", (3,))


@dataclass(frozen=True, slots=True)
class PoseSensor:
    """A sensor of poses."""

    rate: float = 30.0
    """Frames per second [Hz]."""
    covariance: Float64Array = field(default_factory=lambda: np.diag([1e-3, 1e-3, np.radians(0.5)]) ** 2)
    """Of one pose (x, y, yaw), shape (3, 3), table frame."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise InputError(f"PoseSensor.rate is {self.rate}, expected a positive number of frames per second.")
        _freeze(self, "covariance", (3, 3))


@dataclass(frozen=True, slots=True)
class PushValue:
    """Expected value of one candidate."""

    __repr__ = short_repr

    push: PlannedPush
    status: SolveStatus
    """CONVERGED; candidates with NO_CONTACT or SIMULATION_FAILED add no information and rank last."""
    error_after: float
    """Expected cell error of the reference pushes after a fit to this push [m]."""
    covariance: Float64Array
    """Of the unknowns after this push, linearised at the mean, shape (n_unknowns, n_unknowns)."""


@dataclass(frozen=True, slots=True)
class RankedPushes:
    """Candidates, the best first."""

    __repr__ = short_repr

    values: tuple[PushValue, ...]
    error_before: float
    """Expected cell error of the reference pushes before any candidate [m]."""

    @property
    def best(self) -> PlannedPush | None:
        """The push to make; None where no candidate would add information."""
        first = self.values[0]
        return first.push if first.status is SolveStatus.CONVERGED else None


def candidate_pushes(
    shape: ObjectShape,
    pose_object_in_table: ArrayLike,
    rng: np.random.Generator,
    n: int,
    settings: PushSettings,
    obstacles: Sequence[Float64Array] = (),
    *,
    acceleration: float = np.inf,
) -> list[PlannedPush]:
    """`n` random safe pushes of an object at its present pose, shape (3,).

    `obstacles`: outlines of other objects, table frame [m], each of shape (n_vertices, 2); `acceleration`: of the pusher at both ends of
    its path [m/s^2], by default it has its speed at once, which makes no difference where only friction decides.

    Raises:
        PlanningError: UNREACHABLE where no push is safe.
    """
    pose = np.array(pose_object_in_table, dtype=np.float64)
    plans = [sample_push(shape, pose, rng, settings, obstacles) for _ in range(n)]
    return [PlannedPush(pose, _pusher_path(plan, settings, acceleration), plan) for plan in plans]


def reference_pushes(shape: ObjectShape, rng: np.random.Generator, n: int, settings: PushSettings | None = None) -> list[PlannedPush]:
    """Random pushes over the whole outline of an object with free space around it: a fair sample of the pushes to predict.

    The workspace of `settings` does not count.
    """
    anywhere = replace(settings or PushSettings(), workspace=(-np.inf, np.inf, -np.inf, np.inf))
    return candidate_pushes(shape, np.zeros(3), rng, n, anywhere)


@dataclass(frozen=True, slots=True)
class RankingOptions:
    """How candidates are ranked."""

    n_draws: int = 1
    """Models drawn from the posterior, beside its mean; more make a steadier order at proportional cost."""
    sensor: PoseSensor = field(default_factory=PoseSensor)
    """That would observe the push."""
    noise: NoiseModel | None = None
    """Of the observed poses, as the fit will assume it."""
    numerics: SimulationSettings = field(default_factory=lambda: SimulationSettings(step=1 / 120))
    """Of the simulation; coarser than in a fit, since the value of a push needs no more."""
    run_all: RunAll = map
    """How the pushes are simulated. In parallel, `is_wanted` is asked before all of them only."""

    def __post_init__(self) -> None:
        if self.n_draws < 0:
            raise InputError(f"n_draws is {self.n_draws}, expected 0 (only the mean) or more.")


def rank_pushes(
    posterior: ModelPosterior,
    candidates: Sequence[PlannedPush],
    *,
    reference: Sequence[PlannedPush],
    rng: np.random.Generator,
    options: RankingOptions | None = None,
    is_wanted: Callable[[], bool] = lambda: True,
) -> RankedPushes:
    """The candidates by what they are expected to add to the knowledge of an object; last those that would fail or touch nothing.

    `reference`: pushes that are to be predicted well, see `reference_pushes`; `rng`: of the draws from the posterior; `is_wanted`: asked
    before each push is simulated, so that the processor is free at once for more urgent work.

    Raises:
        InputError: no candidate, or no reference push that moves the object.
        UnwantedError: it is no longer wanted.
    """
    options = options or RankingOptions()
    if not candidates:
        raise InputError("There is no candidate to rank; give at least one push.")
    scale = square_root(posterior.covariance)
    draws = posterior.z + rng.standard_normal((options.n_draws, len(posterior.z))) @ scale.T
    possible = [mechanics_at(posterior.unknowns, z) for z in (posterior.z, *draws)]
    rows = [_reference_rows(mechanics, _while_wanted(reference, is_wanted), options) for mechanics in possible]
    if len(rows[0]) == 0:
        raise InputError(f"None of {len(reference)} reference pushes moves the object; draw them over its outline.")
    models = [_PossibleModel(mechanics, r @ scale) for mechanics, r in zip(possible, rows, strict=True) if len(r)]
    values = list(options.run_all(lambda push: _value(possible[0], scale, models, push, options), _while_wanted(candidates, is_wanted)))
    useless = [v.status is not SolveStatus.CONVERGED for v in values]
    return RankedPushes(
        values=tuple(values[i] for i in np.lexsort(([v.error_after for v in values], useless))),
        error_before=float(np.mean([model.error(np.eye(len(scale))) for model in models])),
    )


def imagine_push(
    mechanics: Mechanics,
    push: PlannedPush,
    first: Float64Array | None = None,
    *,
    sensor: PoseSensor | None = None,
    settings: SimulationSettings | None = None,
    order: float = 0.0,
) -> tuple[PushRecord | None, SolveStatus]:
    """The record of a push without noise if a model were true; no record where the object would not move.

    `first`: true pose of the object before it, shape (3,), where that is not the planned one; `order`: number of pushes made before.
    """
    pusher, sensor = push.pusher, sensor or PoseSensor()
    time = np.arange(pusher.time[0], pusher.time[-1] + 1e-9, 1.0 / sensor.rate)
    time = time if len(time) > 1 else pusher.time[[0, -1]]  # slow sensors observe both ends
    motion = mechanics.simulate(PushScenario(pusher, push.pose_object_in_table if first is None else first, time, order), settings=settings)
    if motion.status is not SolveStatus.CONVERGED:
        return None, motion.status
    poses = PoseTrack(time, motion.pose, np.broadcast_to(sensor.covariance, (len(time), 3, 3)))
    return PushRecord("", mechanics.shape, poses, pusher), motion.status


def _while_wanted(pushes: Sequence[PlannedPush], is_wanted: Callable[[], bool]) -> Iterator[PlannedPush]:
    for push in pushes:
        if not is_wanted():
            raise UnwantedError("The ranking of pushes was no longer wanted.")
        yield push


@dataclass(frozen=True, slots=True)
class _PossibleModel:
    """A model that may be the true one, and the derivative of predictions there."""

    mechanics: Mechanics
    rows: Float64Array
    """d(cell displacement at the end of a reference push) / d(unknowns of unit covariance), shape (n_references, 3, n_unknowns)."""

    def error(self, root: Float64Array) -> float:
        """Mean over the reference pushes of the root mean square cell error [m]; `root` root' is the precision, lower triangular."""
        after = solve_triangular(root, self.rows.reshape(-1, len(root)).T, lower=True)
        return float(np.mean(np.sqrt(np.sum(after.reshape(len(root), -1, 3) ** 2, axis=(0, 2)))))


def _value(mean: Mechanics, scale: Float64Array, models: Sequence[_PossibleModel], push: PlannedPush, options: RankingOptions) -> PushValue:
    """Expected outcome of one push, which the `mean` model decides whether it moves the object."""
    identity = np.eye(len(scale))
    roots: list[Float64Array] = [identity] * len(models)
    record, status = imagine_push(mean, push, sensor=options.sensor, settings=options.numerics)
    if record is not None:
        observation = observe_push(record, options.noise)
        sensitivities = [_sensitivity(model.mechanics, push, observation, options.numerics) @ scale for model in models]
        roots = [lower_root(identity + rows.T @ rows) for rows in sensitivities]
    at_mean = solve_triangular(roots[0], scale.T, lower=True)
    return PushValue(
        push=push,
        status=status,
        error_after=float(np.mean([model.error(root) for model, root in zip(models, roots, strict=True)])),
        covariance=at_mean.T @ at_mean,
    )


def _sensitivity(mechanics: Mechanics, push: PlannedPush, observation: Observation, settings: SimulationSettings) -> Float64Array:
    """Rows G with H = G' G: derivative of whitened frames by z beyond that by the push's own unknowns, shape (n_rows, n_unknowns)."""
    motion = mechanics.simulate(PushScenario(push.pusher, push.pose_object_in_table, observation.time), settings=settings, jacobian=True)
    size = mechanics.derivative.shape[1]
    nothing = np.zeros((0, size))
    if motion.status is SolveStatus.SIMULATION_FAILED:
        return nothing
    whitened = np.einsum("fij,fjp->fip", observation.whitening, motion.jacobian)
    by_first = whitened[:, :, :3].reshape(-1, 3)
    in_deviations = by_first @ np.linalg.cholesky(observation.first_covariance)
    if not np.sum(in_deviations**2) <= CHATTER**2 * len(observation.time):
        return nothing
    by_z = (whitened[:, :, Param.MASS :] @ mechanics.derivative[Param.MASS :]).reshape(-1, size)
    explained, _ = np.linalg.qr(by_first)
    rows = by_z - explained @ (explained.T @ by_z)
    if observation.surface_std == 0:
        return np.asarray(rows)
    # The displacement of the frames of a push, of unit variance, is one more noise of them.
    moved = observation.surface_std * observation.whitening[:, :, :2].reshape(-1, 2)
    moved -= explained @ (explained.T @ moved)
    return np.asarray(solve_triangular(np.linalg.cholesky(np.eye(len(rows)) + moved @ moved.T), rows, lower=True))


def _reference_rows(mechanics: Mechanics, reference: Iterable[PlannedPush], options: RankingOptions) -> Float64Array:
    """d(cell displacement at the end) / dz of the reference pushes that move the object of a model, shape (n_moved, 3, n_unknowns)."""

    def rows_of(push: PlannedPush) -> Float64Array | None:
        scenario = PushScenario(push.pusher, push.pose_object_in_table, push.pusher.time[-1:])
        motion = mechanics.simulate(scenario, settings=options.numerics, jacobian=True)
        return end_derivative(mechanics, mechanics.shape.cells, motion, push.pose_object_in_table[2])

    return np.array([rows for rows in options.run_all(rows_of, reference) if rows is not None])


def end_derivative(mechanics: Mechanics, cells: CellGrid, motion: Motion, first_yaw: float) -> Float64Array | None:
    """d(cell displacement at the end of a push) / dz [m], shape (3, n_unknowns); None where no derivative predicts the end."""
    if motion.status is not SolveStatus.CONVERGED:
        return None
    by_body = cell_displacement(cells, motion.pose[-1, 2]) @ motion.jacobian[-1]
    by_first = np.linalg.solve(cell_displacement(cells, first_yaw).T, by_body[:, :3].T).T
    if not np.linalg.norm(by_first, 2) < CHATTER:
        return None
    return np.asarray(by_body[:, Param.MASS :] @ mechanics.derivative[Param.MASS :])


def _freeze(owner: PlannedPush | PoseSensor, name: str, shape: tuple[int, ...]) -> None:
    """Store an array read-only, checking its shape and that it is finite."""
    array = np.array(getattr(owner, name), dtype=np.float64)
    if array.shape != shape or not np.all(np.isfinite(array)):
        raise InputError(f"{type(owner).__name__}.{name} is {array.tolist()}, expected finite numbers of shape {shape}.")
    array.setflags(write=False)
    object.__setattr__(owner, name, array)


def _pusher_path(plan: PushPlan2D, settings: PushSettings, acceleration: float, rest: float = 0.5, rate: float = 100.0) -> PusherPath:
    """Stand for `rest` [s], drive straight through the contact to the end, stand; sampled at `rate` [Hz]."""
    length = settings.clearance + plan.distance
    speed = min(plan.speed, float(np.sqrt(acceleration * length)))
    ramp = speed / acceleration
    end = length / speed + ramp
    time = np.arange(0.0, end + 2 * rest, 1.0 / rate)
    since, left = np.clip(time - rest, 0.0, end), np.clip(rest + end - time, 0.0, end)
    # At constant speed from the middle of the first ramp to the middle of the last one; the ramps follow.
    travel = np.clip(speed * (since - 0.5 * ramp), 0.0, length)
    if ramp > 0:
        travel = np.where(since < ramp, 0.5 * acceleration * since**2, travel)
        travel = np.where(left < ramp, length - 0.5 * acceleration * left**2, travel)
    return PusherPath(time, plan.tool_start(settings.clearance) + travel[:, None] * plan.heading, settings.pusher_radius)


@dataclass(frozen=True, slots=True)
class Proposal:
    """The best of some random pushes."""

    plan: PushPlan2D
    """Object frame."""
    posterior: ModelPosterior
    """Of the object."""
    pusher_radius: float
    """[m]"""
    error_before: float
    """Expected cell error of other pushes now [m]."""
    error_after: float
    """The same after this push [m]."""

    def __repr__(self) -> str:
        return f"Proposal({self.sentence})"

    @property
    def sentence(self) -> str:
        """The push in words; lengths in mm, angles in degrees."""
        (x, y), plan = 1e3 * self.plan.contact_point, self.plan
        return (
            f"touch at ({x:.0f}, {y:.0f}) mm of the object frame, push {1e3 * plan.distance:.0f} mm at {plan.speed:.2f} m/s towards "
            f"{math.degrees(plan.direction):.0f}°; expected cell error {1e3 * self.error_after:.1f} mm after it, "
            f"{1e3 * self.error_before:.1f} mm now"
        )

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html_table(f"Next push: {self.sentence}", (), ())


def propose_push(posterior: ModelPosterior, pusher_radius: float, n_references: int = 20) -> Proposal | None:
    """The push after which other pushes would be predicted best; None where no candidate would add information.

    `n_references` random pushes stand for all that may be predicted.
    """
    rng, shape = np.random.default_rng(0), posterior.unknowns.shape
    settings = PushSettings(pusher_radius=pusher_radius, workspace=(-10.0, 10.0, -10.0, 10.0))  # nothing is in the way
    try:
        candidates = candidate_pushes(shape, np.zeros(3), rng, N_CANDIDATES, settings)
        ranked = rank_pushes(posterior, candidates, reference=reference_pushes(shape, rng, n_references, settings), rng=rng)
    except (PlanningError, InputError):
        return None
    best = ranked.best
    if best is None or best.plan is None:
        return None
    return Proposal(best.plan, posterior, pusher_radius, ranked.error_before, ranked.values[0].error_after)
