"""Exact derivative of one step (compiled).

The step's optimality conditions are differentiated at their solution (implicit function theorem). Sliding contact makes that linear
system unsymmetric: the impulse acts along N + drag T while the constraint is on N only. This system must be solved, not its
transpose. Sticking cells of the pyramid are too stiff to be added to the inertia in double precision; they enter as up to three more
conditions. With H the derivative of the balance of impulses with respect to the twist and C the conditions of the mode,

    | H  -P' | | du |   | seed of the balance    |
    | C   0  | | dx | = | seed of the conditions |       one right-hand side for each column of the block (`tape.py`)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from push_ident.physics.contact_rows import ContactEffects, Rebound, RelativeChange, RelativePusher, contact_rows_seed
from push_ident.physics.kernel import kernel
from push_ident.physics.modes import (
    MAX_CONTACTS,
    SECOND,
    ModeScratch,
    Row,
    StepContacts,
    StepGeometry,
    drag_sign,
    holds,
    mode_system,
    second_mode,
    second_row,
    solve_small,
    tangent_row,
)  # fmt: skip
from push_ident.physics.support import SupportImpulse
from push_ident.physics.tape import Block
from push_ident.types import BoolArray, Float64Array


class StepBalance(NamedTuple):
    """A solved step; object axes."""

    twist: Float64Array
    """After the step, shape (3,)."""
    old: Float64Array
    """Before the step, shape (3,)."""
    code: int
    """Mode of the contacts (`modes.py`)."""
    impulse: Float64Array
    """Normal impulses and the tangential ones [N s], shape (N_IMPULSES,)."""
    support: SupportImpulse
    """Of the table."""


class EffectDrive(NamedTuple):
    """Derivatives of a step by the numbers of the effects; object axes. Rows belong to the memory of the effects, then their values, then
    the sums of the limits of the cells."""

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
    vertices: Float64Array
    """Of the vertices of the outline, object frame, shape (n, n_vertices, 2); of no rows where the outline stays."""
    no_vertices: Float64Array
    """Shape (0, 2)."""


class SensitivityScratch(NamedTuple):
    """Scratch space of `step_sensitivity`, so that it allocates no memory."""

    model: Float64Array
    """Derivative of the balance of impulses by the twist, shape (3, 3)."""
    right: Float64Array
    """Right-hand sides and solutions, shape (12, n_columns)."""
    others: Float64Array
    """Those that are not due to the pusher, shape (3, n_columns)."""
    d_rows: Float64Array
    """Change of the contact rows, shape (2 MAX_CONTACTS, Row.WIDTH)."""
    change: RelativeChange
    mode: ModeScratch


@kernel
def new_sensitivity_scratch(n_columns: int, mode: ModeScratch) -> SensitivityScratch:
    """Scratch space of `step_sensitivity` for blocks of `n_columns`; `mode` is that of the step."""
    change = RelativeChange(np.zeros(2), np.zeros(1), np.zeros(2), np.zeros(2))
    d_rows = np.zeros((2 * MAX_CONTACTS, Row.WIDTH))
    return SensitivityScratch(np.zeros((3, 3)), np.zeros((len(mode.matrix), n_columns)), np.zeros((3, n_columns)), d_rows, change, mode)


def new_effect_drive(n_memory: int, n_values: int, n_sums: int, vertices: Float64Array) -> EffectDrive:
    """Drive of no effect that acts on the contacts, but for the outline: `vertices` are their derivative by the last values, shape
    (n_modes, n_vertices, 2)."""
    n, n_modes = n_memory + n_values + n_sums, len(vertices)
    moved = np.zeros((n if n_modes else 0, vertices.shape[1], 2))
    moved[n_memory + n_values - n_modes : n_memory + n_values] = vertices
    return EffectDrive(
        0.0, Rebound(False, 0.0, np.zeros(3)), np.zeros((n, 2)), np.zeros(n), np.zeros((n, 2)), np.zeros(n), np.zeros(n), np.zeros(n),
        np.zeros((n, 3)), np.zeros((3, Block.EFFECTS + n)), np.any(moved, axis=(1, 2)) if n_modes else np.zeros(n, dtype=np.bool_), moved,
        np.zeros((0, 2)),
    )  # fmt: skip


@kernel
def _contact_effects(drive: EffectDrive, column: int, d_pusher: Float64Array, d_velocity: Float64Array) -> ContactEffects:
    """Effects on the contacts per unit of one column; fills the change of the pusher where that is a value that drives it."""
    rebound = drive.rebound
    if column < Block.EFFECTS:
        d_twist = np.zeros(3)
        if column == Block.YAW:
            d_twist[0], d_twist[1] = rebound.twist[1], -rebound.twist[0]
        return ContactEffects(drive.offset, rebound, 0.0, 0.0, 0.0, d_twist, drive.no_vertices)
    e = column - Block.EFFECTS
    d_pusher[:], d_velocity[:] = drive.pusher[e], drive.velocity[e]
    vertices = drive.vertices[e] if drive.vertices.shape[0] > 0 else drive.no_vertices
    return ContactEffects(drive.offset, rebound, drive.spin[e], drive.by_offset[e], drive.restitution[e], drive.twist[e], vertices)


@kernel
def _stuck_size(stuck: Float64Array, j: int) -> float:
    """Scale of row j of [R s]: 1 + its length, so that a row of rounding errors stays small."""
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
    geometry: StepGeometry,
    contacts: StepContacts,
    features: Float64Array,
    pusher: RelativePusher,
    drive: EffectDrive | None,
    space: SensitivityScratch,
    block: Float64Array,
    reaction: Float64Array,
) -> bool:
    """Derivative of the twist after a step: fills its block (`Tape.block`). False where the system is singular.

    The derivative of the pusher's impulse on the object is what the balance of impulses leaves for it: H du less the seeds that are not
    its own.

    Kept whole: its parts share a dozen arrays, and it runs once a step.

    Args:
        step: the solution.
        geometry: the object.
        contacts: the contacts as rows of the step.
        features: the same contacts as `contact.py` found them.
        pusher: the pusher.
        drive: derivatives by the effects; None without effects.
        space: scratch space.
        block: filled, shape (3, n_columns).
        reaction: filled with the derivative of the pusher's impulse (`Tape.reaction`), same shape; of no rows where it is not wanted.
    """
    twist, old, inertia, impulse, stiffness = step.twist, step.old, geometry.inertia, step.impulse, step.support.stiffness
    rows, n_contacts, code, stuck = contacts.rows, contacts.number, step.code, step.support.stuck
    cos, sin, centre = geometry.heading[0], geometry.heading[1], geometry.centre
    scratch, h, d_rows = space.mode, space.model, space.d_rows
    row = scratch.row
    tangent, sign = tangent_row(code, rows), drag_sign(code)
    second, second_sign = second_row(rows), drag_sign(second_mode(code))
    for i in range(3):
        for j in range(3):
            h[i, j] = stiffness[i, j]
        h[i, i] += inertia[i]
    n = mode_system(code, h, contacts, row, scratch.matrix)
    size = _add_stuck(stuck, 3 + n, scratch.matrix)
    n_columns = Block.EFFECTS if drive is None else drive.seeds.shape[1]
    b, others, change = space.right, space.others, space.change
    b[:size] = 0.0
    if drive is not None:
        b[:3] = drive.seeds
    for i in range(3):
        b[i, Block.IMPULSE + i] = 1.0
    others[:] = b[:3]
    d_pusher, d_angle, d_centre, d_velocity = change.pusher, change.angle, change.centre, change.velocity
    for column in range(Block.STATE, n_columns):
        d_pusher[:], d_centre[:], d_velocity[:] = 0.0, 0.0, 0.0
        d_angle[0] = 0.0
        if column == Block.STATE:
            d_pusher[0], d_pusher[1] = -cos, sin
        elif column == Block.STATE + 1:
            d_pusher[0], d_pusher[1] = -sin, -cos
        elif column == Block.YAW:
            # A rotation of the object by d rotates everything else by -d in object axes.
            d_angle[0] = -1.0
            d_pusher[0], d_pusher[1] = pusher.centre[1] - centre[1], -(pusher.centre[0] - centre[0])
            d_velocity[0], d_velocity[1] = pusher.velocity[1], -pusher.velocity[0]
            b[0, column] += inertia[0] * old[1]
            b[1, column] -= inertia[1] * old[0]
            for i in range(3):
                b[i, column] -= step.support.by_yaw[i]
            for j in range(3 + n, size):
                b[j, column] = -stuck[j - 3 - n, 3] / _stuck_size(stuck, j - 3 - n)
        elif column == Block.VELOCITY:
            b[0, column] += inertia[0] * cos
            b[1, column] -= inertia[1] * sin
        elif column == Block.VELOCITY + 1:
            b[0, column] += inertia[0] * sin
            b[1, column] += inertia[1] * cos
        elif column == Block.VELOCITY + 2:
            b[2, column] += inertia[2]
        elif column == Block.MASS:
            if inertia[0] > 0.0:
                b[0, column] += old[0] - twist[0]
                b[1, column] += old[1] - twist[1]
        elif column == Block.CENTRE or column == Block.CENTRE + 1:
            d_centre[column - Block.CENTRE] = 1.0
            d_pusher[column - Block.CENTRE] = 1.0
            # Cell arms shrink by dc: their velocities change by omega (dc_y, -dc_x), their torques by -dc x force.
            sx, sy = twist[2] * d_centre[1], -twist[2] * d_centre[0]
            for i in range(3):
                b[i, column] -= stiffness[i, 0] * sx + stiffness[i, 1] * sy
            for j in range(3 + n, size):
                b[j, column] = -(scratch.matrix[j, 0] * sx + scratch.matrix[j, 1] * sy)
            b[2, column] += d_centre[0] * step.support.impulse[1] - d_centre[1] * step.support.impulse[0]
        elif column == Block.INERTIA:
            if inertia[2] > 0.0:
                b[2, column] += old[2] - twist[2]
        elif column == Block.MU:
            carried = carried_by_second = 0.0
            for k in range(n_contacts):
                carried += impulse[k] * rows[k, Row.SHARES_TANGENT]
                carried_by_second += impulse[k] * rows[k, Row.OF_SECOND]
            for i in range(3):
                b[i, column] += sign * carried * rows[tangent, i]
                if carried_by_second != 0.0:
                    b[i, column] += second_sign * carried_by_second * rows[second, i]
        if column != Block.MU:
            for i in range(3):
                others[i, column] = b[i, column]
        if n == 0 or not (
            Block.STATE <= column <= Block.YAW or column == Block.CENTRE or column == Block.CENTRE + 1 or column >= Block.EFFECTS
        ):
            continue
        if drive is not None and column >= Block.EFFECTS and not drive.touches[column - Block.EFFECTS]:
            continue
        if drive is None:
            for k in range(n_contacts):
                contact_rows_seed(features[k], k, geometry, pusher, change, None, d_rows)
        else:
            effects = _contact_effects(drive, column, d_pusher, d_velocity)
            if column >= Block.EFFECTS:
                d_angle[0] = drive.angle[column - Block.EFFECTS]
            for k in range(n_contacts):
                contact_rows_seed(features[k], k, geometry, pusher, change, effects, d_rows)
        for i in range(3):
            b[i, column] += d_rows[tangent, i] * impulse[MAX_CONTACTS]
            if impulse[SECOND] != 0.0:
                b[i, column] += d_rows[second, i] * impulse[SECOND]
            for k in range(n_contacts):
                b[i, column] += d_rows[k, i] * impulse[k]
        for j in range(n):
            k = row[j]
            b[3 + j, column] = d_rows[k, Row.BOUND] - d_rows[k, 0] * twist[0] - d_rows[k, 1] * twist[1] - d_rows[k, 2] * twist[2]
        if holds(code):
            of_second = d_rows[second, 0] * twist[0] + d_rows[second, 1] * twist[1] + d_rows[second, 2] * twist[2]
            b[2 + n, column] += d_rows[second, Row.BOUND] - of_second
    if not solve_small(scratch.matrix, b, size, n_columns):
        return False
    block[:] = b[:3]
    for i in range(reaction.shape[0]):
        for column in range(n_columns):
            reaction[i, column] = -others[i, column]
            for j in range(3):
                reaction[i, column] += h[i, j] * b[j, column]
            for j in range(3 + n, size):
                reaction[i, column] += stuck[j - 3 - n, i] / _stuck_size(stuck, j - 3 - n) * b[j, column]
    return True
