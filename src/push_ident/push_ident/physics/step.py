"""One implicit step of a rigid object pushed on a table (compiled).

The state has three velocities, `twist` = (vx, vy, omega) of the centre of mass, in axes fixed in the object. One step of length dt
finds the new twist u and the contact impulses:

    D (u - u_old) + dt sum_i f_i J_i' phi(J_i u) = sum_k N_k' n_k + T' t,      phi(v) = v / sqrt(|v|^2 + eps^2)
    0 <= n_k  perpendicular to  N_k u - b_k >= 0,      b_k = -n . v_pusher - gap / dt
    |t| <= mu sum_k n_k, opposite to the slip  T u - t . v_pusher      (contacts of the sum: see `modes.py`)

with D = diag(m, m, I), J_i the velocity of cell i, f_i = mu_i m_i g its support friction. This is the problem of Song & Boularias
(2020, Eq. 2 and its figure of the equations of motion) with the rigid joints eliminated and the friction pyramid of a cell
replaced by its circular cone (`pyramid.py` keeps the pyramid). Friction of the pusher is exact (stick or slip, no smoothing). Only
the support friction is smoothed, with eps. With D = 0 the step is quasi-static. Effects (`table.py`) may add a force to the right-hand
side and replace phi by (I + E) phi.

Each iteration linearises the support friction and solves the small contact problem exactly by enumeration of its modes. The linear
model is Newton's. Where Newton's method does not contract, it is the majoriser of iteratively reweighted least squares, which always
descends.

The first guess continues the change of the twist in the step before. Newton's method converges quadratically, so that two changes c_1, c_2
within one mode predict the next one, c_2^3 / c_1^2: where that is as small as rounding, it is not made.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from push_ident.physics.kernel import kernel
from push_ident.physics.modes import MAX_CONTACTS, Mode, ModeScratch, Row, StepContacts, StepGeometry, new_mode_scratch, solve_modes
from push_ident.physics.support import add_skew, support_friction
from push_ident.types import Float64Array


class _Iteration(NamedTuple):
    """When the iteration of a step ends."""

    most: int = 1000
    """About twenty are usual; the majoriser may need hundreds where the last cells come to rest at the same time."""
    tolerance: float = 1e-10
    """Last change of the twist, relative to it [1]."""
    quadratic: float = 0.01
    """Ratio of two changes below which Newton's method converges quadratically [1]."""
    predicted: float = 1e-4
    """Part of the tolerance below which a change that is only predicted counts as none [1]."""


_ITERATION = _Iteration()


class StepScratch(NamedTuple):
    """Scratch space of a step, so that it allocates no memory."""

    old: Float64Array
    """Twist before the step, shape (3,)."""
    du: Float64Array
    gradient: Float64Array
    right: Float64Array
    model: Float64Array
    """Derivative of the linear model, shape (3, 3)."""
    miss: Float64Array
    rate: Float64Array
    """Change of the twist a second in the step before, object axes, shape (3,); zero where this step is not expected to go on like it."""
    mode: ModeScratch


class TableForces(NamedTuple):
    """Contributions of effects to the forces of the table in a step; object axes."""

    skew: Float64Array
    """(a, b) of E = [[a, b], [b, -a]], shape (2,)."""
    pull: Float64Array
    """Force and torque on the object (fx, fy, torque) [N, N, N m], shape (3,)."""


@kernel
def new_step_scratch() -> StepScratch:
    """Scratch space of `step`."""
    return StepScratch(
        np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros(2 * MAX_CONTACTS), np.zeros(3), new_mode_scratch()
    )  # fmt: skip


@kernel
def step(
    twist: Float64Array,
    geometry: StepGeometry,
    contacts: StepContacts,
    eps: float,
    last_code: int,
    impulse: Float64Array,
    scratch: StepScratch,
    table: TableForces | None = None,
) -> tuple[int, int]:
    """Advance `twist` by one step, in place.

    Args:
        twist: twist of the centre of mass before the step, overwritten by that after it, object axes [m/s, m/s, rad/s], shape (3,).
        geometry: the object.
        contacts: contacts of the step.
        eps: smoothing speed of the support friction [m/s].
        last_code: mode code of the step before, as a first guess.
        impulse: filled with the normal impulses and the tangential ones [N s], shape (N_IMPULSES,).
        scratch: scratch space.
        table: contributions of effects on the table; None without effects.

    Returns:
        The mode code and the number of iterations; the code is `Mode.NONE` when the step did not converge.
    """
    old, du, gradient, right, h, miss = scratch.old, scratch.du, scratch.gradient, scratch.right, scratch.model, scratch.miss
    arms, limit, inertia, reach, dt = geometry.arms, geometry.limit, geometry.inertia, geometry.reach, geometry.dt
    rows = contacts.rows
    old[:] = twist
    guesses = False
    for i in range(3):
        guesses = guesses or scratch.rate[i] != 0.0
        twist[i] += scratch.rate[i] * dt
    newton = was_newton = True
    last_change = np.inf
    retry_below = 0.0
    code = last_code
    for iteration in range(_ITERATION.most):
        support_friction(twist, arms, limit, eps, newton, gradient, h)
        if table is not None:
            if table.skew[0] != 0.0 or table.skew[1] != 0.0:
                add_skew(twist, arms, limit, table.skew, eps, newton, gradient, h)
            for i in range(3):
                gradient[i] -= table.pull[i]
        for i in range(3):
            for j in range(3):
                h[i, j] *= dt
            h[i, i] += inertia[i]
            right[i] = inertia[i] * (old[i] - twist[i]) - dt * gradient[i]
        for i in range(2 * MAX_CONTACTS):
            miss[i] = rows[i, Row.BOUND] - rows[i, 0] * twist[0] - rows[i, 1] * twist[1] - rows[i, 2] * twist[2]
        code_before = code
        code = solve_modes(h, right, contacts, miss, code, du, impulse, scratch.mode)
        if code == Mode.NONE:
            if not guesses:
                return Mode.NONE, iteration
            # Once more from the twist before the step.
            twist[:] = old
            guesses, newton, was_newton = False, True, True
            last_change, retry_below, code = np.inf, 0.0, last_code
            continue
        change = 0.0
        size = eps
        for i in range(3):
            unit = reach if i == 2 else 1.0
            change = max(change, abs(du[i]) * unit)
            twist[i] += du[i]
            size = max(size, abs(twist[i]) * unit)
        next_change = change
        if last_change < np.inf and newton and was_newton and code == code_before and change < _ITERATION.quadratic * last_change:
            next_change = change * (change / last_change) * (change / last_change) / _ITERATION.predicted
        if newton and min(change, next_change) <= _ITERATION.tolerance * size + 1e-16:
            # An object that is free comes to rest, where it would not go on slowing down; and an impact is over after its step.
            for i in range(3):
                scratch.rate[i] = (twist[i] - old[i]) / dt if code == last_code and code >= 4 else 0.0
            return code, iteration + 1
        was_newton = newton
        # Newton's method oscillates across the kink of a cell that comes to rest; the majoriser is slow but always descends. After
        # Newton fails, the majoriser continues until its steps are a few times shorter than Newton's were before it failed.
        if newton and change > 0.5 * last_change:
            newton = False
            retry_below = 0.2 * min(last_change, change)
        elif not newton:
            # A short step of the majoriser does not prove convergence, so the last step must be Newton's.
            newton = change < max(retry_below, _ITERATION.tolerance * size)
        last_change = change
    return Mode.NONE, _ITERATION.most
