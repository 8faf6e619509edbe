"""One implicit step of a rigid object pushed on a table (compiled).

The object has three velocities, those of its centre of mass, `twist` = (vx, vy, omega), here in axes fixed in the object. One
step of length dt finds the new twist u and the contact impulses:

    D (u - u_old) + dt sum_i f_i J_i' phi(J_i u) = N' l_n + T' l_t,      phi(v) = v / sqrt(|v|^2 + eps^2)
    0 <= l_n  perpendicular to  N u - b_n >= 0,      b_n = -n . v_pusher - gap / dt
    |l_t| <= mu l_n,  l_t against the slip  T u - t . v_pusher

with D = diag(m, m, I), J_i the velocity of cell i, f_i = mu_i m_i g its support friction. This is the problem of Song & Boularias
(2020, Eq. 2 and its figure of the equations of motion) with the rigid joints eliminated and the friction pyramid of a cell
replaced by its circular cone. Friction of the pusher is exact (stick or slip, no smoothing); only the support friction is smoothed, at eps.
It acts at the nearest contact; a second one (a concave corner) carries a normal force alone, since two normal forces and one
tangential force already fix the three velocities.

Each iteration replaces the support friction by a quadratic model, whose small contact problem is solved exactly by trying its
modes. The model is Newton's; where Newton does not contract, the majorising one of iteratively reweighted least squares, which
always descends.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from push_ident.types import Float64Array

__all__ = ["MODE_FREE", "MODE_SLIDE_MINUS", "MODE_SLIDE_PLUS", "MODE_STICK", "solve_small", "step", "support_friction"]

MODE_FREE = 0
MODE_STICK = 1
MODE_SLIDE_PLUS = 2
"""The object slides along +t on the pusher, so that the tangential impulse is -mu l_n."""
MODE_SLIDE_MINUS = 3

_MAX_ITERATIONS = 100
_TOLERANCE = 1e-10


@njit(cache=True, fastmath={"nnan", "ninf", "nsz", "arcp", "contract", "reassoc"})
def support_friction(
    twist: Float64Array, arms: Float64Array, limit: Float64Array, eps: float, newton: bool, gradient: Float64Array, hessian: Float64Array
) -> None:
    """Friction of the table on all cells: sum_i f_i J_i' phi(J_i u) and its derivative with respect to u.

    Args:
        twist: of the centre of mass, object axes [m/s, m/s, rad/s], shape (3,).
        arms: cell centres from the centre of mass [m], shape (n_cells, 2), object axes.
        limit: friction force of each cell when it slides [N], shape (n_cells,).
        eps: speed at which friction is smoothed [m/s].
        newton: the true derivative; else the majorising one.
        gradient: filled [N, N, N m], shape (3,).
        hessian: filled, shape (3, 3).
    """
    vx, vy, w = twist[0], twist[1], twist[2]
    g0 = g1 = g2 = 0.0
    h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    turn = 1.0 if newton else 0.0
    for i in range(arms.shape[0]):
        rx, ry = arms[i, 0], arms[i, 1]
        ux, uy = vx - w * ry, vy + w * rx
        s = 1.0 / math.sqrt(ux * ux + uy * uy + eps * eps)
        fs = limit[i] * s
        px, py = fs * ux, fs * uy
        g0 += px
        g1 += py
        g2 += rx * py - ry * px
        q = turn * s * s
        kxx = fs * (1.0 - q * ux * ux)
        kxy = -fs * q * ux * uy
        kyy = fs * (1.0 - q * uy * uy)
        ax = kxy * rx - kxx * ry
        ay = kyy * rx - kxy * ry
        h00 += kxx
        h01 += kxy
        h11 += kyy
        h02 += ax
        h12 += ay
        h22 += rx * ay - ry * ax
    gradient[0], gradient[1], gradient[2] = g0, g1, g2
    hessian[0, 0], hessian[0, 1], hessian[0, 2] = h00, h01, h02
    hessian[1, 0], hessian[1, 1], hessian[1, 2] = h01, h11, h12
    hessian[2, 0], hessian[2, 1], hessian[2, 2] = h02, h12, h22


@njit(cache=True)
def solve_small(a: Float64Array, b: Float64Array, n: int, m: int) -> bool:
    """Solve a[:n, :n] x = b[:n, :m] in place by elimination with row exchange; b becomes x. False where a is singular."""
    for k in range(n):
        p, best = k, abs(a[k, k])
        for i in range(k + 1, n):
            if abs(a[i, k]) > best:
                p, best = i, abs(a[i, k])
        if best == 0.0 or not math.isfinite(best):
            return False
        if p != k:
            for j in range(n):
                a[k, j], a[p, j] = a[p, j], a[k, j]
            for j in range(m):
                b[k, j], b[p, j] = b[p, j], b[k, j]
        for i in range(k + 1, n):
            c = a[i, k] / a[k, k]
            if c != 0.0:
                for j in range(k, n):
                    a[i, j] -= c * a[k, j]
                for j in range(m):
                    b[i, j] -= c * b[k, j]
    for k in range(n - 1, -1, -1):
        for j in range(m):
            x = b[k, j]
            for i in range(k + 1, n):
                x -= a[k, i] * b[i, j]
            b[k, j] = x / a[k, k]
    return True


@njit(cache=True)
def _try_modes(
    free: Float64Array,
    response: Float64Array,
    rows: Float64Array,
    bounds: Float64Array,
    n_contacts: int,
    mu: float,
    impulse: Float64Array,
    last_mode: int,
) -> int:
    """Exact solution of the contact problem of a quadratic model by trying its modes; impulses are (l_n1, l_t1, l_n2).

    `free` is the twist without contact, `response` = H^-1 rows' the twist per impulse. Returns the mode of contact 1 plus four times
    whether contact 2 acts, or -1 when no mode fits.
    """
    w = np.empty((3, 3))
    miss = np.empty(3)
    for i in range(3):
        miss[i] = bounds[i] - rows[i, 0] * free[0] - rows[i, 1] * free[1] - rows[i, 2] * free[2]
        for j in range(3):
            w[i, j] = rows[i, 0] * response[0, j] + rows[i, 1] * response[1, j] + rows[i, 2] * response[2, j]
    a = np.empty((3, 3))
    b = np.empty((3, 1))
    scale = 1e-12 * (1.0 + abs(bounds[0]) + abs(bounds[1]) + abs(bounds[2]))
    for trial in range(-1, 8):
        # The mode of the step before is the likeliest.
        code = last_mode if trial < 0 else trial
        mode, second = code % 4, code // 4
        if second > 0 and n_contacts < 2:
            continue
        n = 0
        drag = -mu if mode == MODE_SLIDE_PLUS else mu
        if mode == MODE_STICK:
            a[0, 0], a[0, 1], a[1, 0], a[1, 1] = w[0, 0], w[0, 1], w[1, 0], w[1, 1]
            b[0, 0], b[1, 0] = miss[0], miss[1]
            if second > 0:
                a[0, 2], a[1, 2], a[2, 0], a[2, 1] = w[0, 2], w[1, 2], w[2, 0], w[2, 1]
            n = 2
        elif mode != MODE_FREE:
            a[0, 0] = w[0, 0] + drag * w[0, 1]
            b[0, 0] = miss[0]
            if second > 0:
                a[0, 1], a[1, 0] = w[0, 2], w[2, 0] + drag * w[2, 1]
            n = 1
        if second > 0:
            a[n, n] = w[2, 2]
            b[n, 0] = miss[2]
            n += 1
        if n > 0 and not solve_small(a, b, n, 1):
            continue
        normal = tangent = other = 0.0
        if mode == MODE_STICK:
            normal, tangent = b[0, 0], b[1, 0]
        elif mode != MODE_FREE:
            normal = b[0, 0]
            tangent = drag * normal
        if second > 0:
            other = b[n - 1, 0]
        if normal < 0.0 or other < 0.0:
            continue
        if mode == MODE_FREE and miss[0] - w[0, 2] * other > scale:
            continue
        if mode == MODE_STICK and abs(tangent) > mu * normal:
            continue
        if mode >= MODE_SLIDE_PLUS:
            slip = w[1, 0] * normal + w[1, 1] * tangent + w[1, 2] * other - miss[1]
            if (mode == MODE_SLIDE_PLUS and slip < -scale) or (mode == MODE_SLIDE_MINUS and slip > scale):
                continue
        if n_contacts > 1 and second == 0 and miss[2] - w[2, 0] * normal - w[2, 1] * tangent > scale:
            continue
        impulse[0], impulse[1], impulse[2] = normal, tangent, other
        return code
    return -1


@njit(cache=True)
def step(
    twist: Float64Array,
    arms: Float64Array,
    limit: Float64Array,
    inertia: Float64Array,
    rows: Float64Array,
    bounds: Float64Array,
    n_contacts: int,
    mu: float,
    dt: float,
    eps: float,
    last_mode: int,
    impulse: Float64Array,
    hessian: Float64Array,
) -> tuple[int, int]:
    """Advance `twist` by one step, in place.

    Args:
        twist: of the centre of mass before, then after the step, object axes [m/s, m/s, rad/s], shape (3,).
        arms: cell centres from the centre of mass [m], shape (n_cells, 2).
        limit: sliding friction of each cell [N], shape (n_cells,).
        inertia: (m, m, I) about the centre of mass [kg, kg, kg m^2].
        rows: N1, T1, N2 of the contacts, shape (3, 3); unused rows zero.
        bounds: b_n1, t . v_pusher, b_n2 [m/s], shape (3,).
        n_contacts: 0, 1 or 2.
        mu: friction coefficient of the pusher.
        dt: [s]
        eps: smoothing speed of the support friction [m/s].
        last_mode: mode code of the step before; only a first guess.
        impulse: filled with l_n1, l_t1, l_n2 [N s], shape (3,).
        hessian: filled with D + dt d(friction)/du at the solution, shape (3, 3).

    Returns:
        The mode code (mode of contact 1 + 4 if contact 2 acts) and the number of iterations; the mode is -1 when it did not converge.
    """
    old = twist.copy()
    gradient = np.empty(3)
    a = np.empty((3, 3))
    b = np.empty((3, 4))
    free = np.empty(3)
    new = np.empty(3)
    reach = math.sqrt(inertia[2] / inertia[0])  # turns a rotation rate into a speed
    newton = True
    last_change = np.inf
    retry_below = 0.0
    mode = last_mode
    impulse[:] = 0.0
    for iteration in range(_MAX_ITERATIONS):
        support_friction(twist, arms, limit, eps, newton, gradient, a)
        for i in range(3):
            for j in range(3):
                a[i, j] *= dt
            a[i, i] += inertia[i]
            b[i, 0] = inertia[i] * (old[i] - twist[i]) - dt * gradient[i]
            for j in range(3):
                b[i, 1 + j] = rows[j, i]
        if not solve_small(a, b, 3, 4):
            return -1, iteration
        for i in range(3):
            free[i] = twist[i] + b[i, 0]
        mode = _try_modes(free, b[:, 1:], rows, bounds, n_contacts, mu, impulse, mode) if n_contacts > 0 else 0
        if mode < 0:
            return -1, iteration
        change = 0.0
        size = eps
        for i in range(3):
            new[i] = free[i] + b[i, 1] * impulse[0] + b[i, 2] * impulse[1] + b[i, 3] * impulse[2]
            unit = reach if i == 2 else 1.0
            change = max(change, abs(new[i] - twist[i]) * unit)
            size = max(size, abs(new[i]) * unit)
        for i in range(3):
            twist[i] = new[i]
        if change <= _TOLERANCE * size + 1e-16:
            support_friction(twist, arms, limit, eps, True, gradient, hessian)
            for i in range(3):
                for j in range(3):
                    hessian[i, j] *= dt
                hessian[i, i] += inertia[i]
            return mode, iteration + 1
        # Newton jumps across the kink of a cell that comes to rest; the majoriser creeps but never fails. After a failure of
        # Newton the majoriser leads until its own steps have become a few times shorter than before that failure.
        if newton and change > 0.5 * last_change:
            newton = False
            retry_below = 0.2 * min(last_change, change)
        elif not newton:
            newton = change < retry_below
        last_change = change
    return -1, _MAX_ITERATIONS
