"""The paper's pushing engine: every cell with velocities of its own, rigid joints between them, friction pyramids, one LCP a step.

Slow and plain, to check the compiled engine against and to differentiate by torch alone. Source: Song & Boularias (2020), Eq. 2, the
figure of the equations of motion and the section on friction.

Cell i has the velocity (omega_i, vx_i, vy_i), table axes. One step of length dt finds v+ and the impulses of

    M v+ = M v + dt u + J_e' l_e + J_c' l_c + J_p' l_p + J_f' l_f         motion; u is the applied force
    0    = J_e v+                                                        rigid joints
    a    = J_c v+ + c           >= 0,   l_c >= 0,    a' l_c = 0            contact with the pusher
    rho  = J_f v+ + E eta       >= 0,   l_f >= 0,    rho' l_f = 0          support friction against the slip, in the pyramid
    xi   = dt mu_f N - E' l_f   >= 0,   eta >= 0,    xi' eta = 0           ... and within its limit
    tau  = J_p v+ + p + e eta_p >= 0,   l_p >= 0,    tau' l_p = 0          friction of the pusher at its first contact, e = (1, 1)'
    psi  = mu_p l_c1 - e' l_p   >= 0,   eta_p >= 0,  psi eta_p = 0         ... and within the cone of its normal impulse

with the motion of the pusher on the right: c = gap / dt - n . v_pusher for the normal n into the object, less the restitution
times the speed of approach at an impact; p = -t . v_pusher for the tangents +-t. J_f holds the paper's D for every cell: rows +-x
and +-y of the table, nothing for the spin. A cell that slides thus loses the power f_i max(|vx|, |vy|), the support function of a
diamond, where the circular cone takes f_i |v|.

Where the print of the paper cannot stand, this is built:

- G, and with it Eq. 2, holds J_e where the contacts J_c belong; J_e already is A.
- The vector of unknowns in Eq. 2 reads (alpha, beta, gamma), its matrix takes (alpha, gamma, beta).
- q = -M v - dt u belongs to alpha = +v+. With alpha = -v+, as printed and as built, it is q = M v + dt u. Likewise F changes its
  sign on the way from the figure to Eq. 2; here it holds -E, E' and -mu_p, which give the signs of the figure.
- The figure subtracts the row of motion, which makes v+ answer the impulses with the wrong sign, and lacks the transposes there.
- J_f and E are said to be k x 4k. J_f is 4k x 3k and E is 4k x k.
- "mu_f l_c", and mu_f in F, is the law of a contact whose load is an unknown. A cell rests on the table with the known load
  N_i = m_i g, so dt mu_f N stands on the right-hand side m. What F couples to l_c is the friction of the pusher.
- gamma beside E in the friction constraints is eta, and E eta is meant; psi in the figure is xi; mu_t is the applied force.

As in the compiled engine, friction of the pusher acts at the nearest contact and a second one (a concave corner) is
frictionless, contacts out of reach are left out, an overlap is taken back at a limited speed, and the pose is advanced in the state
of the centre of mass.
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
from push_ident.physics.contact import CONTACT_FIELDS, MAX_DISC_CONTACTS, find_contacts, max_candidates
from push_ident.physics.contact_rows import RECOVERY_SPEED
from push_ident.physics.lcp import Lcp, LcpStatus, solve_lcp
from push_ident.physics.simulation import GRAVITY, SimulationSettings
from push_ident.types import BoolArray, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

__all__ = ["ReferenceModel", "ReferenceMotion", "StepProblem", "StepResult", "reference_lcp", "reference_rollout", "reference_step"]

_REACH = 2e-3  # contacts nearer than this take part in a step [m]
_REST_SPEED = 1e-9  # an untouched object slower than this stands still [m/s]
_LEAST_LIMIT = 1e-7  # share of a cell's weight that is added to its friction, so that its pyramid is never a point

# Rows come in blocks of five: two normals, two tangents and the cone of the pusher; or the four of D and the limit of a cell.
_ROWS = 5
_D = torch.tensor([[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, 0, 0]], dtype=torch.float64)
_SUPPORT_BLOCK = torch.tensor([[0, 0, 0, 0, -1]] * 4 + [[1, 1, 1, 1, 0]], dtype=torch.float64)
_PUSHER_BLOCK = torch.tensor([[0, 0, 0, 0, 0]] * 2 + [[0, 0, 0, 0, -1]] * 2 + [[0, 0, 1, 1, 0]], dtype=torch.float64)
_CONE = torch.tensor([[0, 0, 0, 0, 0]] * 4 + [[1, 0, 0, 0, 0]], dtype=torch.float64)


@dataclass(frozen=True, slots=True)
class StepProblem:
    """One step of a batch of objects with equally many cells. Tensors are float64, in table axes, and may require gradients."""

    mass: Tensor
    """Of each cell [kg], shape (batch, n_cells)."""
    inertia: Tensor
    """Of each cell about its own centre [kg m^2], shape (batch, n_cells)."""
    cells: Tensor
    """Cell centres [m], shape (batch, n_cells, 2), from any origin that all positions share."""
    twist: Tensor
    """Of the centre of mass before the step (vx, vy, omega) [m/s, m/s, rad/s], shape (batch, 3)."""
    limit: Tensor
    """Friction force of each cell when it slides along x or y [N], shape (batch, n_cells)."""
    normal: Tensor
    """Outward normals of the object at the contacts, shape (batch, 2, 2)."""
    point: Tensor
    """Contact points [m], shape (batch, 2, 2)."""
    gap: Tensor
    """[m], shape (batch, 2)."""
    active: Tensor
    """Which contacts take part, bool, shape (batch, 2); the first before the second."""
    pusher_velocity: Tensor
    """[m/s], shape (batch, 2)."""
    pusher_friction: Tensor
    """Friction coefficient of the pusher, shape (batch,)."""
    restitution: Tensor
    """0 (the pusher and the object stay together) to 1, shape (batch,)."""
    force: Tensor
    """Applied at the centre of mass (Fx, Fy, torque) [N, N, N m], shape (batch, 3)."""
    dt: float
    """[s]"""

    def __post_init__(self) -> None:
        if self.mass.ndim != 2:
            raise InputError(f"StepProblem.mass has shape {tuple(self.mass.shape)}, expected (batch, n_cells).")
        batch, n_cells = self.mass.shape
        expected = {
            "inertia": (batch, n_cells),
            "cells": (batch, n_cells, 2),
            "twist": (batch, 3),
            "limit": (batch, n_cells),
            "normal": (batch, MAX_DISC_CONTACTS, 2),
            "point": (batch, MAX_DISC_CONTACTS, 2),
            "gap": (batch, MAX_DISC_CONTACTS),
            "active": (batch, MAX_DISC_CONTACTS),
            "pusher_velocity": (batch, 2),
            "pusher_friction": (batch,),
            "restitution": (batch,),
            "force": (batch, 3),
        }
        for name, shape in expected.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise InputError(f"StepProblem.{name} has shape {got}, expected {shape} beside a mass of shape {(batch, n_cells)}.")


@dataclass(frozen=True, slots=True)
class StepResult:
    """What one step brings; NaN where it was not solved."""

    twist: Tensor
    """Of the centre of mass after the step (vx, vy, omega), shape (batch, 3); differentiable."""
    normal_impulse: Tensor
    """Of the pusher on the object at each contact, along -normal [N s], shape (batch, 2)."""
    tangential_impulse: Tensor
    """Of the pusher on the object at the first contact, along the normal turned by +90 degrees [N s], shape (batch,)."""
    friction_impulse: Tensor
    """Of the table on each cell (x, y) [N s], shape (batch, n_cells, 2)."""
    status: tuple[LcpStatus, ...]
    """One an object."""


@dataclass(frozen=True, slots=True)
class ReferenceModel:
    """What identification may change. Tensors are float64 and may require gradients; a leading dimension of the batch is optional."""

    mass: Tensor
    """Cell mass [kg], shape (n_cells,) or (batch, n_cells)."""
    friction: Tensor
    """Support friction coefficient of each cell, shape (n_cells,) or (batch, n_cells)."""
    pusher_friction: Tensor
    """Shape () or (batch,)."""
    restitution: float = 0.0
    """Between pusher and object, 0 to 1; the paper assumes 0."""

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


def reference_lcp(problem: StepProblem) -> Lcp:
    """The LCP of one step.

    Velocities are ordered cell by cell as (omega, vx, vy). Rows of G come in blocks of five, so that F is block diagonal: first those
    of the pusher (two contacts, tangents +t and -t, cone), then those of each cell (+x, -x, +y, -y, limit). Rows of a contact that takes
    no part are replaced by s = 1.

    Args:
        problem: batch of steps.

    Returns:
        alpha = -v+, gamma = impulses and slip speeds, beta = impulses of the joints.
    """
    batch, n_cells = problem.mass.shape
    total = problem.mass.sum(dim=1, keepdim=True)
    centre = (problem.mass[..., None] * problem.cells).sum(dim=1) / total

    M = torch.stack([problem.inertia, problem.mass, problem.mass], dim=2)
    omega = problem.twist[:, None, 2:].expand(-1, n_cells, 1)
    old = torch.cat([omega, problem.twist[:, None, :2] + omega * _turned(problem.cells - centre[:, None])], dim=2)
    share = torch.stack([problem.inertia / problem.inertia.sum(dim=1, keepdim=True), problem.mass / total, problem.mass / total], dim=2)
    q = M * old + problem.dt * share * problem.force[:, None, [2, 0, 1]]

    uses = torch.cat([problem.active, problem.active[:, :1].expand(-1, 3)], dim=1)
    on_first = torch.nn.functional.pad(_pusher_rows(problem) * uses[..., None], (0, 3 * n_cells - 3))
    G = torch.cat([on_first, torch.block_diag(*[_D] * n_cells).expand(batch, -1, -1)], dim=1)

    limit = problem.dt * (problem.limit + _LEAST_LIMIT * GRAVITY * problem.mass)
    bounds = torch.nn.functional.pad(limit[..., None], (4, 0)).flatten(1)
    m = torch.cat([torch.where(uses, _pusher_bounds(problem, centre), 1.0), bounds], dim=1)

    pusher = (_PUSHER_BLOCK - problem.pusher_friction[:, None, None] * _CONE) * problem.active[:, :1, None]
    F = torch.cat([pusher[:, None], _SUPPORT_BLOCK.expand(batch, n_cells, -1, -1)], dim=1)
    return Lcp(M.flatten(1), q.flatten(1), G, F, m, _joint_rows(problem.cells))


def reference_step(problem: StepProblem, *, tolerance: float = 1e-12, max_iterations: int = 60) -> StepResult:
    """Advance a batch of objects by one step.

    Args:
        problem: batch of steps.
        tolerance, max_iterations: of `solve_lcp`.

    Returns:
        Twists and impulses with a status for each.

    Raises:
        InputError: shapes that do not fit, masses that are not positive.
    """
    batch, n_cells = problem.mass.shape
    solution = solve_lcp(reference_lcp(problem), tolerance=tolerance, max_iterations=max_iterations)
    velocity = -solution.alpha.view(batch, n_cells, 3)
    weight = problem.mass / problem.mass.sum(dim=1, keepdim=True)
    twist = torch.cat([(weight[..., None] * velocity[..., 1:]).sum(dim=1), velocity[:, 0, :1]], dim=1)
    gamma = solution.gamma.view(batch, n_cells + 1, _ROWS)
    return StepResult(
        twist,
        gamma[:, 0, :2],
        gamma[:, 0, 2] - gamma[:, 0, 3],
        torch.stack([gamma[:, 1:, 0] - gamma[:, 1:, 1], gamma[:, 1:, 2] - gamma[:, 1:, 3]], dim=2),
        solution.status,
    )


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
        The motions; look at their `status`.

    Raises:
        InputError: shapes that do not fit, values that are not finite, times that do not ascend.
    """
    settings = settings or SimulationSettings()
    dt, batch, n_cells = settings.step, len(pushers), len(shape.cells)
    mass, friction, pusher_friction = _expanded_model(model, batch, n_cells)
    _check_pushes(pushers, poses_object_in_table, times)
    spans = [max(float(time[-1]), float(p.time[-1])) - float(p.time[0]) for time, p in zip(times, pushers, strict=True)]
    n_steps = max(1, math.ceil(max(spans) / dt))
    radius = torch.tensor([p.radius for p in pushers], dtype=torch.float64)
    path = np.stack([_path_on_steps(p, n_steps, dt) for p in pushers])
    applied = torch.zeros(batch, n_steps, 3, dtype=torch.float64) if force is None else _broadcast("force", force, (batch, n_steps, 3))

    centres = torch.tensor(shape.cells.centres)
    limit = friction * mass * GRAVITY
    inertia = mass * (shape.cells.size**2 / 6)
    total = mass.sum(dim=1, keepdim=True)
    centre = mass @ centres / total
    arms = centres - centre[:, None]
    reach = torch.sqrt((inertia + mass * (arms**2).sum(dim=2)).sum(dim=1) / total[:, 0]).detach()

    yaw = poses_object_in_table[:, 2]
    at = poses_object_in_table[:, :2] + _rotated(yaw, centre)
    twist = torch.zeros(batch, 3, dtype=torch.float64)
    poses = [poses_object_in_table]
    pusher_force = torch.zeros(batch, n_steps, 2, dtype=torch.float64)
    failed = np.zeros(batch, dtype=bool)
    for n in range(n_steps):
        travel = path[:, n + 1] - path[:, n]
        seen = centre + _rotated(-yaw, torch.tensor(path[:, n]) - at)
        contacts, n_contacts = _features(shape, pushers, seen, travel)
        speed = torch.maximum(twist[:, :2].norm(dim=1), reach * twist[:, 2].abs()).detach().numpy()
        idle = _stays_at_rest(contacts, n_contacts, travel, speed) & (applied[:, n] == 0).all(dim=1).numpy()
        go = torch.tensor(np.flatnonzero(~idle & ~failed))
        twist_before, twist = twist, torch.zeros_like(twist)
        if len(go):
            normal, point, gap = _contact_frames(torch.tensor(contacts)[go], seen[go], radius[go])
            result = reference_step(
                StepProblem(
                    mass=mass[go],
                    inertia=inertia[go],
                    cells=_rotated(yaw[go, None], arms[go]),
                    twist=twist_before[go],
                    limit=limit[go],
                    normal=_rotated(yaw[go, None], normal),
                    point=_rotated(yaw[go, None], point - centre[go, None]),
                    gap=gap.clamp(min=-RECOVERY_SPEED * dt),
                    active=torch.arange(MAX_DISC_CONTACTS) < torch.tensor(n_contacts)[go, None],
                    pusher_velocity=torch.tensor(travel / dt)[go],
                    pusher_friction=pusher_friction[go],
                    restitution=torch.full((len(go),), model.restitution, dtype=torch.float64),
                    force=applied[go, n],
                    dt=dt,
                ),
                max_iterations=max_iterations,
            )
            solved = torch.tensor([status is LcpStatus.CONVERGED for status in result.status])
            failed[go[~solved]] = True
            twist = twist.index_put((go[solved],), result.twist[solved])
            pusher_force[go, n] = _impulse_on_object(result, _rotated(yaw[go, None], normal)).detach() / dt
        at = at + dt * twist[:, :2]
        yaw = yaw + dt * twist[:, 2]
        poses.append(torch.cat([at - _rotated(yaw, centre), yaw[:, None]], dim=1))

    return _reported(
        torch.stack(poses, dim=1), pusher_force, failed, [time - p.time[0] for time, p in zip(times, pushers, strict=True)], dt
    )


# One step ------------------------------------------------------------------------------------------------------------------------


def _turned(vector: Tensor) -> Tensor:
    """`vector` turned by +90 degrees: the velocity of a point at `vector` when the body turns at 1 rad/s. Shape (..., 2)."""
    return torch.stack([-vector[..., 1], vector[..., 0]], dim=-1)


def _rotated(yaw: Tensor, vector: Tensor) -> Tensor:
    """`vector` (..., 2) from axes at `yaw` (...) into the axes that yaw is measured from."""
    return torch.cos(yaw)[..., None] * vector + torch.sin(yaw)[..., None] * _turned(vector)


def _joint_rows(cells: Tensor) -> Tensor:
    """J_e: each cell is tied to the first, which keeps the rows independent. Shape (batch, 3 (n_cells - 1), 3 n_cells).

    omega_i = omega_1 and v_i = v_1 + omega_1 x (r_i - r_1).
    """
    batch, n_cells = cells.shape[:2]
    on_first = torch.eye(3, dtype=torch.float64).repeat(batch, n_cells - 1, 1, 1)
    lever = torch.cat([torch.zeros_like(cells[:, 1:, :1]), _turned(cells[:, 1:] - cells[:, :1])], dim=2)
    on_first = -torch.cat([on_first[..., :1] + lever[..., None], on_first[..., 1:]], dim=3)
    others = torch.eye(3 * (n_cells - 1), dtype=torch.float64).expand(batch, -1, -1)
    return torch.cat([on_first.reshape(batch, -1, 3), others], dim=2)


def _pusher_rows(problem: StepProblem) -> Tensor:
    """J_c and J_p, shape (batch, 5, 3): the pusher acts on the first cell, and through the joints on all; the cone's row is empty."""
    arm = problem.point - problem.cells[:, :1]
    inward = -problem.normal
    tangent = _turned(problem.normal[:, :1])
    direction = torch.cat([inward, tangent, -tangent], dim=1)
    arm = torch.cat([arm, arm[:, :1], arm[:, :1]], dim=1)
    rows = torch.cat([(_turned(arm) * direction).sum(dim=2, keepdim=True), direction], dim=2)
    return torch.cat([rows, torch.zeros_like(rows[:, :1])], dim=1)


def _pusher_bounds(problem: StepProblem, centre: Tensor) -> Tensor:
    """Right-hand side m of the pusher's rows: -c, -p and 0, shape (batch, 5).

    Without restitution the gap may just close. With it, a contact that would close within the step is an impact, after which the two
    part at `restitution` times the speed at which they met (Newton's law).
    """
    arm = problem.point - centre[:, None]
    inward = -problem.normal
    surface = problem.twist[:, None, :2] + problem.twist[:, None, 2:] * _turned(arm)
    closing = (inward * (problem.pusher_velocity[:, None] - surface)).sum(dim=2)
    rebound = problem.restitution[:, None] * closing
    apart = -problem.gap / problem.dt
    bound = torch.where((rebound > 0) & (closing > -apart), torch.maximum(rebound, apart), apart)
    normal = -(inward * problem.pusher_velocity[:, None]).sum(dim=2) - bound
    slip = (_turned(problem.normal[:, 0]) * problem.pusher_velocity).sum(dim=1)
    return torch.cat([normal, torch.stack([-slip, slip, torch.zeros_like(slip)], dim=1)], dim=1)


# A whole push --------------------------------------------------------------------------------------------------------------------


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
    if not 0.0 <= model.restitution <= 1.0:
        raise InputError(f"ReferenceModel.restitution is {model.restitution}, expected a number from 0 to 1.")
    return mass, friction, pusher_friction


def _check_pushes(pushers: Sequence[PusherPath], poses_object_in_table: Tensor, times: Sequence[Float64Array]) -> None:
    """Refuse pushes that the reference engine cannot simulate."""
    batch = len(pushers)
    if tuple(poses_object_in_table.shape) != (batch, 3) or not bool(torch.isfinite(poses_object_in_table).all()):
        raise InputError(f"The first poses have shape {tuple(poses_object_in_table.shape)}, expected {(batch, 3)}, all finite.")
    if any(pusher.polygon is not None or pusher.yaw is not None for pusher in pushers):
        raise InputError("The reference engine knows disc pushers that do not turn; simulate polygon pushers with `simulate`.")
    if len(times) != batch:
        raise InputError(f"There are {len(times)} lists of times, expected {batch}, one a push.")
    for time in times:
        if time.ndim != 1 or len(time) == 0 or not np.all(np.isfinite(time)) or np.any(np.diff(time) < 0):
            raise InputError("The times to report must be finite and ascend; sort them first.")


def _reported(
    trajectory: Tensor, pusher_force: Tensor, failed: BoolArray, since_start: Sequence[Float64Array], dt: float
) -> ReferenceMotion:
    """Poses at the times that were asked for, and the status of each push."""
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


def _path_on_steps(pusher: PusherPath, n_steps: int, dt: float) -> Float64Array:
    """Centre of the pusher at the ends of the steps [m], shape (n_steps + 1, 2)."""
    clock = pusher.time[0] + dt * np.arange(n_steps + 1)
    return np.column_stack([np.interp(clock, pusher.time, pusher.position[:, axis]) for axis in (0, 1)])


def _at_times(trajectory: Tensor, since_start: Float64Array, dt: float) -> Tensor:
    """Poses between the ends of the steps, shape (n_frames, 3)."""
    at = np.clip(since_start / dt, 0.0, len(trajectory) - 1)
    step = np.minimum(at.astype(np.int64), len(trajectory) - 2)
    fraction = torch.tensor(at - step)[:, None]
    return (1.0 - fraction) * trajectory[torch.tensor(step)] + fraction * trajectory[torch.tensor(step + 1)]


def _features(
    shape: ObjectShape, pushers: Sequence[PusherPath], seen: Tensor, travel: Float64Array
) -> tuple[Float64Array, NDArray[np.int64]]:
    """Rows of `find_contacts` for the pusher seen at `seen`, shape (batch, 2, CONTACT_FIELDS), and how many they are, shape (batch,)."""
    contacts = np.zeros((len(pushers), MAX_DISC_CONTACTS, CONTACT_FIELDS))
    count = np.zeros(len(pushers), dtype=np.int64)
    found = np.zeros((max_candidates(1, len(shape.outline)), CONTACT_FIELDS))
    outline = np.array(shape.outline)  # writable, as kernels are compiled for
    for b, centre in enumerate(seen.detach().numpy()):
        reach = _REACH + math.hypot(*travel[b])
        count[b] = find_contacts(centre[None], pushers[b].radius, outline, reach, found, contacts[b])
    return contacts, count


def _stays_at_rest(contacts: Float64Array, n_contacts: NDArray[np.int64], travel: Float64Array, speed: Float64Array) -> BoolArray:
    """Where an object stands and the pusher does not come to it within this step, shape (batch,)."""
    gap, way = contacts[:, 0, 0], np.hypot(travel[:, 0], travel[:, 1])
    out_of_reach = (n_contacts == 0) | ((gap >= -1e-9) & ((way == 0) | (gap > way)))
    return np.asarray((speed < _REST_SPEED) & out_of_reach)


def _contact_frames(contacts: Tensor, seen: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normals (batch, 2, 2), points (batch, 2, 2) and gaps (batch, 2) of the features in `contacts`, object frame.

    `find_contacts` names the feature; where the pusher stands against it is computed again, so that gradients flow through the pose.
    """
    anchor, vertex = contacts[..., 3:5], contacts[..., 6] == 1
    offset = seen[:, None] - anchor
    outside = torch.sign(contacts[..., 5])
    distance = torch.where(vertex[..., None], offset, 1.0).norm(dim=2)
    normal = torch.where(vertex[..., None], (outside / distance)[..., None] * offset, contacts[..., 1:3])
    height = (normal * offset).sum(dim=2)
    point = torch.where(vertex[..., None], anchor, seen[:, None] - height[..., None] * normal)
    return normal, point, height - radius[:, None]


def _impulse_on_object(result: StepResult, normal: Tensor) -> Tensor:
    """Of the pusher [N s], table axes, shape (batch, 2)."""
    return result.tangential_impulse[:, None] * _turned(normal[:, 0]) - (result.normal_impulse[..., None] * normal).sum(dim=1)
