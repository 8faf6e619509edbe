"""Exact derivative of a push: of one step, and chained over all steps forward (Jacobian) or backward (adjoint) (compiled).

The derivative is that of the discrete motion itself: each step's optimality conditions are differentiated at their solution
(implicit function theorem) and chained. Sliding contact makes that linear system unsymmetric: the impulse acts along
N + drag T while the constraint is N alone. Forward it must be solved as it stands, not with its transpose; the adjoint
applies the transpose of the solved blocks. Cells of the pyramid that stick are stiff beyond what sixteen digits hold beside the inertia;
they enter as up to three conditions more.

The state is s = (centre of mass x, y, yaw; velocity x, y, yaw rate), table axes. With v = R(yaw) u for the linear part,

    s+ = (x + dt v, y.., yaw + dt omega, v, omega),      du = B ds + C dp + A sum_i (d impulse_i / d limit_i) d limit_i

where the 3 x 14 block [A B C] of a step is all that a rollout must keep. Active effects (`table.py`) add to it the response E to their
memory m and their values q, and where an effect shifts the load to the sums of the limits of all cells that it depends on. The memory goes
on by m+ = G (s, mass, centre, m, q), whose derivative is kept as well.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from push_ident.physics.contact import ContactEffects, Rebound, contact_rows_seed
from push_ident.physics.kernel import fast_kernel, kernel
from push_ident.physics.modes import (
    BOUND,
    CONTACT_COLUMNS,
    MAX_CONTACTS,
    SHARES_TANGENT,
    ModeScratch,
    drag_sign,
    mode_system,
    solve_small,
    tangent_row,
)
from push_ident.physics.support import Cone, unit_friction
from push_ident.physics.table import N_FIXED_INPUTS
from push_ident.types import BoolArray, Float64Array

__all__ = [
    "CAME_TO_REST", "IDLE", "MOVED", "N_BODY_PARAMETERS",
    "PARAM_CENTRE", "PARAM_INERTIA", "PARAM_LIMIT", "PARAM_MASS", "PARAM_MU", "PARAM_POSE",
    "EffectDrive", "StepBalance", "Tape", "chain_backward", "chain_forward", "new_effect_drive", "new_tape", "step_sensitivity",
]  # fmt: skip

PARAM_POSE = 0
"""First of the three columns of the first pose (x, y, yaw)."""
PARAM_MASS = 3
PARAM_CENTRE = 4
"""First of the two columns of the centre of mass, object frame."""
PARAM_INERTIA = 6
PARAM_MU = 7
PARAM_LIMIT = 8
"""First column of the friction limits of the cells; behind them stand the values of the active effects."""
N_BODY_PARAMETERS = 8

# Columns of the block of a step: A, the response to a unit impulse on each velocity; then the seeds: B of the state, C of the body.
_IMPULSE = 0
_STATE = 3
_YAW = _STATE + 2
_VELOCITY = _STATE + 3
_MASS = 9
_CENTRE = 10
_INERTIA = 12
_MU = 13
_EFFECTS = 14
"""First column of the memory of the effects, then their values."""

IDLE = 0
MOVED = 1
CAME_TO_REST = 2
"""What a step did: nothing; one implicit step; one after which the velocities were set to zero."""

_CHUNK = 256  # columns of the Jacobian carried at a time, so that they stay in the cache


class Tape(NamedTuple):
    """What the derivative needs of each step of a rollout."""

    event: NDArray[np.int8]
    """`IDLE`, `MOVED` or `CAME_TO_REST`, shape (n_steps,)."""
    block: Float64Array
    """[A B C E], shape (n_steps, 3, 14 + n_memory + n_values), object axes; `N_SUMS` columns more where one shifts the load."""
    twist: Float64Array
    """After the step, object axes at its start, shape (n_steps, 3)."""
    heading: Float64Array
    """cos and sin of the yaw at the start of each step and at the end of the last, shape (n_steps + 1, 2)."""
    factor: Float64Array
    """Of the friction limit of each cell, shape (n_steps, n_cells); of no cells where no effect changes them."""
    skew: Float64Array
    """Of the friction's direction, (a, b) in object axes, shape (n_steps, 2); of no steps where there is none."""
    memory: Float64Array
    """Derivative of the memory after a step by the inputs at its start (`table.py`), shape (n_steps, n_memory, n_inputs)."""


class StepBalance(NamedTuple):
    """A solved step, as its derivative sees it; object axes."""

    twist: Float64Array
    """After the step, shape (3,)."""
    old: Float64Array
    """Before the step, shape (3,)."""
    impulse: Float64Array
    """Normal impulses and the tangential one [N s], shape (MAX_CONTACTS + 1,)."""
    inertia: Float64Array
    """(m, m, I); zeros for a quasi-static step, shape (3,)."""
    friction: Float64Array
    """Impulse of the support friction, dt sum_i f_i J_i' phi_i [N s, N s, N m s], shape (3,)."""
    stiffness: Float64Array
    """Its derivative with respect to the twist but for R' R, shape (3, 3)."""
    by_yaw: Float64Array
    """Its derivative with respect to the yaw at a given twist in object axes but for R' s: zero for the circular cone, shape (3,)."""
    stuck: Float64Array
    """[R s] of the cells that stick, see `pyramid.pyramid_friction`: zero for the circular cone, shape (3, 4)."""


class EffectDrive(NamedTuple):
    """What effects do in a step, as its derivative sees it; object axes. Rows belong to the memory of the effects, then their values,
    then the sums of the limits of the cells."""

    offset: float
    """Of the contact surface [m]."""
    rebound: Rebound
    pusher: Float64Array
    """Change of the pusher's centre, shape (n, 2)."""
    angle: Float64Array
    """Of its angle, shape (n,)."""
    velocity: Float64Array
    """Of its velocity, shape (n, 2)."""
    spin: Float64Array
    by_offset: Float64Array
    """Of the offset, shape (n,)."""
    restitution: Float64Array
    twist: Float64Array
    """Of the twist of the rebound, shape (n, 3)."""
    seeds: Float64Array
    """Impulse that effects on the table add, by the columns of the block [N s, N s, N m s], shape (3, n_columns)."""
    touches: BoolArray
    """Which act on the contacts at all, shape (n,)."""


def new_effect_drive(n_memory: int, n_values: int, n_sums: int) -> EffectDrive:
    """Drive of no effect that acts on the contacts."""
    n = n_memory + n_values + n_sums
    return EffectDrive(
        0.0, Rebound(False, 0.0, np.zeros(3)), np.zeros((n, 2)), np.zeros(n), np.zeros((n, 2)), np.zeros(n), np.zeros(n), np.zeros(n),
        np.zeros((n, 3)), np.zeros((3, _EFFECTS + n)), np.zeros(n, dtype=np.bool_),
    )  # fmt: skip


def new_tape(n_steps: int, n_cells: int = 0, n_memory: int = 0, n_values: int = 0, n_sums: int = 0, *, skewed: bool = False) -> Tape:
    """Empty tape of a rollout; `n_cells` is 0 where no effect changes friction limits."""
    n_inputs = N_FIXED_INPUTS + n_memory + n_values
    return Tape(
        np.zeros(n_steps, dtype=np.int8), np.zeros((n_steps, 3, _EFFECTS + n_memory + n_values + n_sums)), np.zeros((n_steps, 3)),
        np.zeros((n_steps + 1, 2)), np.ones((n_steps, n_cells)), np.zeros((n_steps if skewed else 0, 2)),
        np.zeros((n_steps, n_memory, n_inputs)),
    )  # fmt: skip


@kernel
def _contact_effects(drive: EffectDrive, column: int, d_pusher: Float64Array, d_velocity: Float64Array) -> ContactEffects:
    """What effects do to the contacts per unit of one column; moves the pusher where that is a value that drives it."""
    rebound = drive.rebound
    if column < _EFFECTS:
        d_twist = np.zeros(3)
        if column == _YAW:
            d_twist[0], d_twist[1] = rebound.twist[1], -rebound.twist[0]
        return ContactEffects(drive.offset, rebound, 0.0, 0.0, 0.0, d_twist)
    e = column - _EFFECTS
    d_pusher[:], d_velocity[:] = drive.pusher[e], drive.velocity[e]
    return ContactEffects(drive.offset, rebound, drive.spin[e], drive.by_offset[e], drive.restitution[e], drive.twist[e])


@kernel
def _stuck_size(stuck: Float64Array, j: int) -> float:
    """What row j of [R s] is divided by: its length, and 1 for a row of nothing but rounding."""
    return 1.0 + math.sqrt(stuck[j, 0] ** 2 + stuck[j, 1] ** 2 + stuck[j, 2] ** 2)


@kernel
def _add_stuck(stuck: Float64Array, n: int, a: Float64Array) -> int:
    """Give the system `a` of n unknowns those of the cells that stick, p = R du + s dyaw with R' p in the balance, each row scaled.

    Returns the number of unknowns then.
    """
    if stuck[0, 0] == 0.0 and stuck[1, 1] == 0.0 and stuck[2, 2] == 0.0:
        return n
    a[:n, n : n + 3] = 0.0
    a[n : n + 3, : n + 3] = 0.0
    for j in range(3):
        size = _stuck_size(stuck, j)
        for i in range(3):
            a[n + j, i] = a[i, n + j] = stuck[j, i] / size
        a[n + j, n + j] = -1.0 / (size * size)
    return n + 3


@kernel
def step_sensitivity(
    step: StepBalance,
    rows: Float64Array,
    contacts: Float64Array,
    n_contacts: int,
    code: int,
    mu: float,
    centre: Float64Array,
    pusher: Float64Array,
    velocity: Float64Array,
    spin: float,
    cos: float,
    sin: float,
    dt: float,
    drive: EffectDrive | None,
    scratch: ModeScratch,
    block: Float64Array,
) -> bool:
    """Derivative of the twist after a step: fills its block (`Tape.block`). False where the system is singular.

    `rows` are the contacts as the step saw them (`modes.py`), `contacts` as `contact.py` did; `pusher` is the pusher's centre,
    `velocity` its velocity [m/s] and `spin` its rate of turn [rad/s]; `cos` and `sin` belong to the object's yaw; `drive` holds what
    effects do, None without effects. The other arguments are those of `step.step`.
    """
    twist, old, inertia, impulse, stiffness = step.twist, step.old, step.inertia, step.impulse, step.stiffness
    row = scratch.row
    tangent, sign = tangent_row(code, rows), drag_sign(code)
    h = stiffness.copy()
    for i in range(3):
        h[i, i] += inertia[i]
    n = mode_system(code, h, rows, mu, row, scratch.matrix)
    size = _add_stuck(step.stuck, 3 + n, scratch.matrix)
    n_columns = _EFFECTS if drive is None else drive.seeds.shape[1]
    b = np.zeros((size, n_columns))
    if drive is not None:
        b[:3] = drive.seeds
    for i in range(3):
        b[i, _IMPULSE + i] = 1.0
    d_rows = np.zeros((2 * MAX_CONTACTS, CONTACT_COLUMNS))
    d_pusher, d_centre, d_velocity = np.empty(2), np.empty(2), np.empty(2)
    for column in range(_STATE, n_columns):
        d_pusher[:], d_centre[:], d_velocity[:] = 0.0, 0.0, 0.0
        d_angle = 0.0
        if column == _STATE:
            d_pusher[0], d_pusher[1] = -cos, sin
        elif column == _STATE + 1:
            d_pusher[0], d_pusher[1] = -sin, -cos
        elif column == _YAW:
            # A turn of the object by d turns everything seen from it by -d.
            d_angle = -1.0
            d_pusher[0], d_pusher[1] = pusher[1] - centre[1], -(pusher[0] - centre[0])
            d_velocity[0], d_velocity[1] = velocity[1], -velocity[0]
            b[0, column] += inertia[0] * old[1]
            b[1, column] -= inertia[1] * old[0]
            for i in range(3):
                b[i, column] -= step.by_yaw[i]
            for j in range(3 + n, size):
                b[j, column] = -step.stuck[j - 3 - n, 3] / _stuck_size(step.stuck, j - 3 - n)
        elif column == _VELOCITY:
            b[0, column] += inertia[0] * cos
            b[1, column] -= inertia[1] * sin
        elif column == _VELOCITY + 1:
            b[0, column] += inertia[0] * sin
            b[1, column] += inertia[1] * cos
        elif column == _VELOCITY + 2:
            b[2, column] += inertia[2]
        elif column == _MASS:
            if inertia[0] > 0.0:
                b[0, column] += old[0] - twist[0]
                b[1, column] += old[1] - twist[1]
        elif column == _CENTRE or column == _CENTRE + 1:
            d_centre[column - _CENTRE] = 1.0
            d_pusher[column - _CENTRE] = 1.0
            # Cell arms shrink by dc: their velocities change by omega (dc_y, -dc_x), their torques by -dc x force.
            sx, sy = twist[2] * d_centre[1], -twist[2] * d_centre[0]
            for i in range(3):
                b[i, column] -= stiffness[i, 0] * sx + stiffness[i, 1] * sy
            for j in range(3 + n, size):
                b[j, column] = -(scratch.matrix[j, 0] * sx + scratch.matrix[j, 1] * sy)
            b[2, column] += d_centre[0] * step.friction[1] - d_centre[1] * step.friction[0]
        elif column == _INERTIA:
            if inertia[2] > 0.0:
                b[2, column] += old[2] - twist[2]
        elif column == _MU:
            carried = 0.0
            for k in range(n_contacts):
                carried += impulse[k] * rows[k, SHARES_TANGENT]
            for i in range(3):
                b[i, column] += sign * carried * rows[tangent, i]
        if n == 0 or not (_STATE <= column <= _YAW or column == _CENTRE or column == _CENTRE + 1 or column >= _EFFECTS):
            continue
        if drive is not None and column >= _EFFECTS and not drive.touches[column - _EFFECTS]:
            continue
        if drive is None:
            for k in range(n_contacts):
                contact_rows_seed(contacts[k], k, centre, pusher, velocity, spin, dt, d_pusher, d_angle, d_centre, d_velocity, None, d_rows)
        else:
            effects = _contact_effects(drive, column, d_pusher, d_velocity)
            if column >= _EFFECTS:
                d_angle = drive.angle[column - _EFFECTS]
            for k in range(n_contacts):
                contact_rows_seed(
                    contacts[k], k, centre, pusher, velocity, spin, dt, d_pusher, d_angle, d_centre, d_velocity, effects, d_rows
                )
        for i in range(3):
            b[i, column] += d_rows[tangent, i] * impulse[MAX_CONTACTS]
            for k in range(n_contacts):
                b[i, column] += d_rows[k, i] * impulse[k]
        for j in range(n):
            k = row[j]
            b[3 + j, column] = d_rows[k, BOUND] - d_rows[k, 0] * twist[0] - d_rows[k, 1] * twist[1] - d_rows[k, 2] * twist[2]
    if not solve_small(scratch.matrix, b, size, n_columns):
        return False
    block[:] = b[:3]
    return True


@fast_kernel
def _limit_columns(d: Float64Array, twist: Float64Array, arms: Float64Array, cone: Cone, dt: float, du: Float64Array) -> None:
    """Change of the twist after a step per unit of the friction limit of each cell, shape (3, n_cells)."""
    x, y = arms[0], arms[1]
    for i in range(x.shape[0]):
        rx, ry = x[i], y[i]
        px, py = unit_friction(twist[0] - twist[2] * ry, twist[1] + twist[2] * rx, cone)
        fx, fy = -dt * px, -dt * py
        ft = rx * fy - ry * fx
        du[0, i] = d[0, 0] * fx + d[0, 1] * fy + d[0, 2] * ft
        du[1, i] = d[1, 0] * fx + d[1, 1] * fy + d[1, 2] * ft
        du[2, i] = d[2, 0] * fx + d[2, 1] * fy + d[2, 2] * ft


@fast_kernel
def _add_skew_columns(
    d: Float64Array, twist: Float64Array, arms: Float64Array, skew: Float64Array, eps: float, dt: float, du: Float64Array
) -> None:
    """Add to `_limit_columns` of the circular cone what friction that depends on the direction of motion brings."""
    x, y = arms[0], arms[1]
    a, b = skew[0], skew[1]
    for i in range(x.shape[0]):
        rx, ry = x[i], y[i]
        ux, uy = twist[0] - twist[2] * ry, twist[1] + twist[2] * rx
        scale = -dt / math.sqrt(ux * ux + uy * uy + eps * eps)
        fx, fy = scale * (a * ux + b * uy), scale * (b * ux - a * uy)
        ft = rx * fy - ry * fx
        du[0, i] += d[0, 0] * fx + d[0, 1] * fy + d[0, 2] * ft
        du[1, i] += d[1, 0] * fx + d[1, 1] * fy + d[1, 2] * ft
        du[2, i] += d[2, 0] * fx + d[2, 1] * fy + d[2, 2] * ft


@kernel
def _effect_columns(
    tape: Tape, n: int, arms: Float64Array, own_arms: Float64Array, first: int, last: int, eps: float, dt: float,
    n_values: int, memory: Float64Array, du: Float64Array,
) -> None:  # fmt: skip
    """Let effects change the part of the twist after step n that does not come from the state, columns `first` to `last`.

    `own_arms` are the arms of the cells among these columns; `memory` is the derivative of the memory at the start of the step.
    """
    block = tape.block[n]
    n_memory = tape.memory.shape[1]
    n_body = max(0, N_BODY_PARAMETERS - first)
    if tape.skew.shape[0] > 0:
        _add_skew_columns(block, tape.twist[n], own_arms, tape.skew[n], eps, dt, du[:, n_body:])
    if tape.factor.shape[1] > 0:
        factor = tape.factor[n, first + n_body - N_BODY_PARAMETERS :]
        for i in range(3):
            for p in range(own_arms.shape[1]):
                du[i, n_body + p] *= factor[p]
    first_value = N_BODY_PARAMETERS + arms.shape[1]
    first_sum = _EFFECTS + n_memory + n_values
    if block.shape[1] > first_sum:
        x, y = own_arms[0], own_arms[1]
        for i in range(3):
            b = block[i, first_sum:]
            for p in range(own_arms.shape[1]):
                du[i, n_body + p] += b[0] + (b[1] + b[3] * x[p] + b[4] * y[p]) * x[p] + (b[2] + b[5] * y[p]) * y[p]
    for i in range(3):
        for p in range(max(first, first_value), last):
            du[i, p - first] = block[i, _EFFECTS + n_memory + p - first_value]
        if n_memory > 0 and first == 0:
            du[i, :PARAM_MASS] = 0.0
        for j in range(n_memory):
            for p in range(last - first):
                du[i, p] += block[i, _EFFECTS + j] * memory[j, p]


@kernel
def _advance_memory(by_inputs: Float64Array, s: Float64Array, first: int, last: int, n_cells: int, memory: Float64Array) -> None:
    """Carry the derivative of the memory, columns `first` to `last`, over one step; `s` is that of the state at its start."""
    before = memory.copy()
    n_memory = memory.shape[0]
    first_value = N_BODY_PARAMETERS + n_cells
    for j in range(n_memory):
        g = by_inputs[j]
        for p in range(last - first):
            memory[j, p] = 0.0
            for i in range(6):
                memory[j, p] += g[i] * s[i, p]
            for i in range(n_memory):
                memory[j, p] += g[N_FIXED_INPUTS + i] * before[i, p]
        if first == 0:
            # Mass and centre of mass stand side by side in both orders.
            for i in range(3):
                memory[j, PARAM_MASS + i] += g[6 + i]
        for p in range(max(first, first_value), last):
            memory[j, p - first] += g[N_FIXED_INPUTS + n_memory + p - first_value]


@fast_kernel
def _advance(s: Float64Array, du: Float64Array, d: Float64Array, twist: Float64Array, cos: float, sin: float, dt: float) -> None:
    """Carry the derivative of the state, shape (6, n), over one step; `du` is the part of the twist that does not come from the state."""
    vx_table, vy_table = cos * twist[0] - sin * twist[1], sin * twist[0] + cos * twist[1]
    for p in range(s.shape[1]):
        s0, s1, s2, s3, s4, s5 = s[0, p], s[1, p], s[2, p], s[3, p], s[4, p], s[5, p]
        u = du[0, p] + d[0, 3] * s0 + d[0, 4] * s1 + d[0, 5] * s2 + d[0, 6] * s3 + d[0, 7] * s4 + d[0, 8] * s5
        v = du[1, p] + d[1, 3] * s0 + d[1, 4] * s1 + d[1, 5] * s2 + d[1, 6] * s3 + d[1, 7] * s4 + d[1, 8] * s5
        w = du[2, p] + d[2, 3] * s0 + d[2, 4] * s1 + d[2, 5] * s2 + d[2, 6] * s3 + d[2, 7] * s4 + d[2, 8] * s5
        vx = cos * u - sin * v - vy_table * s2
        vy = sin * u + cos * v + vx_table * s2
        s[0, p] = s0 + dt * vx
        s[1, p] = s1 + dt * vy
        s[2, p] = s2 + dt * w
        s[3, p], s[4, p], s[5, p] = vx, vy, w


@kernel
def _emit(
    s: Float64Array, cos: float, sin: float, centre: Float64Array, weight: float, first: int, last: int, jacobian: Float64Array
) -> None:
    """Add `weight` times the derivative of the pose of the object frame, columns `first` to `last`, to that of one frame."""
    rx, ry = cos * centre[0] - sin * centre[1], sin * centre[0] + cos * centre[1]
    for p in range(first, last):
        jacobian[0, p] += weight * (s[0, p - first] + ry * s[2, p - first])
        jacobian[1, p] += weight * (s[1, p - first] - rx * s[2, p - first])
        jacobian[2, p] += weight * s[2, p - first]
    if first == 0:
        jacobian[0, PARAM_CENTRE] -= weight * cos
        jacobian[0, PARAM_CENTRE + 1] += weight * sin
        jacobian[1, PARAM_CENTRE] -= weight * sin
        jacobian[1, PARAM_CENTRE + 1] -= weight * cos


@kernel
def chain_forward(
    tape: Tape,
    centre: Float64Array,
    arms: Float64Array,
    diamond: bool,
    eps: float,
    dt: float,
    frame_step: NDArray[np.int64],
    frame_fraction: Float64Array,
    jacobian: Float64Array,
) -> None:
    """Derivative of the poses at the frames with respect to all parameters.

    Args:
        tape: of the rollout.
        centre: of mass [m], shape (2,), object frame.
        arms: cell centres from the centre of mass [m], shape (2, n_cells).
        diamond, eps: law of the support friction (`support.py`).
        dt: [s]
        frame_step, frame_fraction: frame j lies `fraction` of the way through step `frame_step[j]`; ascending.
        jacobian: filled, shape (n_frames, 3, 8 + n_cells + n_values), columns: `PARAM_...`.
    """
    n_parameters = jacobian.shape[2]
    n_frames = frame_step.shape[0]
    n_memory = tape.memory.shape[1]
    n_values = n_parameters - N_BODY_PARAMETERS - arms.shape[1]
    jacobian[:] = 0.0
    for first in range(0, n_parameters, _CHUNK):
        last = min(first + _CHUNK, n_parameters)
        n_body = max(0, N_BODY_PARAMETERS - first)
        own_arms = arms[:, first + n_body - N_BODY_PARAMETERS : last - N_BODY_PARAMETERS]
        s = np.zeros((6, last - first))
        du = np.zeros((3, last - first))
        memory = np.zeros((n_memory, last - first))
        if first == 0:
            cos, sin = tape.heading[0, 0], tape.heading[0, 1]
            s[0, 0], s[1, 1], s[2, 2] = 1.0, 1.0, 1.0
            s[0, 2], s[1, 2] = -(sin * centre[0] + cos * centre[1]), cos * centre[0] - sin * centre[1]
            s[0, PARAM_CENTRE], s[0, PARAM_CENTRE + 1] = cos, -sin
            s[1, PARAM_CENTRE], s[1, PARAM_CENTRE + 1] = sin, cos
        frame = 0
        for n in range(tape.event.shape[0]):
            cos, sin = tape.heading[n, 0], tape.heading[n, 1]
            begin = frame
            while frame < n_frames and frame_step[frame] == n:
                _emit(s, cos, sin, centre, 1.0 - frame_fraction[frame], first, last, jacobian[frame])
                frame += 1
            if tape.event[n] != IDLE:
                block, twist = tape.block[n], tape.twist[n]
                if first == 0:
                    for i in range(3):
                        for p in range(PARAM_MASS, N_BODY_PARAMETERS):
                            du[i, p] = block[i, _MASS + p - PARAM_MASS]
                _limit_columns(block, twist, own_arms, Cone(diamond, eps, cos, sin), dt, du[:, n_body:])
                if n_values > 0:
                    _effect_columns(tape, n, arms, own_arms, first, last, eps, dt, n_values, memory, du)
            if n_memory > 0:
                _advance_memory(tape.memory[n], s, first, last, arms.shape[1], memory)
            if tape.event[n] != IDLE:
                _advance(s, du, tape.block[n], tape.twist[n], cos, sin, dt)
            if tape.event[n] != MOVED:
                s[3:] = 0.0
            for j in range(begin, frame):
                _emit(s, tape.heading[n + 1, 0], tape.heading[n + 1, 1], centre, frame_fraction[j], first, last, jacobian[j])


@fast_kernel
def _add_limit_gradient(
    twist: Float64Array, arms: Float64Array, cone: Cone, dt: float, by_impulse: Float64Array, gradient: Float64Array
) -> None:
    """Add d loss / d limit of each cell in one step, where `by_impulse` is d loss / d impulse on the object, shape (3,)."""
    a, b, c = -dt * by_impulse[0], -dt * by_impulse[1], -dt * by_impulse[2]
    x, y = arms[0], arms[1]
    for i in range(x.shape[0]):
        rx, ry = x[i], y[i]
        px, py = unit_friction(twist[0] - twist[2] * ry, twist[1] + twist[2] * rx, cone)
        gradient[i] += px * (a - c * ry) + py * (b + c * rx)


@fast_kernel
def _add_skew_gradient(
    twist: Float64Array, arms: Float64Array, skew: Float64Array, eps: float, dt: float, by_impulse: Float64Array, gradient: Float64Array
) -> None:
    """Transpose of `_add_skew_columns`, as `_add_limit_gradient`."""
    x, y = arms[0], arms[1]
    a, b = skew[0], skew[1]
    for i in range(x.shape[0]):
        rx, ry = x[i], y[i]
        ux, uy = twist[0] - twist[2] * ry, twist[1] + twist[2] * rx
        scale = -dt / math.sqrt(ux * ux + uy * uy + eps * eps)
        fx, fy = scale * (a * ux + b * uy), scale * (b * ux - a * uy)
        gradient[i] += by_impulse[0] * fx + by_impulse[1] * fy + by_impulse[2] * (rx * fy - ry * fx)


@fast_kernel
def _add_sum_gradient(by_sums: Float64Array, arms: Float64Array, by_twist: Float64Array, gradient: Float64Array) -> None:
    """Add what the limit of each cell does to the loss through their sums; `by_sums` is d twist / d sums of one step, shape (3, 6)."""
    b = np.zeros(by_sums.shape[1])
    for i in range(3):
        for m in range(by_sums.shape[1]):
            b[m] += by_sums[i, m] * by_twist[i]
    x, y = arms[0], arms[1]
    for p in range(x.shape[0]):
        gradient[p] += b[0] + (b[1] + b[3] * x[p] + b[4] * y[p]) * x[p] + (b[2] + b[5] * y[p]) * y[p]


@kernel
def _take_frame(
    by_pose: Float64Array, cos: float, sin: float, centre: Float64Array, weight: float, by_state: Float64Array, gradient: Float64Array
) -> None:
    """Transpose of `_emit`: add what the pose of one frame does to the loss."""
    gx, gy, gt = weight * by_pose[0], weight * by_pose[1], weight * by_pose[2]
    rx, ry = cos * centre[0] - sin * centre[1], sin * centre[0] + cos * centre[1]
    by_state[0] += gx
    by_state[1] += gy
    by_state[2] += gt + ry * gx - rx * gy
    gradient[PARAM_CENTRE] -= cos * gx + sin * gy
    gradient[PARAM_CENTRE + 1] += sin * gx - cos * gy


@kernel
def chain_backward(
    tape: Tape,
    centre: Float64Array,
    arms: Float64Array,
    diamond: bool,
    eps: float,
    dt: float,
    frame_step: NDArray[np.int64],
    frame_fraction: Float64Array,
    by_pose: Float64Array,
    gradient: Float64Array,
) -> None:
    """Gradient of a loss of the poses with respect to all parameters: the transpose of `chain_forward`, at the cost of one pass.

    Args:
        by_pose: d loss / d pose at the frames, shape (n_frames, 3).
        gradient: filled, shape (8 + n_cells + n_values,), entries: `PARAM_...`.

    The other arguments are those of `chain_forward`.
    """
    gradient[:] = 0.0
    by_state = np.zeros(6)
    by_twist = np.zeros(3)
    by_impulse = np.zeros(3)
    n_cells, n_memory = arms.shape[1], tape.memory.shape[1]
    first_value = N_BODY_PARAMETERS + n_cells
    n_values = gradient.shape[0] - first_value
    first_sum = _EFFECTS + n_memory + n_values
    by_memory = np.zeros(n_memory)
    by_limit = np.zeros(n_cells if n_values > 0 else 0)
    frame = frame_step.shape[0] - 1
    for n in range(tape.event.shape[0] - 1, -1, -1):
        cos, sin = tape.heading[n, 0], tape.heading[n, 1]
        end = frame
        while frame >= 0 and frame_step[frame] == n:
            _take_frame(by_pose[frame], tape.heading[n + 1, 0], tape.heading[n + 1, 1], centre, frame_fraction[frame], by_state, gradient)
            frame -= 1
        if tape.event[n] != MOVED:
            by_state[3:] = 0.0
        by_memory_after = by_memory.copy()
        if n_memory > 0:
            by_memory[:] = 0.0
        if tape.event[n] != IDLE:
            block, twist = tape.block[n], tape.twist[n]
            vx, vy = by_state[3] + dt * by_state[0], by_state[4] + dt * by_state[1]
            by_twist[0], by_twist[1] = cos * vx + sin * vy, -sin * vx + cos * vy
            by_twist[2] = by_state[5] + dt * by_state[2]
            by_state[2] += vy * (cos * twist[0] - sin * twist[1]) - vx * (sin * twist[0] + cos * twist[1])
            by_state[3:] = 0.0
            by_impulse[:] = 0.0
            for i in range(3):
                for j in range(3):
                    by_impulse[j] += block[i, _IMPULSE + j] * by_twist[i]
                for j in range(6):
                    by_state[j] += block[i, _STATE + j] * by_twist[i]
                for p in range(PARAM_MASS, N_BODY_PARAMETERS):
                    gradient[p] += block[i, _MASS + p - PARAM_MASS] * by_twist[i]
            if n_values == 0:
                _add_limit_gradient(twist, arms, Cone(diamond, eps, cos, sin), dt, by_impulse, gradient[N_BODY_PARAMETERS:])
            else:
                by_limit[:] = 0.0
                _add_limit_gradient(twist, arms, Cone(diamond, eps, cos, sin), dt, by_impulse, by_limit)
                if tape.skew.shape[0] > 0:
                    _add_skew_gradient(twist, arms, tape.skew[n], eps, dt, by_impulse, by_limit)
                for i in range(n_cells):
                    gradient[N_BODY_PARAMETERS + i] += by_limit[i] * (tape.factor[n, i] if tape.factor.shape[1] > 0 else 1.0)
                if block.shape[1] > first_sum:
                    _add_sum_gradient(block[:, first_sum:], arms, by_twist, gradient[N_BODY_PARAMETERS:first_value])
                for i in range(3):
                    for j in range(n_memory):
                        by_memory[j] += block[i, _EFFECTS + j] * by_twist[i]
                    for j in range(n_values):
                        gradient[first_value + j] += block[i, _EFFECTS + n_memory + j] * by_twist[i]
        for j in range(n_memory):
            g = tape.memory[n, j]
            for i in range(6):
                by_state[i] += g[i] * by_memory_after[j]
            for i in range(3):
                gradient[PARAM_MASS + i] += g[6 + i] * by_memory_after[j]
            for i in range(n_memory):
                by_memory[i] += g[N_FIXED_INPUTS + i] * by_memory_after[j]
            for i in range(n_values):
                gradient[first_value + i] += g[N_FIXED_INPUTS + n_memory + i] * by_memory_after[j]
        for j in range(frame + 1, end + 1):
            _take_frame(by_pose[j], cos, sin, centre, 1.0 - frame_fraction[j], by_state, gradient)
    cos, sin = tape.heading[0, 0], tape.heading[0, 1]
    gradient[PARAM_POSE], gradient[PARAM_POSE + 1] = by_state[0], by_state[1]
    gradient[PARAM_POSE + 2] = (
        by_state[2] - (sin * centre[0] + cos * centre[1]) * by_state[0] + (cos * centre[0] - sin * centre[1]) * by_state[1]
    )
    gradient[PARAM_CENTRE] += cos * by_state[0] + sin * by_state[1]
    gradient[PARAM_CENTRE + 1] += -sin * by_state[0] + cos * by_state[1]
