"""A whole push, step by step, with its exact derivative carried along (compiled).

The derivative is that of the discrete motion itself: each step's optimality conditions are differentiated at their solution
(implicit function theorem) and chained. Sliding contact makes that linear system unsymmetric: the impulse acts along
N' + drag T' while the constraint is N alone. It must be solved as it stands, not with its transpose.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from push_ident.physics.contact import CONTACT_FIELDS, MAX_CONTACTS, find_contacts
from push_ident.physics.step import MODE_FREE, MODE_SLIDE_PLUS, MODE_STICK, solve_small, step
from push_ident.types import Float64Array

__all__ = ["N_BODY_PARAMETERS", "PARAM_CENTRE", "PARAM_INERTIA", "PARAM_LIMIT", "PARAM_MASS", "PARAM_MU", "PARAM_POSE", "rollout"]

PARAM_POSE = 0
"""First of the three columns of the first pose (x, y, yaw)."""
PARAM_MASS = 3
PARAM_CENTRE = 4
"""First of the two columns of the centre of mass, object frame."""
PARAM_INERTIA = 6
PARAM_MU = 7
PARAM_LIMIT = 8
"""First column of the friction limits of the cells."""
N_BODY_PARAMETERS = 8


def _renew_cache() -> None:
    """Make this file as new as the kernels it calls: numba's cache of a caller does not notice that a callee changed."""
    here = Path(__file__)
    newest = max(here.with_name(name).stat().st_mtime for name in ("contact.py", "step.py"))
    if here.stat().st_mtime < newest and os.access(here, os.W_OK):
        os.utime(here, (newest, newest))


_renew_cache()

_REACH = 2e-3  # contacts nearer than this take part in a step [m]
_REST = 1e-3  # an untouched object slower than this share of eps stands still
_N_SEEDS = 11  # 6 of the state, then mass, centre (2), inertia, mu


@njit(cache=True)
def _contact_rows(
    contact: Float64Array, cx: float, cy: float, vx: float, vy: float, dt: float, rows: Float64Array, bounds: Float64Array, k: int
) -> None:
    """Write N (and T for the first contact) and their bounds; k = 0 writes rows 0 and 1, k = 1 row 2."""
    gap, nx, ny = contact[0], contact[1], contact[2]
    ax, ay = contact[3] - cx, contact[4] - cy
    i = 0 if k == 0 else 2
    rows[i, 0], rows[i, 1], rows[i, 2] = -nx, -ny, -(ax * ny - ay * nx)
    bounds[i] = -(nx * vx + ny * vy) - gap / dt
    if k == 0:
        tx, ty = -ny, nx
        rows[1, 0], rows[1, 1], rows[1, 2] = tx, ty, ax * ty - ay * tx
        bounds[1] = tx * vx + ty * vy


@njit(cache=True)
def _contact_rows_seed(
    contact: Float64Array,
    cx: float,
    cy: float,
    vx: float,
    vy: float,
    dt: float,
    dpb: Float64Array,
    dc: Float64Array,
    dv: Float64Array,
    d_rows: Float64Array,
    d_bounds: Float64Array,
    k: int,
) -> None:
    """Derivative of `_contact_rows` for a change of pusher centre dpb, centre of mass dc and pusher velocity dv."""
    nx, ny = contact[1], contact[2]
    ax, ay = contact[3] - cx, contact[4] - cy
    along = -ny * dpb[0] + nx * dpb[1]
    dnx, dny = contact[5] * along * -ny, contact[5] * along * nx
    dax, day = -dc[0], -dc[1]
    if contact[6] == 0.0:
        dax += along * -ny
        day += along * nx
    dgap = nx * dpb[0] + ny * dpb[1]
    i = 0 if k == 0 else 2
    d_rows[i, 0], d_rows[i, 1] = -dnx, -dny
    d_rows[i, 2] = -(dax * ny + ax * dny - day * nx - ay * dnx)
    d_bounds[i] = -(dnx * vx + dny * vy + nx * dv[0] + ny * dv[1]) - dgap / dt
    if k == 0:
        tx, ty, dtx, dty = -ny, nx, -dny, dnx
        d_rows[1, 0], d_rows[1, 1] = dtx, dty
        d_rows[1, 2] = dax * ty + ax * dty - day * tx - ay * dtx
        d_bounds[1] = dtx * vx + dty * vy + tx * dv[0] + ty * dv[1]


@njit(cache=True)
def _step_sensitivity(
    twist: Float64Array,
    old: Float64Array,
    hessian: Float64Array,
    friction_sum: Float64Array,
    inertia: Float64Array,
    contacts: Float64Array,
    n_contacts: int,
    rows: Float64Array,
    impulse: Float64Array,
    code: int,
    mu: float,
    centre: Float64Array,
    pusher: Float64Array,
    velocity: Float64Array,
    cos: float,
    sin: float,
    dt: float,
    out: Float64Array,
) -> bool:
    """d(new twist) for a unit force impulse on each velocity (columns 0-2) and for each seed (columns 3-13), object axes.

    `pusher` is the pusher's centre and `velocity` its velocity, both in object axes. Fills `out`, shape (3, 14).
    False where the system is singular.
    """
    mode, second = code % 4, code // 4
    drag = 0.0
    drag_sign = 0.0
    a = np.zeros((6, 6))
    b = np.zeros((6, 3 + _N_SEEDS))
    for i in range(3):
        for j in range(3):
            a[i, j] = hessian[i, j]
        b[i, i] = 1.0
    n = 3
    if mode != MODE_FREE:
        if mode != MODE_STICK:
            drag_sign = -1.0 if mode == MODE_SLIDE_PLUS else 1.0
            drag = drag_sign * mu
        for i in range(3):
            a[i, n] = -(rows[0, i] + drag * rows[1, i])
            a[n, i] = rows[0, i]
        n += 1
        if mode == MODE_STICK:
            for i in range(3):
                a[i, n] = -rows[1, i]
                a[n, i] = rows[1, i]
            n += 1
    if second > 0:
        for i in range(3):
            a[i, n] = -rows[2, i]
            a[n, i] = rows[2, i]
        n += 1

    d_rows = np.zeros((3, 3))
    d_bounds = np.zeros(3)
    dpb, dc, dv = np.empty(2), np.empty(2), np.empty(2)
    omega = twist[2]
    for seed in range(_N_SEEDS):
        column = 3 + seed
        dpb[:], dc[:], dv[:] = 0.0, 0.0, 0.0
        if seed == 0:
            dpb[0], dpb[1] = -cos, sin
        elif seed == 1:
            dpb[0], dpb[1] = -sin, -cos
        elif seed == 2:
            # A turn of the object by d turns everything seen from it by -d.
            dpb[0], dpb[1] = pusher[1] - centre[1], -(pusher[0] - centre[0])
            dv[0], dv[1] = velocity[1], -velocity[0]
            b[0, column] += inertia[0] * old[1]
            b[1, column] += -inertia[1] * old[0]
        elif seed == 3:
            b[0, column] += inertia[0] * cos
            b[1, column] += -inertia[1] * sin
        elif seed == 4:
            b[0, column] += inertia[0] * sin
            b[1, column] += inertia[1] * cos
        elif seed == 5:
            b[2, column] += inertia[2]
        elif seed == 6:
            b[0, column] += old[0] - twist[0]
            b[1, column] += old[1] - twist[1]
        elif seed == 7 or seed == 8:
            dc[seed - 7] = 1.0
            dpb[seed - 7] = 1.0
            # Cell arms shrink by dc: their velocities change by omega (dc_y, -dc_x), their torques by -dc x force.
            sx, sy = omega * dc[1], -omega * dc[0]
            for i in range(3):
                b[i, column] -= (hessian[i, 0] - (inertia[0] if i == 0 else 0.0)) * sx
                b[i, column] -= (hessian[i, 1] - (inertia[1] if i == 1 else 0.0)) * sy
            b[2, column] += dt * (dc[0] * friction_sum[1] - dc[1] * friction_sum[0])
        elif seed == 9:
            b[2, column] += old[2] - twist[2]
        else:
            for i in range(3):
                b[i, column] += drag_sign * impulse[0] * rows[1, i]
        if code == 0:
            continue
        for k in range(n_contacts):
            _contact_rows_seed(contacts[k], centre[0], centre[1], velocity[0], velocity[1], dt, dpb, dc, dv, d_rows, d_bounds, k)
        m = 3
        if mode != MODE_FREE:
            c = d_bounds[0]
            for i in range(3):
                b[i, column] += d_rows[0, i] * impulse[0] + d_rows[1, i] * impulse[1]
                c -= d_rows[0, i] * twist[i]
            b[m, column] = c
            m += 1
            if mode == MODE_STICK:
                c = d_bounds[1]
                for i in range(3):
                    c -= d_rows[1, i] * twist[i]
                b[m, column] = c
                m += 1
        if second > 0:
            c = d_bounds[2]
            for i in range(3):
                b[i, column] += d_rows[2, i] * impulse[2]
                c -= d_rows[2, i] * twist[i]
            b[m, column] = c
    if not solve_small(a, b, n, 3 + _N_SEEDS):
        return False
    for i in range(3):
        for j in range(3 + _N_SEEDS):
            out[i, j] = b[i, j]
    return True


@njit(cache=True, fastmath={"nnan", "ninf", "nsz", "arcp", "contract", "reassoc"})
def _advance_sensitivity(
    s: Float64Array,
    d: Float64Array,
    twist: Float64Array,
    arms: Float64Array,
    cos: float,
    sin: float,
    dt: float,
    eps: float,
) -> None:
    """Carry the sensitivity of the state (6 rows: centre x, y, yaw, velocity x, y, yaw rate) over one step, in place."""
    vx_table, vy_table = cos * twist[0] - sin * twist[1], sin * twist[0] + cos * twist[1]
    for p in range(s.shape[1]):
        s0, s1, s2, s3, s4, s5 = s[0, p], s[1, p], s[2, p], s[3, p], s[4, p], s[5, p]
        u = d[0, 3] * s0 + d[0, 4] * s1 + d[0, 5] * s2 + d[0, 6] * s3 + d[0, 7] * s4 + d[0, 8] * s5
        v = d[1, 3] * s0 + d[1, 4] * s1 + d[1, 5] * s2 + d[1, 6] * s3 + d[1, 7] * s4 + d[1, 8] * s5
        w = d[2, 3] * s0 + d[2, 4] * s1 + d[2, 5] * s2 + d[2, 6] * s3 + d[2, 7] * s4 + d[2, 8] * s5
        if PARAM_MASS <= p < PARAM_LIMIT:
            u += d[0, 6 + p]
            v += d[1, 6 + p]
            w += d[2, 6 + p]
        elif p >= PARAM_LIMIT:
            rx, ry = arms[p - PARAM_LIMIT, 0], arms[p - PARAM_LIMIT, 1]
            cx, cy = twist[0] - twist[2] * ry, twist[1] + twist[2] * rx
            q = -dt / math.sqrt(cx * cx + cy * cy + eps * eps)
            fx, fy = q * cx, q * cy
            ft = rx * fy - ry * fx
            u += d[0, 0] * fx + d[0, 1] * fy + d[0, 2] * ft
            v += d[1, 0] * fx + d[1, 1] * fy + d[1, 2] * ft
            w += d[2, 0] * fx + d[2, 1] * fy + d[2, 2] * ft
        vx = cos * u - sin * v - vy_table * s2
        vy = sin * u + cos * v + vx_table * s2
        s[0, p] = s0 + dt * vx
        s[1, p] = s1 + dt * vy
        s[2, p] = s2 + dt * w
        s[3, p], s[4, p], s[5, p] = vx, vy, w


@njit(cache=True)
def _emit(
    state: Float64Array, s: Float64Array, centre: Float64Array, weight: float, pose: Float64Array, jacobian: Float64Array, derive: bool
) -> None:
    """Add `weight` times the pose of the object frame (and its derivative) to the output of one frame."""
    cos, sin = math.cos(state[2]), math.sin(state[2])
    rx, ry = cos * centre[0] - sin * centre[1], sin * centre[0] + cos * centre[1]
    pose[0] += weight * (state[0] - rx)
    pose[1] += weight * (state[1] - ry)
    pose[2] += weight * state[2]
    if derive:
        for p in range(s.shape[1]):
            jacobian[0, p] += weight * (s[0, p] + ry * s[2, p])
            jacobian[1, p] += weight * (s[1, p] - rx * s[2, p])
            jacobian[2, p] += weight * s[2, p]
        jacobian[0, PARAM_CENTRE] -= weight * cos
        jacobian[0, PARAM_CENTRE + 1] += weight * sin
        jacobian[1, PARAM_CENTRE] -= weight * sin
        jacobian[1, PARAM_CENTRE + 1] -= weight * cos


@njit(cache=True)
def rollout(
    pose0: Float64Array,
    pusher: Float64Array,
    radius: float,
    outline: Float64Array,
    cells: Float64Array,
    limit: Float64Array,
    body: Float64Array,
    mu: float,
    dt: float,
    eps: float,
    frame_step: NDArray[np.int64],
    frame_fraction: Float64Array,
    derive: bool,
    poses: Float64Array,
    jacobian: Float64Array,
    force: Float64Array,
) -> tuple[int, int]:
    """Simulate one push from rest.

    Args:
        pose0: first pose of the object frame in the table frame, shape (3,).
        pusher: centre of the pusher at the steps' ends [m], shape (n_steps + 1, 2), table frame.
        radius: of the pusher [m].
        outline: [m], shape (n_vertices, 2), object frame, counter-clockwise.
        cells: cell centres [m], shape (n_cells, 2), object frame.
        limit: sliding friction of each cell [N], shape (n_cells,).
        body: mass [kg], centre of mass x, y [m], inertia about it [kg m^2], shape (4,), object frame.
        mu: friction coefficient of the pusher.
        dt: [s]
        eps: smoothing speed of the support friction [m/s].
        frame_step, frame_fraction: frame j lies `fraction` of the way through step `frame_step[j]`; ascending.
        derive: whether to fill `jacobian`.
        poses: filled with the poses at the frames, shape (n_frames, 3), table frame.
        jacobian: filled, shape (n_frames, 3, 8 + n_cells) (columns: `PARAM_...`); (n_frames, 3, 0) when not derived.
        force: filled with the pusher's force on the object at each step [N], shape (n_steps, 2), table frame.

    Returns:
        The step that did not converge, or -1; and the total number of iterations.
    """
    n_steps = pusher.shape[0] - 1
    n_parameters = N_BODY_PARAMETERS + cells.shape[0] if derive else 0
    centre = np.array([body[1], body[2]])
    inertia = np.array([body[0], body[0], body[3]])
    arms = cells - centre
    cos, sin = math.cos(pose0[2]), math.sin(pose0[2])
    state = np.zeros(6)
    state[0] = pose0[0] + cos * centre[0] - sin * centre[1]
    state[1] = pose0[1] + sin * centre[0] + cos * centre[1]
    state[2] = pose0[2]
    s = np.zeros((6, n_parameters))
    if derive:
        s[0, 0], s[1, 1], s[2, 2] = 1.0, 1.0, 1.0
        s[0, 2], s[1, 2] = -(state[1] - pose0[1]), state[0] - pose0[0]
        s[0, PARAM_CENTRE], s[0, PARAM_CENTRE + 1] = cos, -sin
        s[1, PARAM_CENTRE], s[1, PARAM_CENTRE + 1] = sin, cos
    poses[:] = 0.0
    jacobian[:] = 0.0
    force[:] = 0.0
    contacts = np.zeros((MAX_CONTACTS, CONTACT_FIELDS))
    rows = np.zeros((3, 3))
    bounds = np.zeros(3)
    impulse = np.zeros(3)
    hessian = np.zeros((3, 3))
    twist = np.zeros(3)
    old = np.zeros(3)
    seen = np.zeros(2)
    velocity = np.zeros(2)
    friction_sum = np.zeros(2)
    d = np.zeros((3, 3 + _N_SEEDS))
    reach_of_body = math.sqrt(inertia[2] / inertia[0])
    frame = 0
    iterations = 0
    code = 0
    for n in range(n_steps):
        first = frame
        while frame < frame_step.shape[0] and frame_step[frame] == n:
            _emit(state, s, centre, 1.0 - frame_fraction[frame], poses[frame], jacobian[frame], derive)
            frame += 1
        cos, sin = math.cos(state[2]), math.sin(state[2])
        px, py = pusher[n, 0] - state[0], pusher[n, 1] - state[1]
        seen[0], seen[1] = cos * px + sin * py + centre[0], -sin * px + cos * py + centre[1]
        qx, qy = (pusher[n + 1, 0] - pusher[n, 0]) / dt, (pusher[n + 1, 1] - pusher[n, 1]) / dt
        velocity[0], velocity[1] = cos * qx + sin * qy, -sin * qx + cos * qy
        speed = math.hypot(qx, qy)
        moving = state[3] != 0.0 or state[4] != 0.0 or state[5] != 0.0
        n_contacts = find_contacts(seen[0], seen[1], radius, outline, _REACH + speed * dt, contacts)
        idle = not moving and (n_contacts == 0 or (contacts[0, 0] >= -1e-9 and (speed == 0.0 or contacts[0, 0] > speed * dt)))
        if not idle:
            twist[0], twist[1], twist[2] = cos * state[3] + sin * state[4], -sin * state[3] + cos * state[4], state[5]
            old[:] = twist
            rows[:] = 0.0
            bounds[:] = 0.0
            for k in range(n_contacts):
                _contact_rows(contacts[k], centre[0], centre[1], velocity[0], velocity[1], dt, rows, bounds, k)
            code, used = step(twist, arms, limit, inertia, rows, bounds, n_contacts, mu, dt, eps, max(code, 0), impulse, hessian)
            iterations += used
            if code < 0:
                return n, iterations
            fx = rows[0, 0] * impulse[0] + rows[1, 0] * impulse[1] + rows[2, 0] * impulse[2]
            fy = rows[0, 1] * impulse[0] + rows[1, 1] * impulse[1] + rows[2, 1] * impulse[2]
            force[n, 0], force[n, 1] = (cos * fx - sin * fy) / dt, (sin * fx + cos * fy) / dt
            still = code == MODE_FREE and max(math.hypot(twist[0], twist[1]), abs(twist[2]) * reach_of_body) < _REST * eps
            if derive:
                # Friction of all cells together, from the balance of the step.
                friction_sum[0] = (inertia[0] * (old[0] - twist[0]) + fx) / dt
                friction_sum[1] = (inertia[1] * (old[1] - twist[1]) + fy) / dt
                if not _step_sensitivity(
                    twist,
                    old,
                    hessian,
                    friction_sum,
                    inertia,
                    contacts,
                    n_contacts,
                    rows,
                    impulse,
                    code,
                    mu,
                    centre,
                    seen,
                    velocity,
                    cos,
                    sin,
                    dt,
                    d,
                ):
                    return n, iterations
                _advance_sensitivity(s, d, twist, arms, cos, sin, dt, eps)
                if still:
                    s[3:] = 0.0
            vx, vy = cos * twist[0] - sin * twist[1], sin * twist[0] + cos * twist[1]
            state[0] += dt * vx
            state[1] += dt * vy
            state[2] += dt * twist[2]
            state[3], state[4], state[5] = vx, vy, twist[2]
            if still:
                state[3:] = 0.0
        for j in range(first, frame):
            _emit(state, s, centre, frame_fraction[j], poses[j], jacobian[j], derive)
    return -1, iterations
