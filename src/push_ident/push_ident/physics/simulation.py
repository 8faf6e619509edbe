"""Simulate a push of an object model: the Python face of the compiled rollout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import InputError
from push_ident.physics.contact import count_inside
from push_ident.physics.effect import OnTable
from push_ident.physics.effect_values import (
    EffectsLike,
    EffectValues,
    active_effects,
    changed_friction,
    driven_path,
    effect_values,
    seen_poses,
    seen_times,
)
from push_ident.physics.pyramid import FINAL_NU
from push_ident.physics.rollout import N_BODY_PARAMETERS, Numerics, Push, new_rollout_scratch, rollout
from push_ident.physics.scenario import PushScenario
from push_ident.physics.sensitivity import (
    PARAM_CENTRE,
    PARAM_INERTIA,
    PARAM_LIMIT,
    PARAM_MASS,
    PARAM_MU,
    PARAM_POSE,
    Tape,
    chain_backward,
    chain_forward,
    new_tape,
)
from push_ident.physics.support import GRAVITY
from push_ident.physics.table import N_SUMS
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

__all__ = [
    "GRAVITY", "BodyParameters", "Motion", "ModelGradient", "PoseLoss", "PullBack", "SimulationSettings",
    "body_of_cells", "cell_gradient", "compile_kernels", "loss_gradient", "simulate", "simulate_body", "simulate_body_with_pullback",
]  # fmt: skip

PoseLoss = Callable[[Float64Array], tuple[float, Float64Array]]
"""Takes the poses at the frames, shape (n_frames, 3), and gives the loss and its derivative by them, same shape."""


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """How a push is simulated."""

    step: float = 1.0 / 240.0
    """Length of a time step [s]."""
    smoothing_speed: float = 1e-4
    """Speed below which the support friction of a cell grows linearly [m/s]; the circular cone alone has it."""
    friction_cone: Literal["circle", "pyramid"] = "circle"
    """Support friction of a cell: Coulomb's circular cone, or the paper's pyramid in table axes, solved without smoothing."""
    quasi_static: bool = False
    """Leave inertia out: the object moves only while it is pushed, and its path does not depend on the pusher's speed."""

    def __post_init__(self) -> None:
        for name in ("step", "smoothing_speed"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"SimulationSettings.{name} is {value}, expected a positive number.")
        if self.friction_cone not in ("circle", "pyramid"):
            raise InputError(f"SimulationSettings.friction_cone is {self.friction_cone!r}, expected 'circle' or 'pyramid'.")
        if self.quasi_static and self.friction_cone == "pyramid":
            raise InputError(
                "A quasi-static push with the friction pyramid has no unique motion: many directions meet the same corner of the "
                "limit surface. Take friction_cone='circle' with quasi_static=True."
            )


@dataclass(frozen=True, slots=True)
class BodyParameters:
    """What the motion of a rigid object on a table depends on."""

    mass: float
    """[kg]"""
    centre: Float64Array
    """Centre of mass [m], shape (2,), object frame."""
    inertia: float
    """About the centre of mass [kg m^2]."""
    limit: Float64Array
    """Friction force of each cell when it slides [N], shape (n_cells,)."""


@dataclass(frozen=True, slots=True)
class Motion:
    """A simulated push."""

    time: Float64Array
    """Asked for [s], shape (n_frames,)."""
    pose: Float64Array
    """Of the object frame in the table frame, shape (n_frames, 3), yaw not wrapped. NaN where the simulation failed."""
    jacobian: Float64Array
    """d pose / d (first pose (3), mass, centre of mass (2), inertia, pusher friction, limit of each cell, values of the active effects),
    shape (n_frames, 3, 8 + n_cells + n_values), the values in the order of `EffectValues.labels`; (n_frames, 3, 0) when it was not
    asked for. NaN where the simulation failed."""
    force_time: Float64Array
    """Middle of each step [s], shape (n_steps,)."""
    force: Float64Array
    """Of the pusher on the object [N], shape (n_steps, 2), table frame."""
    status: SolveStatus
    """CONVERGED, NO_CONTACT (the pusher never touches) or SIMULATION_FAILED."""


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


def body_of_cells(shape: ObjectShape, mass: Float64Array, friction: Float64Array) -> BodyParameters:
    """Rigid body made of the cells: square plates that each rest on their own weight.

    Args:
        shape: cells of the object.
        mass: of each cell [kg], shape (n_cells,), >= 0 and not all zero.
        friction: support friction coefficient of each cell, shape (n_cells,), >= 0.

    Raises:
        InputError: values of another shape, not finite, negative, or without any mass.
    """
    mass, friction = np.asarray(mass, dtype=np.float64), np.asarray(friction, dtype=np.float64)
    n_cells = len(shape.cells)
    for name, value in (("mass", mass), ("friction", friction)):
        if value.shape != (n_cells,):
            raise InputError(f"`{name}` has shape {value.shape}, expected ({n_cells},), a value for each cell of the object.")
        if not np.all(np.isfinite(value) & (value >= 0)):
            raise InputError(f"`{name}` has {int(np.sum(~(np.isfinite(value) & (value >= 0))))} cells that are not numbers >= 0.")
    centres = shape.cells.centres
    total = float(np.sum(mass))
    if total <= 0:
        raise InputError(f"The {n_cells} cells weigh {total} kg together; a body that moves needs mass > 0 in one cell at least.")
    centre = mass @ centres / total
    inertia = float(mass @ _moments(shape, centre))
    return BodyParameters(mass=total, centre=centre, inertia=inertia, limit=friction * mass * GRAVITY)


def _moments(shape: ObjectShape, centre: Float64Array) -> Float64Array:
    """Moment of inertia about `centre` of each cell per mass [m^2], shape (n_cells,)."""
    return np.sum((shape.cells.centres - centre) ** 2, axis=1) + shape.cells.size**2 / 6


def cell_gradient(
    shape: ObjectShape, mass: Float64Array, friction: Float64Array, gradient: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Chain a gradient by the body's parameters to the cells: the transposed derivative of `body_of_cells`.

    Args:
        shape, mass, friction: as for `body_of_cells`.
        gradient: by the columns of `Motion.jacobian`, shape (..., 8 + n_cells + n_values).

    Returns:
        Gradients by the mass [1/kg] and by the friction coefficient of each cell, each of shape (..., n_cells).
    """
    total = float(np.sum(mass))
    centre = mass @ shape.cells.centres / total
    by_limit = gradient[..., PARAM_LIMIT : PARAM_LIMIT + len(mass)]
    by_mass = (
        gradient[..., PARAM_MASS, None]
        + gradient[..., PARAM_CENTRE : PARAM_CENTRE + 2] @ ((shape.cells.centres - centre) / total).T
        # The centre moves too, but about the centre of mass the inertia does not change with that.
        + gradient[..., PARAM_INERTIA, None] * _moments(shape, centre)
        + by_limit * (friction * GRAVITY)
    )
    return by_mass, by_limit * (mass * GRAVITY)


def compile_kernels(*, effects: bool = False) -> None:
    """Compile (or load from the cache) all kernels, so that the first push need not wait for it: a minute once, else a moment.

    Args:
        effects: those for pushes with effects as well, which are another set.
    """
    square = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])
    shape = ObjectShape(CellGrid(np.zeros((1, 2)), 0.02), square)
    body = BodyParameters(0.1, np.zeros(2), 1e-5, np.array([0.3]))
    pusher = PusherPath(np.array([0.0, 0.1]), np.array([[-0.02, 0.0], [0.0, 0.0]]), 0.005)
    arguments = (shape, body, 0.3, PushScenario(pusher, np.zeros(3), np.array([0.0, 0.1])))
    simulate_body(*arguments, jacobian=True)
    _, pull_back = simulate_body_with_pullback(*arguments)
    pull_back(np.zeros((2, 3)))
    if effects:
        simulate_body(*arguments, effects=["pusher_lag"], jacobian=True)


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
        effects: effects beside the base model (`effects/`, docs/effects.md): by name, each with its values in order or by name. The
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

    The cost is that of one simulation and one pass back over its steps, whatever the number of cells that are asked about.

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
        float(value), by_mass, by_friction, float(gradient[PARAM_MU]), gradient[PARAM_POSE : PARAM_POSE + 3],
        gradient[PARAM_LIMIT + len(model.mass) :], motion,
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
) -> Motion:
    """As `simulate`, for the rigid body alone."""
    acting = effect_values(effects)
    run = _run(shape, body, pusher_friction, scenario, settings or SimulationSettings(), acting, jacobian)
    if not jacobian:
        return run.motion
    derivative = np.full((len(run.motion.time), 3, N_BODY_PARAMETERS + len(shape.cells) + len(acting)), np.nan)
    if run.motion.status is not SolveStatus.SIMULATION_FAILED:
        chain_forward(*run.chain, derivative)
        if run.measurement is not None:
            derivative = run.measurement.of_jacobian(derivative)
    motion = run.motion
    return Motion(motion.time, motion.pose, derivative, motion.force_time, motion.force, motion.status)


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
        by_pose = _owned(by_pose)
        if by_pose.shape != motion.pose.shape:
            raise InputError(f"`by_pose` has shape {by_pose.shape}, expected {motion.pose.shape} as the poses.")
        chain, measurement = self._run.chain, self._run.measurement
        gradient = np.full(N_BODY_PARAMETERS + chain.arms.shape[1] + self._run.n_values, np.nan)
        if motion.status is not SolveStatus.SIMULATION_FAILED:
            chain_backward(*chain, by_pose if measurement is None else measurement.by_true_pose(by_pose), gradient)
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


class _Chain(NamedTuple):
    """Arguments that `chain_forward` and `chain_backward` have in common."""

    tape: Tape
    centre: Float64Array
    arms: Float64Array
    diamond: bool
    eps: float
    dt: float
    frame_step: NDArray[np.int64]
    frame_fraction: Float64Array


@dataclass(frozen=True, slots=True)
class _Measurement:
    """How reported poses depend on the true ones at the times when they were seen, and on effects outside the rollout."""

    by_pose: Float64Array
    """Shape (n_frames, 3, 3)."""
    by_value: Float64Array
    """Shape (n_frames, 3, n_values)."""
    mu_by_value: Float64Array
    """Of the pusher's friction coefficient, shape (n_values,)."""

    def of_jacobian(self, jacobian: Float64Array) -> Float64Array:
        """That of the reported poses from that of the true ones."""
        n_values = len(self.mu_by_value)
        jacobian[:, :, -n_values:] += jacobian[:, :, PARAM_MU, None] * self.mu_by_value
        reported: Float64Array = self.by_pose @ jacobian
        reported[:, :, -n_values:] += self.by_value
        return reported

    def by_true_pose(self, by_pose: Float64Array) -> Float64Array:
        """Gradient by the true poses from that by the reported ones."""
        return np.einsum("fij,fi->fj", self.by_pose, by_pose)

    def add_gradient(self, by_pose: Float64Array, gradient: Float64Array) -> None:
        """Add the values' own part to the gradient of a loss."""
        n_values = len(self.mu_by_value)
        gradient[-n_values:] += gradient[PARAM_MU] * self.mu_by_value + np.einsum("fiv,fi->v", self.by_value, by_pose)


class _Run(NamedTuple):
    motion: Motion
    chain: _Chain
    n_values: int
    measurement: _Measurement | None
    """None where no effect is active."""


def _owned(values: ArrayLike) -> Float64Array:
    """A writable copy in C order: numba would compile every kernel once more for arrays that are read-only or laid out otherwise."""
    return np.array(values, dtype=np.float64, order="C")


def _run(
    shape: ObjectShape,
    body: BodyParameters,
    pusher_friction: float,
    scenario: PushScenario,
    settings: SimulationSettings,
    effects: EffectValues,
    derive: bool,
) -> _Run:
    """Simulate, with what the derivative needs where `derive`."""
    pusher, time = scenario.pusher, scenario.time
    _check_body(shape, body, pusher_friction)
    n_values, mu = len(effects), float(pusher_friction)
    if n_values > 0:
        _check_effects(effects, settings)
        mu, mu_by_value = changed_friction(effects, mu)
        if mu < 0:
            raise InputError(f"The effects make the pusher's friction coefficient {mu:.3g}, expected a number >= 0.")

    # The object is at rest until it is touched, so the clock starts with the pusher.
    start = float(pusher.time[0])
    n_steps = max(1, int(np.ceil((max(float(time[-1]), float(pusher.time[-1])) - start) / settings.step)))
    clock = start + settings.step * np.arange(n_steps + 1)
    path = np.zeros((n_steps + 1, 3))
    for axis in (0, 1):
        path[:, axis] = np.interp(clock, pusher.time, pusher.position[:, axis])
    if pusher.yaw is not None:
        path[:, 2] = np.interp(clock, pusher.time, pusher.yaw)
    centre = _owned(body.centre)
    arms = _owned((shape.cells.centres - centre).T)
    active, seen_at = None, time
    if n_values > 0:
        path, d_path = driven_path(effects, settings.step, path)
        active = active_effects(effects, d_path, arms, float(shape.cells.size), scenario.order)
        seen_at, seen_at_by_value = seen_times(effects, time)
    at = np.clip((seen_at - start) / settings.step, 0.0, n_steps)
    frame_step = np.minimum(at.astype(np.int64), n_steps - 1)
    frame_fraction = at - frame_step
    corners = np.zeros((1, 2)) if pusher.polygon is None else _owned(pusher.polygon)
    push = Push(
        pose=_owned(scenario.pose_object_in_table),
        pusher=path,
        corners=corners,
        radius=float(pusher.radius),
        outline=_owned(shape.outline),
        arms=arms,
        limit=_owned(body.limit),
        centre=centre,
        inertia=np.array([body.mass, body.mass, body.inertia]),
        mu=mu,
    )
    diamond = settings.friction_cone == "pyramid"
    numerics = Numerics(settings.step, settings.smoothing_speed, diamond, settings.quasi_static)
    wanted_step, wanted_fraction = frame_step, frame_fraction
    delayed = n_values > 0 and bool(np.any(seen_at_by_value))
    if delayed:
        # The ends of each frame's step as well, for the velocity.
        wanted_step = np.repeat(frame_step, 3)
        wanted_fraction = np.column_stack([np.zeros_like(at), np.ones_like(at), frame_fraction]).ravel()
    pose = np.empty((len(wanted_step), 3))
    force = np.empty((n_steps, 2))
    tape = new_tape(n_steps if derive else 0)
    if active is not None:
        n_cells, n_sums = len(shape.cells) if active.loads else 0, N_SUMS if active.shifts else 0
        tape = new_tape(n_steps if derive else 0, n_cells, active.n_memory, n_values, n_sums, skewed=active.skews)
    scratch = new_rollout_scratch(len(shape.cells), len(corners), len(shape.outline), active, diamond=diamond)
    failed_at, _ = rollout(push, numerics, active, wanted_step, wanted_fraction, derive, pose, force, tape, scratch)
    if failed_at >= 0:
        status = SolveStatus.SIMULATION_FAILED
        pose[:] = np.nan
    else:
        status = SolveStatus.CONVERGED if np.any(force) else SolveStatus.NO_CONTACT
    measurement = None
    if n_values > 0:
        by_time = np.zeros((len(time), 3))
        if delayed:
            moves = (at > 0.0) & (at < n_steps)
            by_time = (pose[1::3] - pose[::3]) / settings.step * moves[:, None]
            pose = np.ascontiguousarray(pose[2::3])
        pose, by_pose, by_value = seen_poses(effects, pose)
        by_value += np.einsum("fij,fj,vf->vfi", by_pose, by_time, seen_at_by_value)
        measurement = _Measurement(by_pose, np.moveaxis(by_value, 0, 2), mu_by_value)
    middle = np.asarray(clock[:-1] + settings.step / 2, dtype=np.float64)
    motion = Motion(time, pose, np.empty((len(time), 3, 0)), middle, force, status)
    eps = FINAL_NU if diamond else settings.smoothing_speed
    return _Run(motion, _Chain(tape, centre, push.arms, diamond, eps, settings.step, frame_step, frame_fraction), n_values, measurement)


def _check_body(shape: ObjectShape, body: BodyParameters, pusher_friction: float) -> None:
    """Refuse what no simulation can make sense of."""
    if not (np.isfinite(body.mass) and body.mass > 0 and np.isfinite(body.inertia) and body.inertia > 0):
        raise InputError(f"The body has mass {body.mass} kg and inertia {body.inertia} kg m^2, expected positive numbers.")
    if np.shape(body.centre) != (2,) or not np.all(np.isfinite(body.centre)):
        raise InputError(f"The body's centre of mass is {body.centre}, expected two finite numbers in metres.")
    n_inside = count_inside(_owned(shape.cells.centres), _owned(shape.outline))
    # Outlines are traced and straightened: a few centres at the rim may lie outside.
    if 2 * n_inside < len(shape.cells):
        raise InputError(
            f"{n_inside} of {len(shape.cells)} cell centres lie inside the outline, expected at least half; "
            "give cells and outline in the same frame, in metres."
        )
    limit = np.asarray(body.limit)
    if limit.shape != (len(shape.cells),):
        raise InputError(f"The body's friction limits have shape {limit.shape}, expected ({len(shape.cells)},) as the cells.")
    if not np.all(np.isfinite(limit) & (limit >= 0)):
        raise InputError(f"{int(np.sum(~(np.isfinite(limit) & (limit >= 0))))} friction limits of cells are not forces >= 0 N.")
    if not (np.isfinite(pusher_friction) and pusher_friction >= 0):
        raise InputError(f"The pusher's friction coefficient is {pusher_friction}, expected a number >= 0.")


def _check_effects(effects: EffectValues, settings: SimulationSettings) -> None:
    """Refuse effects that the numerics have no law for."""
    for effect in effects.effects:
        if isinstance(effect.acts, OnTable) and settings.friction_cone != "circle":
            raise InputError(
                f"The effect {effect.name} needs the circular cone, got friction_cone={settings.friction_cone!r}; take 'circle'."
            )
        if effect.needs_inertia and settings.quasi_static:
            raise InputError(f"The effect {effect.name} means nothing without inertia, got quasi_static=True; take False.")
