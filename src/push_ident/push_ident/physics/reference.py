"""The paper's pushing engine: pushes simulated by its LCP, a batch at a time.

The engine is slow and simple. It verifies the compiled engine, and torch alone differentiates it. `reference_step.py` has the equations.

It shares these rules with the compiled engine. Friction of the pusher acts at the nearest contact; a second one (a concave corner) is
frictionless. Contacts out of reach take no part. An overlap closes at a limited speed. The pose advances in the state of the centre of
mass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from push_ident.errors import InputError
from push_ident.physics.contact import MAX_DISC_CONTACTS, REACH, Field, Kind, find_contacts, max_candidates
from push_ident.physics.contact_rows import RECOVERY_SPEED
from push_ident.physics.lcp import LcpStatus
from push_ident.physics.reference_step import StepProblem, reference_step, rotated, turned
from push_ident.physics.simulation import GRAVITY, SimulationSettings
from push_ident.types import BoolArray, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus


@dataclass(frozen=True, slots=True)
class ReferenceModel:
    """Quantities that identification may change. Tensors are float64 and may require gradients. The batch dimension is optional."""

    mass: Tensor
    """Cell mass [kg], shape (n_cells,) or (batch, n_cells)."""
    friction: Tensor
    """Support friction coefficient of each cell, shape (n_cells,) or (batch, n_cells)."""
    pusher_friction: Tensor
    """Shape () or (batch,)."""

    @staticmethod
    def of(model: ObjectModel) -> ReferenceModel:
        """The same model in tensors."""
        return ReferenceModel(
            torch.tensor(model.mass), torch.tensor(model.friction), torch.tensor(model.pusher_friction, dtype=torch.float64)
        )


@dataclass(frozen=True, slots=True)
class ReferenceMotion:
    """A batch of simulated pushes."""

    poses: tuple[Tensor, ...]
    """Of the object frame in the table frame, a tensor (n_frames, 3) a push, yaw not wrapped; NaN where the push failed. Differentiable."""
    force: Tensor
    """Of the pusher on the object at each step [N], shape (batch, n_steps, 2), table frame; not differentiable."""
    status: tuple[SolveStatus, ...]
    """CONVERGED, NO_CONTACT (the pusher never touches) or SIMULATION_FAILED, one a push."""


def reference_rollout(
    shape: ObjectShape,
    model: ReferenceModel,
    pushers: Sequence[PusherPath],
    poses_object_in_table: Tensor,
    times: Sequence[Float64Array],
    *,
    force: Tensor | None = None,
    settings: SimulationSettings | None = None,
    max_iterations: int = 60,
) -> ReferenceMotion:
    """Simulate a batch of pushes of one object from rest, on the steps of `push_ident.physics.simulation.simulate`.

    Poses are differentiable in the model, the first poses and the applied force.

    Args:
        shape: cells and outline.
        model: mechanics, one for all pushes or one for each.
        pushers: path of the pusher in each push. Before its first and after its last sample it stands still.
        poses_object_in_table: first poses (x, y, yaw), shape (batch, 3).
        times: when to report the poses of each push [s], ascending, on the clock of its pusher.
        force: applied at the centre of mass (Fx, Fy, torque), table axes, shape broadcast to (batch, n_steps, 3). Steps run from
            the first sample of each pusher until the last push of the batch has ended.
        settings: numerics; only the length of the step, as support friction is not smoothed here.
        max_iterations: of `solve_lcp` in a step.

    Returns:
        The motions, each with its status.

    Raises:
        InputError: shapes that do not fit, values that are not finite, times that do not ascend.
    """
    settings = settings or SimulationSettings()
    body = _PushedBody.of(shape, model, len(pushers))
    _check_pushes(pushers, poses_object_in_table, times)
    drive = _Drive.of(pushers, times, force, settings.longest_step)
    state = _State.at_rest(body, poses_object_in_table)
    poses, forces = [poses_object_in_table], []
    for n in range(drive.n_steps):
        state, pusher_force = _advanced(body, drive, state, n, max_iterations)
        poses.append(state.pose(body))
        forces.append(pusher_force)
    since_start = [time - p.time[0] for time, p in zip(times, pushers, strict=True)]
    return _reported(torch.stack(poses, dim=1), torch.stack(forces, dim=1), state.failed, since_start, settings.longest_step)


# The steps of a push -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _PushedBody:
    """The object, with one row of values for each push."""

    shape: ObjectShape
    mass: Tensor
    """Of each cell [kg], shape (batch, n_cells)."""
    limit: Tensor
    """Friction force of each cell when it slides [N], shape (batch, n_cells)."""
    inertia: Tensor
    """Of each cell about its own centre [kg m^2], shape (batch, n_cells)."""
    centre: Tensor
    """Of mass [m], object frame, shape (batch, 2)."""
    arms: Tensor
    """Cell centres from the centre of mass [m], object axes, shape (batch, n_cells, 2)."""
    gyration: Tensor
    """Radius of gyration [m], shape (batch,); not differentiable."""
    pusher_friction: Tensor
    """Shape (batch,)."""

    @staticmethod
    def of(shape: ObjectShape, model: ReferenceModel, batch: int) -> _PushedBody:
        mass, friction, pusher_friction = _expanded_model(model, batch, len(shape.cells))
        centres = torch.tensor(shape.cells.centres)
        limit = friction * mass * GRAVITY
        inertia = mass * torch.tensor(shape.cells.areas / 6)
        total = mass.sum(dim=1, keepdim=True)
        centre = mass @ centres / total
        arms = centres - centre[:, None]
        gyration = torch.sqrt((inertia + mass * (arms**2).sum(dim=2)).sum(dim=1) / total[:, 0]).detach()
        return _PushedBody(shape, mass, limit, inertia, centre, arms, gyration, pusher_friction)


@dataclass(frozen=True, slots=True)
class _Drive:
    """What drives each object: its pusher and an applied force."""

    pushers: Sequence[PusherPath]
    path: Float64Array
    """Centres of the pushers at the ends of the steps [m], table frame, shape (batch, n_steps + 1, 2)."""
    radius: Tensor
    """Of the pushers [m], shape (batch,)."""
    force: Tensor
    """Applied at the centre of mass (Fx, Fy, torque), table axes [N, N, N m], shape (batch, n_steps, 3)."""
    dt: float
    """[s]"""

    @property
    def n_steps(self) -> int:
        return self.path.shape[1] - 1

    @staticmethod
    def of(pushers: Sequence[PusherPath], times: Sequence[Float64Array], force: Tensor | None, dt: float) -> _Drive:
        spans = [max(float(time[-1]), float(p.time[-1])) - float(p.time[0]) for time, p in zip(times, pushers, strict=True)]
        n_steps = max(1, math.ceil(max(spans) / dt))
        radius = torch.tensor([p.radius for p in pushers], dtype=torch.float64)
        clock = dt * np.arange(n_steps + 1)
        path = np.stack([[np.interp(p.time[0] + clock, p.time, p.position[:, axis]) for axis in (0, 1)] for p in pushers])
        size = (len(pushers), n_steps, 3)
        applied = torch.zeros(size, dtype=torch.float64) if force is None else _broadcast("force", force, size)
        return _Drive(pushers, np.ascontiguousarray(np.moveaxis(path, 1, 2)), radius, applied, dt)


@dataclass(frozen=True, slots=True)
class _State:
    """Of each object between two steps, table axes."""

    position: Tensor
    """Of the centre of mass [m], shape (batch, 2)."""
    yaw: Tensor
    """Not wrapped [rad], shape (batch,)."""
    twist: Tensor
    """Of the centre of mass (vx, vy, omega) [m/s, m/s, rad/s], shape (batch, 3)."""
    failed: BoolArray
    """Whether a step of the push was not solved; the object then stands still. Shape (batch,)."""

    @staticmethod
    def at_rest(body: _PushedBody, poses_object_in_table: Tensor) -> _State:
        yaw = poses_object_in_table[:, 2]
        position = poses_object_in_table[:, :2] + rotated(yaw, body.centre)
        batch = len(yaw)
        return _State(position, yaw, torch.zeros(batch, 3, dtype=torch.float64), np.zeros(batch, dtype=bool))

    def pose(self, body: _PushedBody) -> Tensor:
        """Of the object frame, shape (batch, 3)."""
        return torch.cat([self.position - rotated(self.yaw, body.centre), self.yaw[:, None]], dim=1)

    def moved(self, twist: Tensor, failed: BoolArray, dt: float) -> _State:
        """After a step that ended with `twist`."""
        return _State(self.position + dt * twist[:, :2], self.yaw + dt * twist[:, 2], twist, failed)


def _advanced(body: _PushedBody, drive: _Drive, state: _State, n: int, max_iterations: int) -> tuple[_State, Tensor]:
    """Step n of all pushes: the state after it, and the force of each pusher on its object [N], shape (batch, 2)."""
    travel = drive.path[:, n + 1] - drive.path[:, n]
    pusher_in_object = body.centre + rotated(-state.yaw, torch.tensor(drive.path[:, n]) - state.position)
    contacts, n_contacts = _features(body.shape, drive.pushers, pusher_in_object, travel)
    speed = torch.maximum(state.twist[:, :2].norm(dim=1), body.gyration * state.twist[:, 2].abs()).detach().numpy()
    idle = _stays_at_rest(contacts, n_contacts, travel, speed) & (drive.force[:, n] == 0).all(dim=1).numpy()
    moving = torch.tensor(np.flatnonzero(~idle & ~state.failed))

    twist, failed = torch.zeros_like(state.twist), state.failed.copy()
    pusher_force = torch.zeros(len(twist), 2, dtype=torch.float64)
    if len(moving):
        frames = _contact_frames(torch.tensor(contacts)[moving], pusher_in_object[moving], drive.radius[moving])
        active = torch.arange(MAX_DISC_CONTACTS) < torch.tensor(n_contacts)[moving, None]
        problem = _step_problem(body, drive, state, n, moving, frames, active)
        result = reference_step(problem, max_iterations=max_iterations)
        solved = torch.tensor([status is LcpStatus.CONVERGED for status in result.status])
        failed[moving[~solved]] = True
        twist = twist.index_put((moving[solved],), result.twist[solved])
        normal, impulse = problem.normal, result.normal_impulse[..., None]
        on_object = result.tangential_impulse[:, None] * turned(normal[:, 0]) - (impulse * normal).sum(dim=1)
        pusher_force[moving] = on_object.detach() / drive.dt
    return state.moved(twist, failed, drive.dt), pusher_force


def _step_problem(
    body: _PushedBody, drive: _Drive, state: _State, n: int, moving: Tensor, frames: tuple[Tensor, Tensor, Tensor], active: Tensor
) -> StepProblem:
    """Step n of the pushes `moving`, from their contacts in the object frame."""
    normal, point, gap = frames
    travel = drive.path[:, n + 1] - drive.path[:, n]
    return StepProblem(
        mass=body.mass[moving],
        inertia=body.inertia[moving],
        cells=rotated(state.yaw[moving, None], body.arms[moving]),
        twist=state.twist[moving],
        limit=body.limit[moving],
        normal=rotated(state.yaw[moving, None], normal),
        point=rotated(state.yaw[moving, None], point - body.centre[moving, None]),
        gap=gap.clamp(min=-RECOVERY_SPEED * drive.dt),
        active=active,
        pusher_velocity=torch.tensor(travel / drive.dt)[moving],
        pusher_friction=body.pusher_friction[moving],
        force=drive.force[moving, n],
        dt=drive.dt,
    )


# Parts of a step, and of the input -----------------------------------------------------------------------------------------------


def _broadcast(name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    if value.dtype != torch.float64:
        raise InputError(f"`{name}` is of {value.dtype}, expected torch.float64; convert it with `.double()`.")
    try:
        return torch.broadcast_to(value, shape)
    except RuntimeError:
        raise InputError(f"`{name}` has shape {tuple(value.shape)}, which does not broadcast to {shape}.") from None


def _expanded_model(model: ReferenceModel, batch: int, n_cells: int) -> tuple[Tensor, Tensor, Tensor]:
    mass = _broadcast("mass", model.mass, (batch, n_cells))
    friction = _broadcast("friction", model.friction, (batch, n_cells))
    pusher_friction = _broadcast("pusher_friction", model.pusher_friction, (batch,))
    for name, value in (("mass", mass), ("friction", friction), ("pusher_friction", pusher_friction)):
        if not bool(torch.isfinite(value).all()) or bool((value < 0).any()):
            raise InputError(f"ReferenceModel.{name} holds values that are negative or not finite.")
    return mass, friction, pusher_friction


def _check_pushes(pushers: Sequence[PusherPath], poses_object_in_table: Tensor, times: Sequence[Float64Array]) -> None:
    """Refuse pushes that the reference engine cannot simulate."""
    batch = len(pushers)
    if tuple(poses_object_in_table.shape) != (batch, 3) or not bool(torch.isfinite(poses_object_in_table).all()):
        raise InputError(f"The first poses have shape {tuple(poses_object_in_table.shape)}, expected {(batch, 3)}, all finite.")
    if any(not pusher.shape.is_cylinder or pusher.yaw is not None for pusher in pushers):
        raise InputError("The reference engine supports only disc pushers that do not rotate; simulate other pushers with `simulate`.")
    if len(times) != batch:
        raise InputError(f"There are {len(times)} lists of times, expected {batch}, one a push.")
    for time in times:
        if time.ndim != 1 or len(time) == 0 or not np.all(np.isfinite(time)) or np.any(np.diff(time) < 0):
            raise InputError("The times to report must be finite and ascend; sort them first.")


def _reported(
    trajectory: Tensor, pusher_force: Tensor, failed: BoolArray, since_start: Sequence[Float64Array], dt: float
) -> ReferenceMotion:
    """Poses at the reported times, and the status of each push."""
    reported = tuple(
        torch.full((len(time), 3), torch.nan, dtype=torch.float64) if failed[b] else _at_times(trajectory[b], time, dt)
        for b, time in enumerate(since_start)
    )
    touched = pusher_force.flatten(1).abs().amax(dim=1) > 0
    status = tuple(
        SolveStatus.SIMULATION_FAILED if bad else SolveStatus.CONVERGED if touch else SolveStatus.NO_CONTACT
        for bad, touch in zip(failed.tolist(), touched.tolist(), strict=True)
    )
    return ReferenceMotion(reported, pusher_force, status)


def _at_times(trajectory: Tensor, since_start: Float64Array, dt: float) -> Tensor:
    """Poses between the ends of the steps, shape (n_frames, 3)."""
    at = np.clip(since_start / dt, 0.0, len(trajectory) - 1)
    step = np.minimum(at.astype(np.int64), len(trajectory) - 2)
    fraction = torch.tensor(at - step)[:, None]
    return (1.0 - fraction) * trajectory[torch.tensor(step)] + fraction * trajectory[torch.tensor(step + 1)]


def _features(
    shape: ObjectShape, pushers: Sequence[PusherPath], pusher_in_object: Tensor, travel: Float64Array
) -> tuple[Float64Array, NDArray[np.int64]]:
    """Rows of `find_contacts`, shape (batch, 2, Field.WIDTH), and the number of contacts, shape (batch,)."""
    contacts = np.zeros((len(pushers), MAX_DISC_CONTACTS, Field.WIDTH))
    count = np.zeros(len(pushers), dtype=np.int64)
    candidates = np.zeros((max_candidates(1, len(shape.outline)), Field.WIDTH))
    outline = np.array(shape.outline)  # writable, as kernels are compiled for
    for b, centre in enumerate(pusher_in_object.detach().numpy()):
        reach = REACH + math.hypot(*travel[b])
        count[b] = find_contacts(centre[None], pushers[b].radius, outline, reach, candidates, contacts[b])
    return contacts, count


def _stays_at_rest(contacts: Float64Array, n_contacts: NDArray[np.int64], travel: Float64Array, speed: Float64Array) -> BoolArray:
    """Whether each object is at rest and its pusher does not reach it within this step, shape (batch,)."""
    rest_speed = 1e-9  # rounding of a velocity [m/s]
    gap, distance = contacts[:, 0, Field.GAP], np.hypot(travel[:, 0], travel[:, 1])
    out_of_reach = (n_contacts == 0) | ((gap >= -1e-9) & ((distance == 0) | (gap > distance)))
    return np.asarray((speed < rest_speed) & out_of_reach)


def _contact_frames(contacts: Tensor, pusher_in_object: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normals (batch, 2, 2), points (batch, 2, 2) and gaps (batch, 2) of the features in `contacts`, object frame.

    `find_contacts` selects the feature. The geometry is computed again from it, so that gradients flow through the pose.
    """
    anchor, vertex = contacts[..., Field.POINT : Field.POINT + 2], contacts[..., Field.KIND] == Kind.CORNER.value
    offset = pusher_in_object[:, None] - anchor
    outside = torch.sign(contacts[..., Field.CURVATURE])
    distance = torch.where(vertex[..., None], offset, 1.0).norm(dim=2)
    normal = torch.where(vertex[..., None], (outside / distance)[..., None] * offset, contacts[..., Field.NORMAL : Field.NORMAL + 2])
    height = (normal * offset).sum(dim=2)
    point = torch.where(vertex[..., None], anchor, pusher_in_object[:, None] - height[..., None] * normal)
    return normal, point, height - radius[:, None]
