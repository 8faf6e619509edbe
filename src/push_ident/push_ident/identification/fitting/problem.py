"""The fit as one problem: residuals of all pushes and their Jacobian, with the simulations counted.

Unknowns x = (z, those of push 1, those of push 2, ...). The first pose of a push is a nuisance parameter: it is uncertain, so it is
fitted together with the maps, from the mean of the frames at rest; its prior is the first frame itself. With an outline that a camera
traced, a push has two more, d: its frames are displaced alike, as the surface that it touches is not where the outline has it. All unknowns
are in units of their prior standard deviation, so that the cost is

    sum_frames (n + 3)/2 log(1 + |W (y - f(x) - s d)|^2 / n) + 1/2 |z|^2 + 1/2 |d|^2 + past(z),      n = `TAILS`

Where forces are measured and the prior uses them, their means over windows are measurements too, of a like cost. The
quadratic `past` replaces pushes that are no longer simulated.

The noise of a frame is Student's t with n degrees of freedom: near the fit it counts like a normal one, and a wrong pose does not drag
the maps with it.

The time steps of each push are chosen where it is simulated first (`physics/accuracy.py`), not finer than `_FIRST_LEVEL`, and then kept, so
that the cost stays smooth. `refine_steps` looks again at the end of a fit, without that bound.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.fitting.budget import Budget, Meter
from push_ident.identification.observing.observation import ForceObservation, NoiseModel, Observation, observe_forces, observe_push
from push_ident.identification.unknowns.mechanics import Mechanics, mechanics_at
from push_ident.identification.unknowns.quadratic import Quadratic
from push_ident.identification.unknowns.spec import Block, Layout, UnknownsSpec
from push_ident.physics.accuracy import MAX_LEVEL, MIN_LEVEL, SHARE, StepChoice, choose_steps, step_error
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import Motion, SimulationSettings, StepResponse, Timeline, simulate_body_with_response
from push_ident.physics.tape import Param
from push_ident.types import Float64Array, ObjectShape, PushRecord, SolveStatus

TAILS = 4.0
"""Degrees of freedom of the noise of a frame [-]."""
FRAME_COST = 1.5
"""Of a frame that is explained to its noise [nat]: half of its three squared residuals."""
_PUSHES = "pushes"
"""Block of the nuisance parameters: first pose and displacement of each push."""
_POSE = 3
_FIRST_LEVEL = 2
"""Finest level of the time steps before a fit has ended: a motion of a poor model may need steps that the right one does not."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Cost and its first derivatives at one point."""

    cost: float
    """Negative logarithm of the posterior density up to a constant; infinite where a simulation failed."""
    gradient: Float64Array
    """Shape (n_unknowns,)."""
    hessian: Float64Array
    """Gauss-Newton approximation, prior included, shape (n_unknowns, n_unknowns)."""
    residual: Float64Array
    """Whitened, shape (n_frames of all pushes, 3)."""

    @property
    def log_volume(self) -> float:
        """Logarithm of the share of the prior that the posterior leaves, with the sign of a cost [nat]; infinite where rounding has made
        the Hessian indefinite."""
        sign, log = np.linalg.slogdet(self.hessian)
        return 0.5 * float(log) if sign > 0 else float("inf")


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Whitened residuals at one point with their derivative by all unknowns, poses and forces apart."""

    poses: tuple[Float64Array, ...]
    """Residual of each push, shape (n_frames, 3)."""
    forces: tuple[Float64Array, ...]
    """Residual of the measured forces of each push, shape (n_windows, 2); of no windows where there are none."""
    by_poses: Float64Array
    """Derivative of `poses`, push by push, shape (3 n_frames of all pushes, size)."""
    by_forces: Float64Array
    """Derivative of `forces`, push by push, shape (2 n_windows of all pushes, size)."""


RunAll = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Does work for each item, in their order: `map`, or a parallel version of it."""


def _unlimited() -> Meter:
    return Meter(Budget(max_seconds=None))


class FitProblem:
    """Pushes of one object as a least-squares problem.

    Args:
        records: pushes of one object; all with the same cells.
        unknowns: of the object.
        noise: of the observations.
        settings: numerics of the simulation.
        meter: counts the simulations and ends a solve when its budget is spent; by default without a limit, so that no clock decides a
            result.
        past: information from other pushes, in the unknowns of the object.
        steps: time steps that another problem of the same pushes chose (`FitProblem.steps`).
        run_all: how the pushes are simulated. In parallel, the meter counts them only roughly.

    Raises:
        InputError: no push, or pushes of objects with different cells.
    """

    def __init__(
        self,
        records: Sequence[PushRecord],
        unknowns: UnknownsSpec,
        *,
        noise: NoiseModel | None = None,
        settings: SimulationSettings | None = None,
        meter: Meter | None = None,
        past: Quadratic | None = None,
        steps: Sequence[StepChoice | None] | None = None,
        run_all: RunAll = map,
    ) -> None:
        if not records:
            raise InputError("There is no push to learn from; give at least one push record.")
        n_cells = len(unknowns.shape.cells)
        for record in records:
            if len(record.shape.cells) != n_cells:
                raise InputError(f"{record.source or 'A push'} has {len(record.shape.cells)} cells, expected {n_cells} as the others.")
        self.records = list(records)
        self.noise = noise
        self.unknowns = unknowns
        self.n_reference = 0
        """Number of pushes, the last ones, that are those of a reference: without the changes since."""
        self.observations: list[Observation] = [observe_push(record, noise) for record in records]
        is_used = unknowns.prior.force_offset_std > 0
        self.forces: list[ForceObservation | None] = [observe_forces(record, noise) if is_used else None for record in records]
        self.settings = settings or SimulationSettings()
        self.meter = meter or _unlimited()
        self.run_all = run_all
        self._timelines: dict[tuple[int, SimulationSettings], tuple[PushRecord, Timeline]] = {}
        """Steps of each push that was simulated, by the identity of its record, which is kept; problems of the same pushes share them."""
        self.past = past or Quadratic.zero(unknowns.size)
        self.steps: list[StepChoice | None] = list(steps) if steps is not None else [None] * len(self.records)
        """Time steps of each push; None until it is simulated."""
        self.first_scale = [np.linalg.cholesky(o.first_covariance) for o in self.observations]
        self.precisions = [1.0] * len(self.records)
        """Of the prior of the displacements of each push, relative to that of all [1]: small for one that the model explains badly."""
        self.unknowns_of_push = unknowns_of_push(unknowns.shape, noise)
        """Number of unknowns that each push has of its own."""

    def of(self, unknowns: UnknownsSpec, *, meter: Meter | None = None, past: Quadratic | None = None) -> FitProblem:
        """The same pushes with other unknowns of the object; by default with an unlimited budget and without information from others."""
        other = copy(self)
        other.unknowns, other.past, other.meter = unknowns, past or Quadratic.zero(unknowns.size), meter or _unlimited()
        other.steps = [None if choice is None else choice.at_most(_FIRST_LEVEL, self.settings) for choice in self.steps]
        return other

    def with_noise(self, noise: NoiseModel, precisions: Sequence[float] | None = None) -> FitProblem:
        """The same pushes and unknowns under another noise, with as many frames and displacements, and with an unlimited budget."""
        other = copy(self)
        other.precisions = self.precisions if precisions is None else list(precisions)
        other.noise, other.meter = noise, _unlimited()
        other.observations = [observe_push(record, noise) for record in self.records]
        other.first_scale = [np.linalg.cholesky(o.first_covariance) for o in other.observations]
        other.steps = [None] * len(self.records)
        return other

    def beside_reference(self, n_reference: int) -> FitProblem:
        """The same problem, whose last pushes are those of a reference."""
        other = copy(self)
        other.n_reference = n_reference
        return other

    def without(self, pushes: Collection[int]) -> FitProblem:
        """The same problem without some pushes, given by their numbers, and with an unlimited budget."""
        rest = copy(self)
        for name in ("records", "observations", "forces", "first_scale", "steps", "precisions"):
            setattr(rest, name, [value for i, value in enumerate(getattr(self, name)) if i not in pushes])
        rest.meter = _unlimited()
        rest.n_reference -= sum(push >= self.n_pushes for push in pushes)
        return rest

    @property
    def n_pushes(self) -> int:
        """Number of pushes, the first ones, that are not those of a reference."""
        return len(self.records) - self.n_reference

    @property
    def uses_forces(self) -> bool:
        """Whether forces are among the measurements."""
        return any(forces is not None for forces in self.forces)

    @property
    def layout(self) -> Layout:
        """Blocks of the unknowns of the object, then `pushes`."""
        return Layout.of((*self.unknowns.blocks.values(), Block(_PUSHES, np.ones(self.unknowns_of_push * len(self.records)))))

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.unknowns.size + self.unknowns_of_push * len(self.records)

    def object_unknowns(self, x: Float64Array) -> Float64Array:
        """The unknowns `z` of the object within `x`, shape (unknowns.size,)."""
        return x[: self.unknowns.size]

    def mechanics_at(self, x: Float64Array) -> list[Mechanics]:
        """The moving body of each push at `x`, shape (size,)."""
        z = self.object_unknowns(x)
        bodies = [mechanics_at(self.unknowns, z)] * self.n_pushes
        return bodies + [mechanics_at(self.unknowns, z, of_reference=True)] * self.n_reference if self.n_reference else bodies

    def slice_of_first_pose(self, push: int) -> slice:
        """Place of the first pose of a push in `x`."""
        start = self.slice_of_push(push).start
        return slice(start, start + _POSE)

    def slice_of_push(self, push: int) -> slice:
        """Place of all unknowns of a push in `x`: its first pose, then its displacement."""
        start = self.unknowns.size + self.unknowns_of_push * push
        return slice(start, start + self.unknowns_of_push)

    def push_unknowns(self, x: Float64Array) -> Float64Array:
        """The unknowns of the pushes within `x`, one row per push, shape (n_pushes, unknowns_of_push)."""
        return x[self.unknowns.size :].reshape(-1, self.unknowns_of_push)

    def displacement(self, x: Float64Array, push: int) -> Float64Array:
        """By which the frames of a push are displaced (x, y, yaw), shape (n_frames, 3)."""
        return self.observations[push].shared @ x[self.slice_of_push(push)][_POSE:]

    @property
    def prior_precision(self) -> Float64Array:
        """Precision of the normal prior of all unknowns, shape (size,): 0 for first poses, whose prior counts as a measurement."""
        of_push = np.r_[np.zeros(_POSE), np.ones(self.unknowns_of_push - _POSE)]
        return np.r_[np.ones(self.unknowns.size), np.outer(self.precisions, of_push).ravel()]

    def prior_at(self, x: Float64Array) -> tuple[float, Float64Array, Float64Array]:
        """Cost of the prior of all unknowns and of earlier pushes at `x`, shape (size,), its gradient and its Hessian, but for first poses,
        whose prior counts as a measurement."""
        n, precision = self.unknowns.size, self.prior_precision
        gradient, hessian = precision * x, np.diag(precision)
        gradient[:n] += self.past.slope(x[:n])
        hessian[:n, :n] += self.past.hessian
        return 0.5 * float(precision @ x**2) + self.past(x[:n]), gradient, hessian

    @property
    def unit_prior(self) -> Float64Array:
        """Precision of the unit normal prior, shape (size,): 1 for unknowns of the object, 0 for those of pushes, whose prior counts as
        a measurement of theirs."""
        return np.r_[np.ones(self.unknowns.size), np.zeros(self.size - self.unknowns.size)]

    def continued(self, x0: Float64Array, earlier: Float64Array) -> Float64Array:
        """The start `x0` with the values of an earlier result for the first of these pushes; as it is where that has another size."""
        x = np.array(x0)
        if self.unknowns.size <= len(earlier) <= self.size:
            x[: len(earlier)] = earlier
        return x

    def first_pose(self, x: Float64Array, push: int) -> Float64Array:
        """First pose of a push, table frame, shape (3,)."""
        return self.observations[push].pose[0] + self.first_scale[push] @ x[self.slice_of_first_pose(push)]

    def simulate(self, x: Float64Array) -> list[Motion]:
        """All pushes at `x`, shape (size,), reported at the observed frames; ends early at one that fails."""
        bodies = self.mechanics_at(x)
        motions: list[Motion] = []
        for motion in self._of_pushes(lambda push: self._simulate_push(bodies[push], x, push)):
            motions.append(motion)
            if motions[-1].status is SolveStatus.SIMULATION_FAILED:
                break
        return motions

    def _simulate_push(self, mechanics: Mechanics, x: Float64Array, push: int, jacobian: bool = False) -> Motion:
        choice = self.steps[push]
        if choice is None:
            choice = self.steps[push] = self._choose_steps(mechanics, x, push, most=_FIRST_LEVEL)
        scenario = self._scenario(mechanics, x, push)
        timeline = self._timeline(scenario, push, choice.settings)
        self.meter.count(1)
        motion = mechanics.simulate(scenario, settings=choice.settings, jacobian=jacobian, timeline=timeline)
        # With such a derivative by the first pose a motion is unstable, as of a pusher within the object: short steps would follow it.
        if choice.level > 0 and jacobian and np.max(np.abs(motion.jacobian[:, :, : Param.MASS])) > 1e6:
            self.steps[push] = StepChoice(self.settings, 0, np.inf)
            return self._simulate_push(mechanics, x, push, jacobian)
        return motion

    def _scenario(self, mechanics: Mechanics, x: Float64Array, push: int) -> PushScenario:
        record = self.records[push]
        forces = self.forces[push]
        force_time = np.zeros(0) if forces is None else forces.times(mechanics.all_effects)
        return PushScenario(record.pusher, self.first_pose(x, push), self.observations[push].time, record.order, force_time)

    def _timeline(self, scenario: PushScenario, push: int, settings: SimulationSettings) -> Timeline | None:
        """Steps of a push; None where forces are measured, whose times the unknowns may move."""
        if self.forces[push] is not None:
            return None
        record = self.records[push]
        _, known = self._timelines.get((id(record), settings), (record, None))
        if known is None:
            known = Timeline.of(scenario, settings)
            self._timelines[id(record), settings] = record, known
        return known

    def respond(self, x: Float64Array, push: int) -> tuple[Motion, StepResponse | None]:
        """One push at `x`, shape (size,), and how its poses change under small forces; None where its simulation fails."""
        mechanics = self.mechanics_at(x)[push]
        self.meter.count(1)
        return simulate_body_with_response(
            mechanics.shape, mechanics.body, mechanics.pusher_friction, self._scenario(mechanics, x, push), settings=self.settings_of(push),
            effects=mechanics.effects,
        )  # fmt: skip

    def _end_pose(self, mechanics: Mechanics, x: Float64Array, push: int, settings: SimulationSettings) -> Float64Array:
        """For the choice of steps. Not counted as a simulation of the fit; its time is."""
        scenario = self._scenario(mechanics, x, push)
        return mechanics.simulate(scenario, settings=settings, timeline=self._timeline(scenario, push, settings)).pose[-1]

    def _choose_steps(
        self, mechanics: Mechanics, x: Float64Array, push: int, least: int | None = None, most: int = MAX_LEVEL
    ) -> StepChoice:
        duration, covariance = self._scenario(mechanics, x, push).duration, self.observations[push].end_covariance
        if least is None:  # forces are means over steps
            least = MIN_LEVEL if self.forces[push] is None else 0
        return choose_steps(partial(self._end_pose, mechanics, x, push), self.settings, covariance, duration, least=least, most=most)

    def settings_of(self, push: int) -> SimulationSettings:
        """Numerics of one push, with the steps that were chosen for it."""
        choice = self.steps[push]
        return self.settings if choice is None else choice.settings

    def refine_steps(self, x: Float64Array) -> bool:
        """Shorten the time steps of pushes where they are too long at `x`, shape (size,); whether there was any.

        Steps never become longer. A push that was below 0.3 of the accepted error is not looked at.
        """
        bodies = self.mechanics_at(x)
        doubtful = {push: old.level for push, old in enumerate(self.steps) if old is not None and 0.3 * SHARE <= old.error < np.inf}
        choices = self.run_all(lambda push: self._choose_steps(bodies[push], x, push, doubtful[push]), doubtful)
        refined = False
        for (push, level), choice in zip(doubtful.items(), choices, strict=True):
            self.steps[push] = choice
            refined |= choice.level > level
        return refined

    def step_errors(self, x: Float64Array) -> Float64Array:
        """Effect of halving the time steps and the smoothing speed on the end of each push, in standard deviations of its noise [-].

        Shape (n_pushes,); infinite where a simulation fails.
        """
        bodies = self.mechanics_at(x)

        def error(push: int) -> float:
            end_pose = partial(self._end_pose, bodies[push], x, push)
            return step_error(end_pose, self.settings_of(push), self.observations[push].end_covariance)

        return np.array(list(self._of_pushes(error)))

    def _of_pushes(self, work: Callable[[int], Any]) -> Iterable[Any]:
        """`work` of the number of each push, in their order."""
        return self.run_all(work, range(len(self.records)))

    def residual(self, x: Float64Array, motion: Motion, push: int) -> Float64Array:
        """Whitened difference between a push simulated at `x` and the observed one, shape (n_frames, 3)."""
        observed = self.observations[push]
        return np.einsum("fij,fj->fi", observed.whitening, motion.pose + self.displacement(x, push) - observed.pose)

    @staticmethod
    def weigh(residual: Float64Array) -> tuple[float, Float64Array]:
        """Robust cost of whitened residuals, shape (n, size), and the weight of the square of each row in it, shape (n,)."""
        size2, freedom = np.sum(residual**2, axis=1), TAILS + residual.shape[1]
        return 0.5 * freedom * float(np.sum(np.log1p(size2 / TAILS))), freedom / (TAILS + size2)

    @staticmethod
    def frame_weight(residual: Float64Array) -> Float64Array:
        """Weight of the square of each row in the cost, of whitened residuals of shape (..., n, size)."""
        return np.asarray((TAILS + residual.shape[-1]) / (TAILS + np.sum(residual**2, axis=-1)))

    def cost(self, x: Float64Array) -> float:
        """Cost at `x`, without derivative: one simulation per push. Infinite where a simulation failed."""
        return self.cost_of(x, self.simulate(x))

    def force_residual(self, mechanics: Mechanics, motion: Motion, push: int) -> Float64Array:
        """Whitened difference between the forces of a simulated push and the measured ones, shape (n_windows, 2)."""
        observed = self.forces[push]
        if observed is None:
            return np.zeros((0, 2))
        return observed.residual(observed.simulated(motion.impulse, mechanics.mass_factor, mechanics.all_effects))

    def force_change(self, mechanics: Mechanics, motion: Motion, push: int, by_impulse: Float64Array) -> Float64Array:
        """Change of `force_residual`, shape (n_windows, 2, n), by that of `Motion.impulse`, shape (n_windows + 1, 2, n)."""
        observed = self.forces[push]
        if observed is None:
            return np.zeros((0, 2, by_impulse.shape[2]))
        return observed.derivative(motion, by_impulse, mechanics.mass_factor, mechanics.all_effects)[0]

    def cost_of(self, x: Float64Array, motions: Sequence[Motion]) -> float:
        """Cost of motions simulated at `x`."""
        if motions[-1].status is SolveStatus.SIMULATION_FAILED:
            return np.inf
        of_pushes = sum(self.weigh(self.residual(x, motion, push))[0] for push, motion in enumerate(motions))
        if self.uses_forces:
            bodies = self.mechanics_at(x)
            of_pushes += sum(self.weigh(self.force_residual(bodies[push], motion, push))[0] for push, motion in enumerate(motions))
        return (
            self._prior_cost(self.object_unknowns(x))
            + of_pushes
            + 0.5 * float(self.precisions @ np.sum(self.push_unknowns(x)[:, _POSE:] ** 2, axis=1))
        )

    def _prior_cost(self, z: Float64Array) -> float:
        """Cost of the unknowns of the object by their prior and by earlier pushes."""
        return 0.5 * float(z @ z) + self.past(z)

    def evaluate(self, x: Float64Array) -> Evaluation:
        """Cost and derivatives at `x`: one simulation per push, with its derivative."""
        n_z = self.unknowns.size
        z = self.object_unknowns(x)
        bodies = self.mechanics_at(x)
        cost = self._prior_cost(z)
        gradient = np.zeros(self.size)
        gradient[:n_z] = z + self.past.slope(z)
        hessian = np.diag(self.unit_prior)
        hessian[:n_z, :n_z] += self.past.hessian
        residuals = []
        for push, terms in enumerate(self._of_pushes(lambda push: self._push_terms(bodies[push], x, push))):
            if terms is None:
                return Evaluation(np.inf, gradient, hessian, np.empty((0, 3)))
            columns = np.r_[0:n_z, self.slice_of_push(push)]
            cost += terms.cost
            gradient[columns] += terms.gradient
            hessian[np.ix_(columns, columns)] += terms.hessian
            residuals.append(terms.residual)
        return Evaluation(cost, gradient, hessian, np.concatenate(residuals))

    def linearise(self, x: Float64Array) -> Linearisation | None:
        """Residuals at `x`, shape (size,), with their derivative: one simulation per push. None where one fails."""
        bodies = self.mechanics_at(x)
        residuals: list[tuple[Float64Array, Float64Array]] = []
        poses, forces = [np.zeros((0, self.size))], [np.zeros((0, self.size))]
        for push, motion in enumerate(self._of_pushes(lambda push: self._simulate_push(bodies[push], x, push, jacobian=True))):
            if motion.status is SolveStatus.SIMULATION_FAILED:
                return None
            mechanics = bodies[push]
            residuals.append((self.residual(x, motion, push), self.force_residual(mechanics, motion, push)))
            poses.append(self._rows(self._whitened_jacobian(mechanics, motion, push), push))
            if self.forces[push] is not None:
                forces.append(self._rows(self._force_jacobian(mechanics, x, motion, push), push))
        of_poses, of_forces = zip(*residuals, strict=True)
        return Linearisation(of_poses, of_forces, np.concatenate(poses), np.concatenate(forces))

    def _rows(self, by_push: Float64Array, push: int) -> Float64Array:
        """Derivatives by the unknowns of the object and those of one push, among all unknowns, shape (n, size)."""
        rows = np.zeros((len(by_push), self.size))
        rows[:, : self.unknowns.size] = by_push[:, : self.unknowns.size]
        rows[:, self.slice_of_push(push)] = by_push[:, self.unknowns.size :]
        return rows

    def evaluate_push(self, x: Float64Array, push: int) -> Evaluation | None:
        """Contribution of one push to `evaluate`, by the unknowns of the object and its own; None where its simulation fails."""
        return self._push_terms(self.mechanics_at(x)[push], x, push)

    def _push_terms(self, mechanics: Mechanics, x: Float64Array, push: int) -> Evaluation | None:
        motion = self._simulate_push(mechanics, x, push, jacobian=True)
        if motion.status is SolveStatus.SIMULATION_FAILED:
            return None
        residual = self.residual(x, motion, push)
        cost, weight = self.weigh(residual)
        jacobian = self._whitened_jacobian(mechanics, motion, push)
        weighted = jacobian * np.repeat(weight, 3)[:, None]
        gradient, hessian = weighted.T @ residual.ravel(), weighted.T @ jacobian
        if self.forces[push] is not None:
            forces, by_forces = self.force_residual(mechanics, motion, push), self._force_jacobian(mechanics, x, motion, push)
            of_forces, weight = self.weigh(forces)
            weighted = by_forces * np.repeat(weight, 2)[:, None]
            cost, gradient, hessian = cost + of_forces, gradient + weighted.T @ forces.ravel(), hessian + weighted.T @ by_forces
        displaced = np.arange(self.unknowns.size + _POSE, len(gradient))
        in_plane = x[self.slice_of_push(push)][_POSE:]
        precision = self.precisions[push]
        gradient[displaced] += precision * in_plane
        hessian[displaced, displaced] += precision
        return Evaluation(cost + 0.5 * precision * float(in_plane @ in_plane), gradient, hessian, residual)

    def _force_jacobian(self, mechanics: Mechanics, x: Float64Array, motion: Motion, push: int) -> Float64Array:
        """Derivative of `force_residual` by the unknowns of the object and those of the push, shape (2 n_windows, unknowns.size +
        unknowns_of_push)."""
        observed, unknowns = self.forces[push], self.unknowns
        assert observed is not None
        by_unknowns = np.concatenate(
            [motion.impulse_jacobian[:, :, Param.MASS:] @ mechanics.derivative[Param.MASS:],
             motion.impulse_jacobian[:, :, :_POSE] @ self.first_scale[push],
             np.zeros((len(observed.edges), 2, self.unknowns_of_push - _POSE))],
            axis=2,
        )  # fmt: skip
        jacobian, by_factor, by_value = observed.derivative(motion, by_unknowns, mechanics.mass_factor, mechanics.all_effects)
        jacobian[:, :, unknowns.slices["total_mass"]] += by_factor[:, :, None] * unknowns.blocks["total_mass"].std
        of_values = unknowns.acting_effects(self.object_unknowns(x), of_reference=push >= self.n_pushes)[1]
        jacobian[:, :, : unknowns.size] += by_value @ of_values
        return jacobian.reshape(2 * len(observed.force), -1)

    def _whitened_jacobian(self, mechanics: Mechanics, motion: Motion, push: int) -> Float64Array:
        """Derivative of the residuals of one push by the unknowns of the object and its own, shape (3 n_frames, unknowns.size +
        unknowns_of_push)."""
        observed, n_frames = self.observations[push], len(motion.jacobian)
        # The unknowns are fewer than the cells, and one large product takes less time than one for each frame.
        by_body = motion.jacobian.reshape(3 * n_frames, -1)
        shared = by_body[:, Param.MASS :] @ mechanics.derivative[Param.MASS :]
        rows = np.concatenate([shared, by_body[:, :_POSE] @ self.first_scale[push]], axis=1)
        whitened = np.einsum("fij,fjp->fip", observed.whitening, rows.reshape(n_frames, 3, -1))
        return np.concatenate([whitened, observed.whitening @ observed.shared], axis=2).reshape(3 * n_frames, -1)


def unknowns_of_push(shape: ObjectShape, noise: NoiseModel | None = None) -> int:
    """Number of unknowns that each push of an object has of its own: first pose, displacement where a camera traced the outline, and
    amplitudes of a shared model discrepancy."""
    noise = noise or NoiseModel()
    return _POSE + (2 if noise.surface_std(shape) > 0 else 0) + _POSE * noise.discrepancy_modes


def without_first_push(x: Float64Array, n_pushes: int, n_own: int) -> Float64Array:
    """The vector of a `FitProblem` of `n_pushes` pushes with `n_own` unknowns each, without those of the first push; as it is where it has
    another size."""
    start = len(x) - n_own * n_pushes
    return np.delete(x, slice(start, start + n_own)) if start >= 0 else x
