"""Simulate a push of an object model: the Python face of the compiled rollout.

cells -> rigid body (`body.py`) -> rollout (`rollout.py`) -> reported poses (`measurement.py`) -> derivative (`chain.py`)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from push_ident.errors import InputError
from push_ident.physics.active_effects import N_SUMS, NO_MODES, ActiveEffects, active_effects
from push_ident.physics.body import BodyParameters, body_of_cells, cell_gradient, check_body, owned
from push_ident.physics.chain import Chain, chain_backward, chain_forward, chain_response
from push_ident.physics.effect import OnTable
from push_ident.physics.effect_values import EffectsLike, EffectValues, changed_friction, driven_path, effect_values
from push_ident.physics.effects import EFFECTS
from push_ident.physics.measurement import Measurement, ReportTimes, StepClock
from push_ident.physics.pyramid import FINAL_NU
from push_ident.physics.rollout import Numerics, Push, new_effect_scratch, rollout
from push_ident.physics.scenario import PushScenario
from push_ident.physics.support import GRAVITY
from push_ident.physics.tape import N_BODY_PARAMETERS, Event, Frames, Param, Tape, new_tape
from push_ident.types import BoolArray, CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

__all__ = [
    "DEFAULT_STEP", "GRAVITY", "BodyParameters", "Motion", "ModelGradient", "PoseLoss", "PullBack", "SimulationSettings", "StepResponse",
    "Timeline", "body_of_cells", "cell_gradient", "compile_kernels", "loss_gradient", "simulate", "simulate_body",
    "simulate_body_with_pullback", "simulate_body_with_response",
]  # fmt: skip

DEFAULT_STEP = 1.0 / 240.0
"""Length of a time step where none is given and nothing asks for a shorter one [s]."""

PoseLoss = Callable[[Float64Array], tuple[float, Float64Array]]
"""Takes the poses at the frames, shape (n_frames, 3), and gives the loss and its derivative by them, same shape."""


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """How a push is simulated."""

    step: float | None = None
    """Length of a time step [s]. None: 1/240 s, and where poses are compared with observations as short as their noise demands, for each
    push (`accuracy.py`)."""
    resolve_events: bool = False
    """End steps at the samples of the pusher's path, no step longer than `step`; resolve the first contact within its step, and coasting to
    second order. False: equal steps, as in the paper."""
    smoothing_speed: float = 1e-4
    """Speed below which the support friction of a cell grows linearly [m/s]; only for the circular cone."""
    friction_cone: Literal["circle", "pyramid"] = "circle"
    """Support friction of a cell: Coulomb's circular cone, or the paper's pyramid in table axes, solved without smoothing."""
    quasi_static: bool = False
    """Leave inertia out: the object moves only while it is pushed, and its path does not depend on the pusher's speed."""

    def __post_init__(self) -> None:
        for name in ("step", "smoothing_speed"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"SimulationSettings.{name} is {value}, expected a positive number.")
        if self.friction_cone not in ("circle", "pyramid"):
            raise InputError(f"SimulationSettings.friction_cone is {self.friction_cone!r}, expected 'circle' or 'pyramid'.")
        if self.quasi_static and self.friction_cone == "pyramid":
            raise InputError(
                "A quasi-static push with the friction pyramid has no unique motion: many directions meet the same corner of the "
                "limit surface. Take friction_cone='circle' with quasi_static=True."
            )

    @property
    def longest_step(self) -> float:
        """`step`, or its default [s]."""
        return DEFAULT_STEP if self.step is None else self.step


@dataclass(frozen=True, slots=True)
class Motion:
    """A simulated push."""

    time: Float64Array
    """Times of `PushScenario` [s], shape (n_frames,)."""
    pose: Float64Array
    """Of the object frame in the table frame, shape (n_frames, 3), yaw not wrapped. NaN where the simulation failed."""
    jacobian: Float64Array
    """d pose / d (first pose (3), mass, centre of mass (2), inertia, pusher friction, limit of each cell, values of the active effects,
    modes of the outline), shape (n_frames, 3, 8 + n_cells + n_values + n_modes), the values in the order of `EffectValues.labels`;
    (n_frames, 3, 0) without it. NaN where the simulation failed."""
    force_time: Float64Array
    """Middle of each step [s], shape (n_steps,)."""
    force: Float64Array
    """Of the pusher on the object [N], shape (n_steps, 2), table frame."""
    status: SolveStatus
    """CONVERGED, NO_CONTACT (the pusher never touches) or SIMULATION_FAILED."""
    impulse: Float64Array
    """Of the pusher on the object from the start until each `PushScenario.force_time` [N s], shape (n_forces, 2), table frame: differences
    over their time are mean forces. NaN where the simulation failed."""
    force_at: Float64Array
    """Force at each `PushScenario.force_time`, by which the impulse grows [N], shape (n_forces, 2), table frame."""
    impulse_jacobian: Float64Array
    """Its derivative, shape (n_forces, 2, columns of `jacobian`)."""


@dataclass(frozen=True, slots=True)
class ModelGradient:
    """Loss of a simulated push and its gradient with respect to the model."""

    loss: float
    """NaN where the simulation failed, as the gradient."""
    mass: Float64Array
    """By the mass of each cell [1/kg], shape (n_cells,)."""
    friction: Float64Array
    """By the support friction coefficient of each cell, shape (n_cells,)."""
    pusher_friction: float
    pose: Float64Array
    """By the first pose (x, y, yaw), shape (3,)."""
    effects: Float64Array
    """By the values of the active effects, in the order of `EffectValues.labels`, shape (n_values,)."""
    motion: Motion


def compile_kernels(*, effects: bool = False, gradients: bool = True) -> None:
    """Compile all kernels, or load them from the cache, so that the first push need not wait. Compilation takes a minute, loading a second.

    Args:
        effects: whether to include the second set of kernels, for pushes with effects.
        gradients: whether to include those of the adjoint method and of small forces in any step, which a fit of maps does not need.
    """
    square = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])
    shape = ObjectShape(CellGrid(np.zeros((1, 2)), 0.02), square)
    body = BodyParameters(0.1, np.zeros(2), 1e-5, np.array([0.3]))
    pusher = PusherPath(np.array([0.0, 0.1]), np.array([[-0.02, 0.0], [0.0, 0.0]]), 0.005)
    arguments = (shape, body, 0.3, PushScenario(pusher, np.zeros(3), np.array([0.0, 0.1])))
    simulate_body(*arguments, jacobian=True)
    if gradients:
        simulate_body_with_pullback(*arguments)[1](np.zeros((2, 3)))
        _, response = simulate_body_with_response(*arguments)
        assert response is not None, "a push of a square does not fail"
        response(np.zeros((len(response.time), 3, 1)))
    if effects:
        simulate_body(*arguments, effects=list(EFFECTS), jacobian=True)


def simulate(
    model: ObjectModel,
    scenario: PushScenario,
    *,
    settings: SimulationSettings | None = None,
    effects: EffectsLike | None = None,
    jacobian: bool = False,
) -> Motion:
    """Motion of an object at rest while a pusher moves along its path.

    Args:
        model: mechanics of the object.
        scenario: path of the pusher, first pose, times to report.
        settings: numerics.
        effects: effects beside the base model (catalogue in `effects/`): by name, each with its values in order or by name. The
            poses are then those that would be reported.
        jacobian: also the derivative of the poses.

    Returns:
        The motion; look at its `status`.

    Raises:
        InputError: values of the body that are not finite or have another shape, negative friction, no mass, or an outline that holds
            less than half of the cells; effects that are not known, out of their range, or that the settings do not allow (those on
            the table need the circular cone).
    """
    body = body_of_cells(model.shape, model.mass, model.friction)
    return simulate_body(model.shape, body, model.pusher_friction, scenario, settings=settings, effects=effects, jacobian=jacobian)


def loss_gradient(
    model: ObjectModel,
    scenario: PushScenario,
    loss: PoseLoss,
    *,
    settings: SimulationSettings | None = None,
    effects: EffectsLike | None = None,
) -> ModelGradient:
    """Loss of a simulated push and its exact gradient with respect to the mass and friction of every cell, by the adjoint method.

    The cost is that of one simulation and one pass back over its steps, whatever the number of cells.

    Args:
        loss: of the poses at `scenario.time`.

    The other arguments are those of `simulate`.
    """
    body = body_of_cells(model.shape, model.mass, model.friction)
    motion, pull_back = simulate_body_with_pullback(model.shape, body, model.pusher_friction, scenario, settings=settings, effects=effects)
    value, by_pose = loss(motion.pose)
    gradient = pull_back(by_pose)
    by_mass, by_friction = cell_gradient(model.shape, model.mass, model.friction, gradient)
    return ModelGradient(
        float(value), by_mass, by_friction, float(gradient[Param.MU]), gradient[Param.POSE : Param.POSE + 3],
        gradient[Param.LIMIT + len(model.mass) :], motion,
    )  # fmt: skip


def simulate_body(
    shape: ObjectShape,
    body: BodyParameters,
    pusher_friction: float,
    scenario: PushScenario,
    *,
    settings: SimulationSettings | None = None,
    effects: EffectsLike | None = None,
    jacobian: bool = False,
    timeline: Timeline | None = None,
) -> Motion:
    """As `simulate`, for a rigid body. `timeline`: that of the scenario and the settings, where it is known already."""
    acting = effect_values(effects)
    run = _run(shape, body, pusher_friction, scenario, settings or SimulationSettings(), acting, jacobian, timeline)
    if not jacobian:
        return run.motion
    n_columns = N_BODY_PARAMETERS + len(shape.cells) + run.n_values
    by_pose = np.full((len(run.motion.time), 3, n_columns), np.nan)
    by_impulse = np.full((len(scenario.force_time), 2, n_columns), np.nan)
    if run.motion.status is not SolveStatus.SIMULATION_FAILED:
        chain_forward(run.chain, by_pose, run.impulses, by_impulse)
        if run.measurement is not None:
            by_pose = run.measurement.of_jacobian(by_pose)
            run.measurement.add_pusher_friction(by_impulse)
    return replace(run.motion, jacobian=by_pose, impulse_jacobian=by_impulse)


@dataclass(frozen=True, slots=True)
class PullBack:
    """A simulated push, ready to carry a gradient by its poses back to its parameters."""

    _run: _Run

    def __call__(self, by_pose: Float64Array) -> Float64Array:
        """Gradient of a loss with respect to all parameters.

        Args:
            by_pose: d loss / d pose at the frames, shape (n_frames, 3).

        Returns:
            d loss / d (first pose (3), mass, centre of mass (2), inertia, pusher friction, limit of each cell, values of the effects),
            shape (8 + n_cells + n_values,): the transposed `Motion.jacobian` times `by_pose`, without the Jacobian. NaN where the
            simulation failed.

        Raises:
            InputError: `by_pose` has another shape.
        """
        motion = self._run.motion
        by_pose = owned(by_pose)
        if by_pose.shape != motion.pose.shape:
            raise InputError(f"`by_pose` has shape {by_pose.shape}, expected {motion.pose.shape} as the poses.")
        chain, measurement = self._run.chain, self._run.measurement
        gradient = np.full(N_BODY_PARAMETERS + chain.arms.shape[1] + self._run.n_values, np.nan)
        if motion.status is not SolveStatus.SIMULATION_FAILED:
            chain_backward(chain, by_pose if measurement is None else measurement.by_true_pose(by_pose), gradient)
            if measurement is not None:
                measurement.add_gradient(by_pose, gradient)
        return gradient


def simulate_body_with_pullback(
    shape: ObjectShape,
    body: BodyParameters,
    pusher_friction: float,
    scenario: PushScenario,
    *,
    settings: SimulationSettings | None = None,
    effects: EffectsLike | None = None,
) -> tuple[Motion, PullBack]:
    """As `simulate_body`; also what carries a gradient by the poses back to the parameters."""
    acting = effect_values(effects)
    run = _run(shape, body, pusher_friction, scenario, settings or SimulationSettings(), acting, True)
    return run.motion, PullBack(run)


@dataclass(frozen=True, slots=True)
class StepResponse:
    """A simulated push, ready to say how its poses and the forces of the pusher change under small forces, whatever their law.

    Its steps are those from the first one in which the object moves to the one after the last: at rest it ignores small forces.
    """

    time: Float64Array
    """Middle of each step [s], shape (n_steps,)."""
    pose: Float64Array
    """Of the centre of mass at the start of each step, table frame, shape (n_steps, 3)."""
    twist: Float64Array
    """Velocity of the centre of mass and yaw rate in each step, table axes, shape (n_steps, 3)."""
    touches: BoolArray
    """Whether the pusher acts on the object, shape (n_steps,)."""
    pusher: Float64Array
    """Position of the pusher at the start of each step, table frame, shape (n_steps, 2)."""
    arms: Float64Array
    """Of the cells from the centre of mass, object axes, shape (n_cells, 2)."""
    limit: Float64Array
    """Friction limits of the cells without effects [N], shape (n_cells,)."""
    _run: _Run
    steps: slice
    """Its steps among all of the rollout."""

    def __call__(self, wrench: Float64Array, displacement: Float64Array | None = None) -> tuple[Float64Array, Float64Array]:
        """Change of the reported poses, shape (n_frames, 3, n), and of `Motion.impulse`, shape (n_forces, 2, n).

        Args:
            wrench: on the object in each step, table axes, about the centre of mass, shape (n_steps, 3, n) [N, N, N m].
            displacement: of the pusher in each step, table axes, shape (n_steps, 2, n) [m]; by default none.
        """
        chain, n, steps = self._run.chain, wrench.shape[2], self.steps
        cos, sin = chain.tape.heading[:-1][steps].T[:, :, None]
        x, y, turn = np.moveaxis(wrench, 1, 0)
        impulse, nearer = np.zeros((len(chain.dt), 3, n)), np.zeros((len(chain.dt), 2, n))
        impulse[steps, 0], impulse[steps, 1], impulse[steps, 2] = cos * x + sin * y, -sin * x + cos * y, turn
        impulse[steps] *= chain.dt[steps, None, None]
        if displacement is not None:
            nearer[steps] = displacement
        response, by_impulse = np.empty((len(chain.frames.step), 3, n)), np.empty((len(self._run.impulses.step), 2, n))
        chain_response(chain, impulse, nearer, response, self._run.impulses, by_impulse)
        measurement = self._run.measurement
        reported = response if measurement is None else np.einsum("fij,fjp->fip", measurement.by_pose, response)
        return reported, by_impulse


def simulate_body_with_response(
    shape: ObjectShape,
    body: BodyParameters,
    pusher_friction: float,
    scenario: PushScenario,
    *,
    settings: SimulationSettings | None = None,
    effects: EffectsLike | None = None,
) -> tuple[Motion, StepResponse | None]:
    """As `simulate_body`; also how poses and forces of the pusher change under small forces in any step. None where a simulation failed."""
    numerics, acting = settings or SimulationSettings(), effect_values(effects)
    run = _run(shape, body, pusher_friction, scenario, numerics, acting, True)
    if run.motion.status is SolveStatus.SIMULATION_FAILED:
        return run.motion, None
    chain = run.chain
    cos, sin = chain.tape.heading[:-1].T
    u, v, omega = chain.tape.twist.T
    twist = np.column_stack([cos * u - sin * v, sin * u + cos * v, omega]) * (chain.tape.event != Event.IDLE)[:, None]
    first = owned(scenario.pose_object_in_table)
    centre = first[:2] + np.array([[cos[0], -sin[0]], [sin[0], cos[0]]]) @ chain.centre
    start = np.append(centre, first[2])
    pose = start + np.vstack([np.zeros(3), np.cumsum(twist * chain.dt[:, None], axis=0)[:-1]])
    pusher = Timeline.of(scenario, numerics).path[:-1, :2]
    touches = np.any(run.motion.force != 0.0, axis=1)
    moved = np.flatnonzero(chain.tape.event != Event.IDLE)
    first_step = min(int(np.min(moved, initial=len(touches))), len(touches) - 2)
    steps = slice(first_step, min(max(int(np.max(moved, initial=0)), first_step) + 2, len(touches)))
    times, poses, twists = run.motion.force_time[steps], pose[steps], twist[steps]
    return run.motion, StepResponse(times, poses, twists, touches[steps], pusher[steps], chain.arms.T, body.limit, run, steps)


@dataclass(frozen=True, slots=True)
class Timeline:
    """The steps of a push, whatever the model and the first pose are."""

    clock: StepClock
    path: Float64Array
    """Pose of the pusher at the steps' ends, table frame, shape (n_steps + 1, 3)."""
    times: ReportTimes
    """When poses are reported, without effects."""
    impulses: Frames
    """When impulses are reported."""

    @classmethod
    def of(cls, scenario: PushScenario, settings: SimulationSettings) -> Timeline:
        """Steps until the pusher is at rest and the last pose is reported.

        The object is at rest before the first contact, so the clock starts with the pusher.
        """
        pusher, end = scenario.pusher, scenario.end
        if settings.resolve_events:
            clock = StepClock.through(pusher.time, end, settings.longest_step)
        else:
            clock = StepClock.of(float(pusher.time[0]), end, settings.longest_step)
        path = np.zeros((len(clock.ends), 3))
        for axis in (0, 1):
            path[:, axis] = np.interp(clock.ends, pusher.time, pusher.position[:, axis])
        if pusher.yaw is not None:
            path[:, 2] = np.interp(clock.ends, pusher.time, pusher.yaw)
        return cls(clock, path, ReportTimes.of(scenario.time, clock), clock.frames(scenario.force_time)[0])


class _Run(NamedTuple):
    """A simulated push, with what its derivative needs."""

    motion: Motion
    chain: Chain
    n_values: int
    measurement: Measurement | None
    """None where no effect is active."""
    impulses: Frames
    """When impulses are reported."""


def _run(
    shape: ObjectShape,
    body: BodyParameters,
    pusher_friction: float,
    scenario: PushScenario,
    settings: SimulationSettings,
    effects: EffectValues,
    derive: bool,
    timeline: Timeline | None = None,
) -> _Run:
    """Simulate, with what the derivative needs where `derive`."""
    check_body(shape, body, pusher_friction)
    mu, mu_by_value = _pusher_friction(float(pusher_friction), settings, effects)
    timeline = timeline or Timeline.of(scenario, settings)
    clock, path = timeline.clock, timeline.path
    arms = owned((shape.cells.centres - owned(body.centre)).T)
    active = None
    modes = owned(body.outline_modes) if derive else NO_MODES
    if len(effects) + len(modes) > 0:
        path, d_path = driven_path(effects, clock.dt, path, scenario.order)
        active = active_effects(effects, d_path, arms, shape.cells, scenario.order, modes)
    times = timeline.times.with_effects(scenario.time, effects)
    push = _push(shape, body, mu, scenario, path, arms)
    impulses = timeline.impulses
    pose, force, tape, status = _roll(push, settings, clock, active, times.simulated, derive, len(scenario.force_time) > 0)
    measurement = None
    if len(effects) > 0:
        pose, measurement = Measurement.of(effects, times, pose, mu_by_value, len(modes))
    impulse = np.full((len(scenario.force_time), 2), np.nan)
    if len(impulse) > 0 and status is not SolveStatus.SIMULATION_FAILED:
        # A step counts as far as it has gone.
        of_step = force * clock.lengths[:, None]
        before = np.vstack([np.zeros(2), np.cumsum(of_step, axis=0)])
        impulse = np.asarray(before[impulses.step] + impulses.fraction[:, None] * of_step[impulses.step])
    no_derivative = np.empty((len(scenario.time), 3, 0)), np.empty((len(scenario.force_time), 2, 0))
    motion = Motion(scenario.time, pose, no_derivative[0], clock.middles, force, status, impulse, force[impulses.step], no_derivative[1])
    diamond = settings.friction_cone == "pyramid"
    eps = FINAL_NU if diamond else settings.smoothing_speed
    chain = Chain(tape, push.centre, push.arms, diamond, eps, clock.lengths, times.frames, force)
    return _Run(motion, chain, len(effects) + len(modes), measurement, impulses)


def _pusher_friction(coefficient: float, settings: SimulationSettings, effects: EffectValues) -> tuple[float, Float64Array]:
    """The pusher's friction coefficient under the effects, and its derivative by their values. Refuses effects without a law here."""
    if len(effects) == 0:
        return coefficient, np.zeros(0)
    for effect in effects.effects:
        if isinstance(effect.acts, OnTable) and settings.friction_cone != "circle":
            raise InputError(
                f"The effect {effect.name} needs the circular cone, got friction_cone={settings.friction_cone!r}; take 'circle'."
            )
        if effect.needs_inertia and settings.quasi_static:
            raise InputError(f"The effect {effect.name} has no meaning without inertia, got quasi_static=True; take False.")
    mu, mu_by_value = changed_friction(effects, coefficient)
    if mu < 0:
        raise InputError(f"The effects make the pusher's friction coefficient {mu:.3g}, expected a number >= 0.")
    return mu, mu_by_value


def _push(shape: ObjectShape, body: BodyParameters, mu: float, scenario: PushScenario, path: Float64Array, arms: Float64Array) -> Push:
    """The push in arrays."""
    return Push(
        pose=owned(scenario.pose_object_in_table),
        pusher=path,
        corners=owned(scenario.pusher.shape.core),
        radius=float(scenario.pusher.radius),
        outline=owned(shape.outline),
        arms=arms,
        limit=owned(body.limit),
        centre=owned(body.centre),
        inertia=np.array([body.mass, body.mass, body.inertia]),
        mu=mu,
        separate=scenario.pusher.fingers is not None,
    )


def _roll(
    push: Push, settings: SimulationSettings, clock: StepClock, active: ActiveEffects | None, frames: Frames, derive: bool, forces: bool
) -> tuple[Float64Array, Float64Array, Tape, SolveStatus]:
    """The rollout: poses at the frames (NaN where it failed), force of the pusher at each step, tape, status."""
    n_steps, n_cells = clock.n_steps, push.arms.shape[1]
    diamond, quasi_static = settings.friction_cone == "pyramid", settings.quasi_static
    numerics = Numerics(clock.lengths, settings.smoothing_speed, diamond, quasi_static, settings.resolve_events)
    tape = new_tape(n_steps if derive else 0, forces=forces)
    if active is not None:
        n_loaded, n_sums = n_cells if active.loads else 0, N_SUMS if active.shifts else 0
        tape = new_tape(n_steps if derive else 0, n_loaded, active.n_memory, len(active.values), n_sums, skewed=active.skews, forces=forces)
    pose, force = np.empty((len(frames.step), 3)), np.empty((n_steps, 2))
    scratch = None if active is None else new_effect_scratch(n_cells, active)
    failed_at, _ = rollout(push, numerics, active, None, frames, pose, force, tape, scratch)
    if failed_at >= 0:
        pose[:] = np.nan
        return pose, force, tape, SolveStatus.SIMULATION_FAILED
    return pose, force, tape, SolveStatus.CONVERGED if np.any(force) else SolveStatus.NO_CONTACT
