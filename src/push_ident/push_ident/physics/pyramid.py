"""One implicit step with the paper's friction pyramid, not smoothed, by a primal-dual interior-point method (compiled).

The pyramid of a cell (rows +-x, +-y of the table frame, multipliers that sum to at most f dt) is a square, so it splits into two
one-dimensional frictions of weight c = f dt / 2 along its diagonals d = (1, 1) and (1, -1) (`support.py`). With t = d . J u, the friction
c q of each is

    t = w1 - w2,    0 <= w1  perpendicular to  1 - q >= 0,    0 <= w2  perpendicular to  1 + q >= 0

which is the complementarity problem of Song & Boularias (2020, Eq. 2), cell by cell. The interior-point method relaxes the products
w z = 0 to w z = nu and decreases nu. A Newton iteration eliminates every cell in closed form,

    dq = (d . J u+ - nu / z1 + nu / z2) / (w1 / z1 + w2 / z2),      z1 = 1 - q,  z2 = 1 + q

so that an iteration is one sweep over the cells and one problem in the three velocities. Contact is not relaxed: its modes are
enumerated exactly, as in `step.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from push_ident.physics.kernel import fast_kernel, kernel
from push_ident.physics.modes import MAX_CONTACTS, Mode, Row, StepContacts, StepGeometry, solve_modes
from push_ident.physics.step import StepScratch
from push_ident.physics.support import SupportImpulse
from push_ident.types import Float64Array

FINAL_NU = 1e-13
"""Products w z at the end of the central path [m/s]. A sticking cell creeps at most at this speed."""


class _Method(NamedTuple):
    """Of the interior-point method."""

    max_iterations: int = 200
    tolerance: float = 1e-11
    """Last change of the twist, relative to it [1]."""
    rounding: float = 2e-15
    """Rounding error of a velocity [m/s]. A smaller difference between w1 - w2 and the velocity is not corrected: otherwise rounding would
    disturb the friction of a sticking cell, whose w is about 1e-13."""
    attempts: tuple[tuple[float, float], ...] = ((0.99, 0.01), (0.8, 0.1), (0.5, 0.3))
    """Largest fraction of the distance to the boundary that a step covers, and factor of nu after a full step. The first pair suffices
    except in rare steps where an object almost at rest slides along the pusher; the next pairs are more cautious."""


_METHOD = _Method()


class PyramidScratch(NamedTuple):
    """Interior-point variables of the two diagonals of each cell, shapes (2, n_cells)."""

    w1: Float64Array
    w2: Float64Array
    z1: Float64Array
    z2: Float64Array
    dq: Float64Array


@kernel
def new_pyramid_scratch(n_cells: int) -> PyramidScratch:
    """Scratch space of `pyramid_step`."""
    shape = (2, n_cells)
    return PyramidScratch(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape))


@kernel
def _start(twist: Float64Array, geometry: StepGeometry, nu: float, cells: PyramidScratch) -> None:
    """Put all cells on the central path at `nu` [m/s]."""
    arms, cos, sin = geometry.arms, geometry.heading[0], geometry.heading[1]
    for e in range(2):
        dx, dy = (cos + sin, cos - sin) if e == 0 else (cos - sin, -sin - cos)
        w1, w2, z1, z2 = cells.w1[e], cells.w2[e], cells.z1[e], cells.z2[e]
        for i in range(arms.shape[1]):
            t = dx * (twist[0] - twist[2] * arms[1, i]) + dy * (twist[1] + twist[2] * arms[0, i])
            q = t / (nu + math.sqrt(nu * nu + t * t))
            z1[i], z2[i] = 1.0 - q, 1.0 + q
            w1[i], w2[i] = nu / (1.0 - q), nu / (1.0 + q)


@fast_kernel
def _model(
    twist: Float64Array, geometry: StepGeometry, nu: float, cells: PyramidScratch, impulse: Float64Array, stiffness: Float64Array
) -> None:
    """Friction impulse linearised about `twist` for a Newton step towards `nu`: value, shape (3,), and derivative, shape (3, 3)."""
    arms, limit, dt, cos, sin = geometry.arms, geometry.limit, geometry.dt, geometry.heading[0], geometry.heading[1]
    impulse[:] = 0.0
    stiffness[:] = 0.0
    x, y = arms[0], arms[1]
    for e in range(2):
        dx, dy = (cos + sin, cos - sin) if e == 0 else (cos - sin, -sin - cos)
        w1, w2, z1, z2 = cells.w1[e], cells.w2[e], cells.z1[e], cells.z2[e]
        sum_p = torque_p = sum_k = first_k = second_k = 0.0
        for i in range(limit.shape[0]):
            r = x[i] * dy - y[i] * dx
            c = 0.5 * dt * limit[i]
            t = w1[i] - w2[i]
            missing = dx * twist[0] + dy * twist[1] + r * twist[2] - t
            if abs(missing) > _METHOD.rounding:
                t += missing
            k = 1.0 / (w1[i] / z1[i] + w2[i] / z2[i])
            p = c * (0.5 * (z2[i] - z1[i]) + k * (t - nu / z1[i] + nu / z2[i]))
            ck = c * k
            sum_p += p
            torque_p += r * p
            sum_k += ck
            first_k += ck * r
            second_k += ck * r * r
        impulse[0] += dx * sum_p
        impulse[1] += dy * sum_p
        impulse[2] += torque_p
        stiffness[0, 0] += dx * dx * sum_k
        stiffness[0, 1] += dx * dy * sum_k
        stiffness[1, 1] += dy * dy * sum_k
        stiffness[0, 2] += dx * first_k
        stiffness[1, 2] += dy * first_k
        stiffness[2, 2] += second_k
    stiffness[1, 0], stiffness[2, 0], stiffness[2, 1] = stiffness[0, 1], stiffness[0, 2], stiffness[1, 2]


@fast_kernel
def _longest_step(twist: Float64Array, du: Float64Array, geometry: StepGeometry, nu: float, bold: float, cells: PyramidScratch) -> float:
    """Fill `dq` for a change `du` of the twist. Returns the largest step, at most 1, that lowers no w or z by more than `bold` of it."""
    arms, cos, sin = geometry.arms, geometry.heading[0], geometry.heading[1]
    fastest = bold
    x, y = arms[0], arms[1]
    for e in range(2):
        dx, dy = (cos + sin, cos - sin) if e == 0 else (cos - sin, -sin - cos)
        all_w1, all_w2, all_z1, all_z2, all_dq = cells.w1[e], cells.w2[e], cells.z1[e], cells.z2[e], cells.dq[e]
        for i in range(x.shape[0]):
            r = x[i] * dy - y[i] * dx
            t = all_w1[i] - all_w2[i]
            missing = dx * twist[0] + dy * twist[1] + r * twist[2] - t
            if abs(missing) > _METHOD.rounding:
                t += missing
            t += dx * du[0] + dy * du[1] + r * du[2]
            w1, w2, r1, r2 = all_w1[i], all_w2[i], 1.0 / all_z1[i], 1.0 / all_z2[i]
            dq = (t - nu * r1 + nu * r2) / (w1 * r1 + w2 * r2)
            all_dq[i] = dq
            # Relative decrease of each variable in a full step.
            fastest = max(fastest, max(dq * r1, -dq * r2))
            fastest = max(fastest, max(1.0 - (nu / w1 + dq) * r1, 1.0 - (nu / w2 - dq) * r2))
    return bold / fastest


@fast_kernel
def _advance(share: float, nu: float, cells: PyramidScratch) -> float:
    """Take the fraction `share` of the step. Returns the greatest product w z."""
    worst = 0.0
    for e in range(2):
        all_w1, all_w2, all_z1, all_z2, all_dq = cells.w1[e], cells.w2[e], cells.z1[e], cells.z2[e], cells.dq[e]
        for i in range(all_dq.shape[0]):
            w1, w2, z1, z2, dq = all_w1[i], all_w2[i], all_z1[i], all_z2[i], all_dq[i]
            w1 += share * ((nu + w1 * dq) / z1 - w1)
            w2 += share * ((nu - w2 * dq) / z2 - w2)
            z1 -= share * dq
            z2 += share * dq
            all_w1[i], all_w2[i], all_z1[i], all_z2[i] = w1, w2, z1, z2
            worst = max(worst, max(w1 * z1, w2 * z2))
    return worst


@kernel
def pyramid_step(
    twist: Float64Array,
    geometry: StepGeometry,
    contacts: StepContacts,
    last_code: int,
    impulse: Float64Array,
    scratch: StepScratch,
    cells: PyramidScratch,
) -> tuple[int, int]:
    """Advance `twist` by one step, in place. As `step.step`, with `cells` as additional scratch space."""
    old, du, friction, right, h, miss = scratch.old, scratch.du, scratch.gradient, scratch.right, scratch.model, scratch.miss
    rows, inertia, reach = contacts.rows, geometry.inertia, geometry.reach
    old[:] = twist
    new_impulse = np.empty_like(impulse)
    first_nu = 1e-2
    for i in range(3):
        first_nu = max(first_nu, abs(twist[i]) * (reach if i == 2 else 1.0))
    for k in range(contacts.number):
        first_nu = max(first_nu, abs(rows[k, Row.BOUND]), abs(rows[MAX_CONTACTS + k, Row.BOUND]))
    first_nu *= 0.1
    iterations = 0
    for bold, pace in _METHOD.attempts:
        twist[:] = old
        impulse[:] = 0.0
        nu = first_nu
        _start(twist, geometry, nu, cells)
        code = last_code
        for _ in range(_METHOD.max_iterations):
            iterations += 1
            _model(twist, geometry, nu, cells, friction, h)
            for i in range(3):
                h[i, i] += inertia[i]
                right[i] = inertia[i] * (old[i] - twist[i]) - friction[i]
            for i in range(2 * MAX_CONTACTS):
                miss[i] = rows[i, Row.BOUND] - rows[i, 0] * twist[0] - rows[i, 1] * twist[1] - rows[i, 2] * twist[2]
            code = solve_modes(h, right, contacts, miss, code, du, new_impulse, scratch.mode)
            if code == Mode.NONE:
                break
            share = _longest_step(twist, du, geometry, nu, bold, cells)
            worst = _advance(share, nu, cells)
            change = 0.0
            size = 1e-2
            for i in range(3):
                unit = reach if i == 2 else 1.0
                change = max(change, abs(du[i]) * unit)
                twist[i] += share * du[i]
                size = max(size, abs(twist[i]) * unit)
            for i in range(impulse.shape[0]):
                impulse[i] += share * (new_impulse[i] - impulse[i])
            if nu == FINAL_NU and share == 1.0 and change <= _METHOD.tolerance * size and worst <= 2.0 * nu:
                return code, iterations
            nu = max(FINAL_NU, worst * max(pace, 1.0 - 0.99 * share))
    return Mode.NONE, iterations


@kernel
def _add_condition(row: Float64Array, stuck: Float64Array) -> None:
    """Add a row, shape (4,), to the triangular factor [R s], shape (3, 4), by Givens rotations: R' R and R' s grow by its products."""
    for j in range(3):
        if row[j] == 0.0:
            continue
        length = math.hypot(stuck[j, j], row[j])
        c, s = stuck[j, j] / length, row[j] / length
        for k in range(j, 4):
            above, below = stuck[j, k], row[k]
            stuck[j, k], row[k] = c * above + s * below, c * below - s * above


@fast_kernel
def pyramid_friction(twist: Float64Array, geometry: StepGeometry, cells: PyramidScratch, support: SupportImpulse) -> None:
    """Friction impulse at the solution of a step, and its derivatives, separate for sliding and sticking diagonals.

    The stiffness of a sticking diagonal is about 1e10 times the mass of the object. Added to the inertia, it would leave six of its
    sixteen digits. So sticking diagonals have rows of their own, which `step_derivative.py` treats like those of a contact.

    Args:
        support: filled. `stiffness` holds the sliding diagonals, `stuck` the sticking ones.

    The other arguments are those of `pyramid_step`, after its call.
    """
    arms, limit, dt, cos, sin = geometry.arms, geometry.limit, geometry.dt, geometry.heading[0], geometry.heading[1]
    impulse, stiffness, by_yaw, stuck = support.impulse, support.stiffness, support.by_yaw, support.stuck
    impulse[:], stiffness[:], by_yaw[:], stuck[:] = 0.0, 0.0, 0.0, 0.0
    x, y = arms[0], arms[1]
    softest = 1e3 * geometry.inertia[0]  # a stiffer diagonal counts as sticking, in the derivative only
    row = np.empty(4)
    for e in range(2):
        dx, dy = (cos + sin, cos - sin) if e == 0 else (cos - sin, -sin - cos)
        # In object axes the diagonal rotates by -dyaw.
        ex, ey = dy, -dx
        w1, w2, z1, z2 = cells.w1[e], cells.w2[e], cells.z1[e], cells.z2[e]
        sum_p = torque_p = torque_e = sum_k = first_k = second_k = sum_t = first_t = 0.0
        n_stuck = 0
        for i in range(limit.shape[0]):
            r, turn_arm = x[i] * dy - y[i] * dx, x[i] * ey - y[i] * ex
            c = 0.5 * dt * limit[i]
            p = 0.5 * c * (z2[i] - z1[i])
            k = c / (w1[i] / z1[i] + w2[i] / z2[i])
            n_stuck += 1 if k > softest else 0
            k = 0.0 if k > softest else k
            t = ex * twist[0] + ey * twist[1] + turn_arm * twist[2]
            sum_p += p
            torque_p += r * p
            torque_e += turn_arm * p
            sum_k += k
            first_k += k * r
            second_k += k * r * r
            sum_t += k * t
            first_t += k * r * t
        impulse[0] += dx * sum_p
        impulse[1] += dy * sum_p
        impulse[2] += torque_p
        stiffness[0, 0] += dx * dx * sum_k
        stiffness[0, 1] += dx * dy * sum_k
        stiffness[1, 1] += dy * dy * sum_k
        stiffness[0, 2] += dx * first_k
        stiffness[1, 2] += dy * first_k
        stiffness[2, 2] += second_k
        by_yaw[0] += ex * sum_p + dx * sum_t
        by_yaw[1] += ey * sum_p + dy * sum_t
        by_yaw[2] += torque_e + first_t
        for i in range(limit.shape[0] if n_stuck else 0):
            k = 0.5 * dt * limit[i] / (w1[i] / z1[i] + w2[i] / z2[i])
            if k > softest:
                root = math.sqrt(k)
                row[0], row[1], row[2] = root * dx, root * dy, root * (x[i] * dy - y[i] * dx)
                row[3] = root * (ex * (twist[0] - twist[2] * y[i]) + ey * (twist[1] + twist[2] * x[i]))
                _add_condition(row, stuck)
    stiffness[1, 0], stiffness[2, 0], stiffness[2, 1] = stiffness[0, 1], stiffness[0, 2], stiffness[1, 2]
