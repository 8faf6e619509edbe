"""Simulate a push of an object model: the Python face of the compiled rollout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import InputError
from push_ident.physics.contact import count_inside
from push_ident.physics.pyramid import FINAL_NU
from push_ident.physics.rollout import N_BODY_PARAMETERS, Numerics, Push, new_rollout_scratch, rollout
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
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

__all__ = [
    "GRAVITY", "BodyParameters", "Motion", "ModelGradient", "PoseLoss", "PullBack", "SimulationSettings",
    "body_of_cells", "cell_gradient", "compile_kernels", "loss_gradient", "simulate", "simulate_body", "simulate_body_with_pullback",
]  # fmt: skip

GRAVITY = 9.81
"""[m/s^2]"""

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
    """d pose / d (first pose (3), mass, centre of mass (2), inertia, pusher friction, limit of each cell),
    shape (n_frames, 3, 8 + n_cells); (n_frames, 3, 0) when it was not asked for. NaN where the simulation failed."""
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
        gradient: by the columns of `Motion.jacobian`, shape (..., 8 + n_cells).

    Returns:
        Gradients by the mass [1/kg] and by the friction coefficient of each cell, each of shape (..., n_cells).
    """
    total = float(np.sum(mass))
    centre = mass @ shape.cells.centres / total
    by_limit = gradient[..., PARAM_LIMIT:]
    by_mass = (
        gradient[..., PARAM_MASS, None]
        + gradient[..., PARAM_CENTRE : PARAM_CENTRE + 2] @ ((shape.cells.centres - centre) / total).T
        # The centre moves too, but about the centre of mass the inertia does not change with that.
        + gradient[..., PARAM_INERTIA, None] * _moments(shape, centre)
        + by_limit * (friction * GRAVITY)
    )
    return by_mass, by_limit * (mass * GRAVITY)


def compile_kernels() -> None:
    """Compile (or load from the cache) all kernels, so that the first push need not wait for it: seconds once, else a moment."""
    square = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])
    shape = ObjectShape(CellGrid(np.zeros((1, 2)), 0.02), square)
    body = BodyParameters(0.1, np.zeros(2), 1e-5, np.array([0.3]))
    pusher = PusherPath(np.array([0.0, 0.1]), np.array([[-0.02, 0.0], [0.0, 0.0]]), 0.005)
    arguments = (shape, body, 0.3, pusher, np.zeros(3), np.array([0.0, 0.1]))
    simulate_body(*arguments, jacobian=True)
    _, pull_back = simulate_body_with_pullback(*arguments)
    pull_back(np.zeros((2, 3)))


def simulate(
    model: ObjectModel,
    pusher: PusherPath,
    pose_object_in_table: Float64Array,
    time: Float64Array,
    *,
    settings: SimulationSettings | None = None,
    jacobian: bool = False,
) -> Motion:
    """Motion of an object at rest while a pusher moves along its path.

    Args:
        model: mechanics of the object.
        pusher: path of the pusher. Before its first and after its last sample the pusher stands still.
        pose_object_in_table: first pose (x, y, yaw), shape (3,).
        time: when to report the pose [s], ascending, on the clock of `pusher`, shape (n_frames,).
        settings: numerics.
        jacobian: also the derivative of the poses.

    Returns:
        The motion; look at its `status`.

    Raises:
        InputError: a pose, times or values of the body that are not finite or have another shape, times that do not ascend, negative
            friction, no mass, or an outline that holds less than half of the cells.
    """
    body = body_of_cells(model.shape, model.mass, model.friction)
    return simulate_body(model.shape, body, model.pusher_friction, pusher, pose_object_in_table, time, settings=settings, jacobian=jacobian)


def loss_gradient(
    model: ObjectModel,
    pusher: PusherPath,
    pose_object_in_table: Float64Array,
    time: Float64Array,
    loss: PoseLoss,
    *,
    settings: SimulationSettings | None = None,
) -> ModelGradient:
    """Loss of a simulated push and its exact gradient with respect to the mass and friction of every cell, by the adjoint method.

    The cost is that of one simulation and one pass back over its steps, whatever the number of cells that are asked about.

    Args:
        loss: of the poses at `time`.

    The other arguments are those of `simulate`.
    """
    body = body_of_cells(model.shape, model.mass, model.friction)
    motion, pull_back = simulate_body_with_pullback(
        model.shape, body, model.pusher_friction, pusher, pose_object_in_table, time, settings=settings
    )
    value, by_pose = loss(motion.pose)
    gradient = pull_back(by_pose)
    by_mass, by_friction = cell_gradient(model.shape, model.mass, model.friction, gradient)
    return ModelGradient(
        float(value), by_mass, by_friction, float(gradient[PARAM_MU]), gradient[PARAM_POSE : PARAM_POSE + 3], motion
    )  # fmt: skip


def simulate_body(
    shape: ObjectShape,
    body: BodyParameters,
    pusher_friction: float,
    pusher: PusherPath,
    pose_object_in_table: Float64Array,
    time: Float64Array,
    *,
    settings: SimulationSettings | None = None,
    jacobian: bool = False,
) -> Motion:
    """As `simulate`, for the rigid body alone."""
    run = _run(shape, body, pusher_friction, pusher, pose_object_in_table, time, settings or SimulationSettings(), jacobian)
    if not jacobian:
        return run.motion
    derivative = np.full((len(run.motion.time), 3, N_BODY_PARAMETERS + len(shape.cells)), np.nan)
    if run.motion.status is not SolveStatus.SIMULATION_FAILED:
        chain_forward(*run.chain, derivative)
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
            d loss / d (first pose (3), mass, centre of mass (2), inertia, pusher friction, limit of each cell), shape (8 + n_cells,): the
            transposed `Motion.jacobian` times `by_pose`, without the Jacobian. NaN where the simulation failed.

        Raises:
            InputError: `by_pose` has another shape.
        """
        motion = self._run.motion
        by_pose = _owned(by_pose)
        if by_pose.shape != motion.pose.shape:
            raise InputError(f"`by_pose` has shape {by_pose.shape}, expected {motion.pose.shape} as the poses.")
        gradient = np.full(N_BODY_PARAMETERS + self._run.chain.arms.shape[1], np.nan)
        if motion.status is not SolveStatus.SIMULATION_FAILED:
            chain_backward(*self._run.chain, by_pose, gradient)
        return gradient


def simulate_body_with_pullback(
    shape: ObjectShape,
    body: BodyParameters,
    pusher_friction: float,
    pusher: PusherPath,
    pose_object_in_table: Float64Array,
    time: Float64Array,
    *,
    settings: SimulationSettings | None = None,
) -> tuple[Motion, PullBack]:
    """As `simulate_body`; also what carries a gradient by the poses back to the parameters."""
    run = _run(shape, body, pusher_friction, pusher, pose_object_in_table, time, settings or SimulationSettings(), True)
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


class _Run(NamedTuple):
    motion: Motion
    chain: _Chain


def _owned(values: ArrayLike) -> Float64Array:
    """A writable copy in C order: numba would compile every kernel once more for arrays that are read-only or laid out otherwise."""
    return np.array(values, dtype=np.float64, order="C")


def _run(
    shape: ObjectShape,
    body: BodyParameters,
    pusher_friction: float,
    pusher: PusherPath,
    pose_object_in_table: Float64Array,
    time: Float64Array,
    settings: SimulationSettings,
    derive: bool,
) -> _Run:
    """Simulate, with what the derivative needs where `derive`."""
    time = np.asarray(time, dtype=np.float64)
    pose0 = _owned(pose_object_in_table)
    if pose0.shape != (3,) or not np.all(np.isfinite(pose0)):
        raise InputError(f"The first pose is {pose0}, expected three finite numbers (x, y, yaw).")
    if time.ndim != 1 or len(time) == 0 or not np.all(np.isfinite(time)) or np.any(np.diff(time) < 0):
        raise InputError("The times to report must be finite and ascend; sort them first.")
    _check_body(shape, body, pusher_friction)

    # The object is at rest until it is touched, so the clock starts with the pusher.
    start = float(pusher.time[0])
    n_steps = max(1, int(np.ceil((max(float(time[-1]), float(pusher.time[-1])) - start) / settings.step)))
    clock = start + settings.step * np.arange(n_steps + 1)
    path = np.zeros((n_steps + 1, 3))
    for axis in (0, 1):
        path[:, axis] = np.interp(clock, pusher.time, pusher.position[:, axis])
    if pusher.yaw is not None:
        path[:, 2] = np.interp(clock, pusher.time, pusher.yaw)
    at = np.clip((time - start) / settings.step, 0.0, n_steps)
    frame_step = np.minimum(at.astype(np.int64), n_steps - 1)
    corners = np.zeros((1, 2)) if pusher.polygon is None else _owned(pusher.polygon)
    centre = _owned(body.centre)
    push = Push(
        pose=pose0,
        pusher=path,
        corners=corners,
        radius=float(pusher.radius),
        outline=_owned(shape.outline),
        arms=_owned((shape.cells.centres - centre).T),
        limit=_owned(body.limit),
        centre=centre,
        inertia=np.array([body.mass, body.mass, body.inertia]),
        mu=float(pusher_friction),
    )
    diamond = settings.friction_cone == "pyramid"
    numerics = Numerics(settings.step, settings.smoothing_speed, diamond, settings.quasi_static)
    pose = np.empty((len(time), 3))
    force = np.empty((n_steps, 2))
    tape = new_tape(n_steps if derive else 0)
    scratch = new_rollout_scratch(len(shape.cells) if diamond else 0, len(corners), len(shape.outline))
    failed_at, _ = rollout(push, numerics, frame_step, at - frame_step, derive, pose, force, tape, scratch)
    if failed_at >= 0:
        status = SolveStatus.SIMULATION_FAILED
        pose[:] = np.nan
    else:
        status = SolveStatus.CONVERGED if np.any(force) else SolveStatus.NO_CONTACT
    middle = np.asarray(clock[:-1] + settings.step / 2, dtype=np.float64)
    motion = Motion(time, pose, np.empty((len(time), 3, 0)), middle, force, status)
    eps = FINAL_NU if diamond else settings.smoothing_speed
    return _Run(motion, _Chain(tape, centre, push.arms, diamond, eps, settings.step, frame_step, at - frame_step))


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
