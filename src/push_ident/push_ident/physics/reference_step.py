"""One step of the paper's pushing engine: every cell has its own velocities, rigid joints connect them, friction cones are pyramids.

The step is one LCP. Source: Song & Boularias (2020), Eq. 2, the figure of the equations of motion and the section on friction.

Cell i has the velocity (omega_i, vx_i, vy_i) in table axes. A step of length dt finds v+ and the impulses of

    M v+ = M v + dt u + J_e' l_e + J_c' l_c + J_p' l_p + J_f' l_f         motion; u is the applied force
    0    = J_e v+                                                        rigid joints
    a    = J_c v+ + c           >= 0,   l_c >= 0,    a' l_c = 0            contact with the pusher
    rho  = J_f v+ + E eta       >= 0,   l_f >= 0,    rho' l_f = 0          support friction against the slip, in the pyramid
    xi   = dt mu_f N - E' l_f   >= 0,   eta >= 0,    xi' eta = 0           ... and within its limit
    tau  = J_p v+ + p + e eta_p >= 0,   l_p >= 0,    tau' l_p = 0          friction of the pusher at its first contact, e = (1, 1)'
    psi  = mu_p l_c1 - e' l_p   >= 0,   eta_p >= 0,  psi eta_p = 0         ... and within the cone of its normal impulse

The motion of the pusher enters the right-hand sides. c = gap / dt - n . v_pusher for the normal n into the object; p = -t . v_pusher for
the tangents +-t. J_f holds the paper's D for every cell: rows
+-x and +-y of the table, zero for the rotation. A sliding cell dissipates the power f_i max(|vx|, |vy|), the support function of a
diamond; the circular cone dissipates f_i |v|.

This implementation corrects the following errors of the printed paper:

- G, and with it Eq. 2, contains J_e where the contacts J_c belong. J_e is already A.
- The vector of unknowns in Eq. 2 is (alpha, beta, gamma), but the order of its matrix is (alpha, gamma, beta).
- q = -M v - dt u belongs to alpha = +v+. With alpha = -v+, as printed and as implemented, q = M v + dt u. Likewise F has another sign in
  the figure than in Eq. 2. Here it holds -E, E' and -mu_p, which give the signs of the figure.
- The figure subtracts the row of motion, so that v+ responds to the impulses with the wrong sign. Its transposes are missing.
- The paper gives J_f and E as k x 4k. J_f is 4k x 3k and E is 4k x k.
- "mu_f l_c", and mu_f in F, is the law of a contact with an unknown load. A cell rests on the table with the known load
  N_i = m_i g, so dt mu_f N belongs to the right-hand side m. F couples the friction of the pusher to l_c.
- gamma beside E in the friction constraints means eta, so the term is E eta. psi in the figure is xi. mu_t is the applied force.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from push_ident.errors import InputError
from push_ident.physics.contact import MAX_DISC_CONTACTS
from push_ident.physics.lcp import Lcp, LcpStatus, solve_lcp
from push_ident.physics.support import GRAVITY

# G has blocks of five rows. Pusher: two normals, two tangents, cone. Cell: the four rows of D, limit.
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
    """Whether each contact takes part, bool, shape (batch, 2). The second takes part only if the first does."""
    pusher_velocity: Tensor
    """[m/s], shape (batch, 2)."""
    pusher_friction: Tensor
    """Friction coefficient of the pusher, shape (batch,)."""
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
            "force": (batch, 3),
        }
        for name, shape in expected.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise InputError(f"StepProblem.{name} has shape {got}, expected {shape} beside a mass of shape {(batch, n_cells)}.")


@dataclass(frozen=True, slots=True)
class StepResult:
    """Results of one step; NaN where it was not solved."""

    twist: Tensor
    """Of the centre of mass after the step (vx, vy, omega), shape (batch, 3); differentiable."""
    normal_impulse: Tensor
    """Of the pusher on the object at each contact, along -normal [N s], shape (batch, 2)."""
    tangential_impulse: Tensor
    """Of the pusher on the object at the first contact, along the normal turned by +90 degrees [N s], shape (batch,)."""
    status: tuple[LcpStatus, ...]
    """One for each object."""


def reference_lcp(problem: StepProblem) -> Lcp:
    """The LCP of one step.

    Velocities are ordered cell by cell as (omega, vx, vy). Rows of G come in blocks of five, so that F is block diagonal: first those
    of the pusher (two contacts, tangents +t and -t, cone), then those of each cell (+x, -x, +y, -y, limit). s = 1 replaces the rows of a
    contact that is not active.

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
    old = torch.cat([omega, problem.twist[:, None, :2] + omega * turned(problem.cells - centre[:, None])], dim=2)
    share = torch.stack([problem.inertia / problem.inertia.sum(dim=1, keepdim=True), problem.mass / total, problem.mass / total], dim=2)
    q = M * old + problem.dt * share * problem.force[:, None, [2, 0, 1]]

    uses = torch.cat([problem.active, problem.active[:, :1].expand(-1, 3)], dim=1)
    on_first = torch.nn.functional.pad(_pusher_rows(problem) * uses[..., None], (0, 3 * n_cells - 3))
    G = torch.cat([on_first, torch.block_diag(*[_D] * n_cells).expand(batch, -1, -1)], dim=1)

    # A share of a cell's weight is added to its friction limit, so that its pyramid never degenerates to a point.
    limit = problem.dt * (problem.limit + 1e-7 * GRAVITY * problem.mass)
    bounds = torch.nn.functional.pad(limit[..., None], (4, 0)).flatten(1)
    m = torch.cat([torch.where(uses, _pusher_bounds(problem), 1.0), bounds], dim=1)

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
    gamma = solution.gamma.view(batch, n_cells + 1, len(_D))
    return StepResult(
        twist,
        gamma[:, 0, :2],
        gamma[:, 0, 2] - gamma[:, 0, 3],
        solution.status,
    )


def turned(vector: Tensor) -> Tensor:
    """`vector` rotated by +90 degrees: the velocity of a point at `vector` when the body rotates at 1 rad/s. Shape (..., 2)."""
    return torch.stack([-vector[..., 1], vector[..., 0]], dim=-1)


def rotated(yaw: Tensor, vector: Tensor) -> Tensor:
    """`vector` (..., 2), given in axes rotated by `yaw` (...), in the axes from which yaw is measured."""
    return torch.cos(yaw)[..., None] * vector + torch.sin(yaw)[..., None] * turned(vector)


def _joint_rows(cells: Tensor) -> Tensor:
    """J_e: each cell is joined to the first, which keeps the rows independent. Shape (batch, 3 (n_cells - 1), 3 n_cells).

    omega_i = omega_1 and v_i = v_1 + omega_1 x (r_i - r_1).
    """
    batch, n_cells = cells.shape[:2]
    on_first = torch.eye(3, dtype=torch.float64).repeat(batch, n_cells - 1, 1, 1)
    lever = torch.cat([torch.zeros_like(cells[:, 1:, :1]), turned(cells[:, 1:] - cells[:, :1])], dim=2)
    on_first = -torch.cat([on_first[..., :1] + lever[..., None], on_first[..., 1:]], dim=3)
    others = torch.eye(3 * (n_cells - 1), dtype=torch.float64).expand(batch, -1, -1)
    return torch.cat([on_first.reshape(batch, -1, 3), others], dim=2)


def _pusher_rows(problem: StepProblem) -> Tensor:
    """J_c and J_p, shape (batch, 5, 3). The pusher acts on the first cell, the joints transmit it to all. The row of the cone is zero."""
    arm = problem.point - problem.cells[:, :1]
    inward = -problem.normal
    tangent = turned(problem.normal[:, :1])
    direction = torch.cat([inward, tangent, -tangent], dim=1)
    arm = torch.cat([arm, arm[:, :1], arm[:, :1]], dim=1)
    rows = torch.cat([(turned(arm) * direction).sum(dim=2, keepdim=True), direction], dim=2)
    return torch.cat([rows, torch.zeros_like(rows[:, :1])], dim=1)


def _pusher_bounds(problem: StepProblem) -> Tensor:
    """Right-hand side m of the pusher's rows: -c, -p and 0, shape (batch, 5). The gap may close to zero: the paper has no restitution."""
    inward, bound = -problem.normal, -problem.gap / problem.dt
    normal = -(inward * problem.pusher_velocity[:, None]).sum(dim=2) - bound
    slip = (turned(problem.normal[:, 0]) * problem.pusher_velocity).sum(dim=1)
    return torch.cat([normal, torch.stack([-slip, slip, torch.zeros_like(slip)], dim=1)], dim=1)
