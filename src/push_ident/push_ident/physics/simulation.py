"""Simulate a push of an object model: the Python face of the compiled rollout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.physics.rollout import N_BODY_PARAMETERS, rollout
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

__all__ = ["GRAVITY", "BodyParameters", "Motion", "SimulationSettings", "body_of_cells", "compile_kernels", "simulate", "simulate_body"]

GRAVITY = 9.81
"""[m/s^2]"""


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """Numerics of the simulation; none of them is physics, so halving them must change nothing that matters."""

    step: float = 1.0 / 240.0
    """Length of a time step [s]."""
    smoothing_speed: float = 1e-4
    """Speed below which the support friction of a cell grows linearly [m/s]."""

    def __post_init__(self) -> None:
        for name in ("step", "smoothing_speed"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"SimulationSettings.{name} is {value}, expected a positive number.")


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
    shape (n_frames, 3, 8 + n_cells); (n_frames, 3, 0) when it was not asked for."""
    force_time: Float64Array
    """Middle of each step [s], shape (n_steps,)."""
    force: Float64Array
    """Of the pusher on the object [N], shape (n_steps, 2), table frame."""
    status: SolveStatus
    """CONVERGED, NO_CONTACT (the pusher never touches) or SIMULATION_FAILED."""


def body_of_cells(shape: ObjectShape, mass: Float64Array, friction: Float64Array) -> BodyParameters:
    """Rigid body made of the cells: square plates that each rest on their own weight.

    Args:
        shape: cells of the object.
        mass: of each cell [kg], shape (n_cells,).
        friction: support friction coefficient of each cell, shape (n_cells,).
    """
    centres = shape.cells.centres
    total = float(np.sum(mass))
    centre = mass @ centres / total
    inertia = float(np.sum(mass * (np.sum((centres - centre) ** 2, axis=1) + shape.cells.size**2 / 6)))
    return BodyParameters(mass=total, centre=centre, inertia=inertia, limit=friction * mass * GRAVITY)


def compile_kernels() -> None:
    """Compile (or load from the cache) all kernels, so that the first push need not wait for it: seconds once, else a moment."""
    square = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])
    shape = ObjectShape(CellGrid(np.zeros((1, 2)), 0.02), square)
    body = BodyParameters(0.1, np.zeros(2), 1e-5, np.array([0.3]))
    pusher = PusherPath(np.array([0.0, 0.1]), np.array([[-0.02, 0.0], [0.0, 0.0]]), 0.005)
    simulate_body(shape, body, 0.3, pusher, np.zeros(3), np.array([0.0, 0.1]), jacobian=True)


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
        InputError: poses or times that are not finite, or times that do not ascend.
    """
    body = body_of_cells(model.shape, model.mass, model.friction)
    return simulate_body(model.shape, body, model.pusher_friction, pusher, pose_object_in_table, time, settings=settings, jacobian=jacobian)


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
    settings = settings or SimulationSettings()
    time = np.asarray(time, dtype=np.float64)
    pose0 = np.asarray(pose_object_in_table, dtype=np.float64)
    if pose0.shape != (3,) or not np.all(np.isfinite(pose0)):
        raise InputError(f"The first pose is {pose0}, expected three finite numbers (x, y, yaw).")
    if time.ndim != 1 or len(time) == 0 or not np.all(np.isfinite(time)) or np.any(np.diff(time) < 0):
        raise InputError("The times to report must be finite and ascend; sort them first.")

    # The object is at rest until it is touched, so the clock starts with the pusher.
    start = float(pusher.time[0])
    n_steps = max(1, int(np.ceil((max(float(time[-1]), float(pusher.time[-1])) - start) / settings.step)))
    clock = start + settings.step * np.arange(n_steps + 1)
    path: Float64Array = np.column_stack([np.interp(clock, pusher.time, pusher.position[:, axis]) for axis in (0, 1)])
    at = np.clip((time - start) / settings.step, 0.0, n_steps)
    frame_step = np.minimum(at.astype(np.int64), n_steps - 1)
    n_cells = len(shape.cells)
    pose = np.empty((len(time), 3))
    derivative = np.empty((len(time), 3, N_BODY_PARAMETERS + n_cells if jacobian else 0))
    force = np.empty((n_steps, 2))
    failed_at, _ = rollout(
        pose0,
        path,
        pusher.radius,
        shape.outline,
        shape.cells.centres,
        np.ascontiguousarray(body.limit),
        np.array([body.mass, *body.centre, body.inertia]),
        pusher_friction,
        settings.step,
        settings.smoothing_speed,
        frame_step,
        at - frame_step,
        jacobian,
        pose,
        derivative,
        force,
    )
    if failed_at >= 0:
        status = SolveStatus.SIMULATION_FAILED
        pose[:] = np.nan
    else:
        status = SolveStatus.CONVERGED if np.any(force) else SolveStatus.NO_CONTACT
    middle = np.asarray(clock[:-1] + settings.step / 2, dtype=np.float64)
    return Motion(time, pose, derivative, middle, force, status)
