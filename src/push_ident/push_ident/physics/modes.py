"""The contact problem of one step, solved exactly by trying its modes (compiled).

For a support friction that is linear about the present twist, a step is

    H du = r + sum_k N_k' n_k + T' t,     0 <= n_k  perpendicular to  N_k du - miss_k >= 0,     |t| <= mu sum_k n_k against the slip

with the normal impulses n_k of up to five contacts and one tangential impulse t. The sum runs over the contacts that share the
tangent T: the first, and those on the same flat face (a line contact, whose points all slip alike). Contacts on another face are
frictionless: three velocities cannot carry two independent stick conditions beside two normal ones.

A mode says which contacts press and whether the tangent is free, sticks or slips; within a mode the problem is linear. Its matrix
is unsymmetric where a contact slips: the impulse acts along N + drag T, the condition is on N alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from push_ident.physics.kernel import kernel
from push_ident.types import Float64Array

__all__ = [
    "BOUND", "CONTACT_COLUMNS", "MAX_CONTACTS", "MODE_FREE", "MODE_SLIDE_MINUS", "MODE_SLIDE_PLUS", "MODE_STICK", "NO_MODE",
    "SHARES_TANGENT", "ModeScratch", "StepContacts", "drag_sign", "mode_system", "new_mode_scratch", "solve_modes", "solve_small",
    "tangent_row",
]  # fmt: skip

MAX_CONTACTS = 5

MODE_FREE = 0
MODE_STICK = 1
MODE_SLIDE_PLUS = 2
"""The object slides along +T on the pusher, so that t = -mu sum n_k."""
MODE_SLIDE_MINUS = 3
NO_MODE = -1
"""A mode code is the mode of the tangent + 4 * (sum of 2^k over the contacts k that press); this one says that none was found."""

_TANGENT = MAX_CONTACTS  # row of the tangent of contact 0


BOUND = 3
SHARES_TANGENT = 4
CONTACT_COLUMNS = 5
"""Contacts of one step are one array, object axes, shape (2 MAX_CONTACTS, CONTACT_COLUMNS): the rows N_k, then the rows T_k, with

    0-2   the row: velocity of the contact point along -n, or along t, for a unit of each velocity
    3     bound [m/s]: what N_k u must reach, and what T_k u is compared with
    4     of N_k: 1 for a contact on the face of the first one, else 0
"""


class StepContacts(NamedTuple):
    """The contacts of one step."""

    rows: Float64Array
    """Shape (2 MAX_CONTACTS, CONTACT_COLUMNS), see there."""
    number: int
    """Of contacts."""
    mu: float
    """Friction coefficient of the pusher."""


class ModeScratch(NamedTuple):
    """Space for the linear system of a mode: du and the impulses x from H du - P' x = r and C du = miss."""

    row: NDArray[np.int64]
    """Rows of the contacts that make C, shape (MAX_CONTACTS + 1,)."""
    matrix: Float64Array
    """[H -P'; C 0], and room for three conditions more, shape (12, 12)."""
    right: Float64Array
    """Shape (9, 1)."""


@kernel
def new_mode_scratch() -> ModeScratch:
    """Scratch space of `solve_modes`."""
    n = MAX_CONTACTS + 1
    return ModeScratch(np.zeros(n, dtype=np.int64), np.zeros((6 + n, 6 + n)), np.zeros((3 + n, 1)))


@kernel
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
            for j in range(k, n):
                a[k, j], a[p, j] = a[p, j], a[k, j]
            for j in range(m):
                b[k, j], b[p, j] = b[p, j], b[k, j]
        for i in range(k + 1, n):
            c = a[i, k] / a[k, k]
            if c != 0.0:
                for j in range(k + 1, n):
                    a[i, j] -= c * a[k, j]
                for j in range(m):
                    b[i, j] -= c * b[k, j]
    for k in range(n - 1, -1, -1):
        inverse = 1.0 / a[k, k]
        for j in range(m):
            x = b[k, j]
            for i in range(k + 1, n):
                x -= a[k, i] * b[i, j]
            b[k, j] = x * inverse
    return True


@kernel
def tangent_row(code: int, contacts: Float64Array) -> int:
    """Row of the tangent that the friction of a mode acts along: that of the first pressing contact of the common face."""
    for k in range(MAX_CONTACTS):
        if (code >> (2 + k)) & 1 and contacts[k, SHARES_TANGENT] != 0.0:
            return _TANGENT + k
    return _TANGENT


@kernel
def drag_sign(code: int) -> float:
    """Sign of t / (mu sum n_k): -1 when the object slides along +T, 0 when it does not slide."""
    mode = code % 4
    return -1.0 if mode == MODE_SLIDE_PLUS else (1.0 if mode == MODE_SLIDE_MINUS else 0.0)


@kernel
def mode_system(code: int, h: Float64Array, step_contacts: StepContacts, row: NDArray[np.int64], a: Float64Array) -> int:
    """Fill `row` and the matrix `a` of a mode; returns the number of its impulses: normal ones in order, then the tangent if it sticks."""
    contacts = step_contacts.rows
    tangent, drag = tangent_row(code, contacts), drag_sign(code) * step_contacts.mu
    n = 0
    for k in range(MAX_CONTACTS):
        if (code >> (2 + k)) & 1:
            along = drag * contacts[k, SHARES_TANGENT]
            row[n] = k
            for i in range(3):
                a[i, 3 + n] = -(contacts[k, i] + along * contacts[tangent, i])
                a[3 + n, i] = contacts[k, i]
            n += 1
    if code % 4 == MODE_STICK:
        row[n] = tangent
        for i in range(3):
            a[i, 3 + n] = -contacts[tangent, i]
            a[3 + n, i] = contacts[tangent, i]
        n += 1
    for i in range(3):
        for j in range(3):
            a[i, j] = h[i, j]
    for i in range(n):
        for j in range(n):
            a[3 + i, 3 + j] = 0.0
    return n


@kernel
def _exists(code: int, contacts: Float64Array, n_contacts: int) -> bool:
    """Whether a code is a mode of so many contacts: friction acts if, and only if, a contact of the common face presses."""
    pressing = code // 4
    if pressing >= 1 << n_contacts:
        return False
    touches = False
    number = 0
    for k in range(n_contacts):
        if (pressing >> k) & 1:
            number += 1
            touches = touches or contacts[k, SHARES_TANGENT] != 0.0
    if touches == (code % 4 == MODE_FREE):
        return False
    # Three velocities meet three conditions at most.
    return number + (1 if code % 4 == MODE_STICK else 0) <= 3


@kernel
def _reaches(contacts: Float64Array, k: int, b: Float64Array, miss: Float64Array) -> float:
    """How far row k exceeds its bound after the change of the twist in `b` [m/s]."""
    return contacts[k, 0] * b[0, 0] + contacts[k, 1] * b[1, 0] + contacts[k, 2] * b[2, 0] - miss[k]


@kernel
def solve_modes(
    h: Float64Array,
    r: Float64Array,
    step_contacts: StepContacts,
    miss: Float64Array,
    first_guess: int,
    du: Float64Array,
    impulse: Float64Array,
    scratch: ModeScratch,
) -> int:
    """Change of the twist and the impulses of a step whose support friction is linear.

    Args:
        h: H, shape (3, 3).
        r: shape (3,).
        step_contacts: the contacts.
        miss: bounds - rows times the present twist [m/s], shape (2 MAX_CONTACTS,).
        first_guess: code that is tried first, that of the step before.
        du: filled, shape (3,).
        impulse: filled with the normal impulses and the tangential one [N s], shape (MAX_CONTACTS + 1,).
        scratch: its space.

    Returns:
        The code of the mode, or `NO_MODE`.
    """
    contacts, n_contacts, mu = step_contacts.rows, step_contacts.number, step_contacts.mu
    row, a, b = scratch.row, scratch.matrix, scratch.right
    scale = 1e-12
    for k in range(n_contacts):
        scale += 1e-12 * (abs(contacts[k, BOUND]) + abs(contacts[_TANGENT + k, BOUND]))
    for trial in range(-1, 4 << n_contacts):
        code = first_guess if trial < 0 else trial
        if not _exists(code, contacts, n_contacts):
            continue
        n = mode_system(code, h, step_contacts, row, a)
        for i in range(3):
            b[i, 0] = r[i]
        for i in range(n):
            b[3 + i, 0] = miss[row[i]]
        if not solve_small(a, b, 3 + n, 1):
            continue

        # The inequalities that the mode assumes.
        mode = code % 4
        n_pressing = n - 1 if mode == MODE_STICK else n
        carried = 0.0
        fits = True
        for i in range(n_pressing):
            carried += b[3 + i, 0] * contacts[row[i], SHARES_TANGENT]
            fits = fits and b[3 + i, 0] >= 0.0
        for k in range(n_contacts):
            fits = fits and ((code >> (2 + k)) & 1 == 1 or _reaches(contacts, k, b, miss) >= -scale)
        tangential = drag_sign(code) * mu * carried
        if mode == MODE_STICK:
            tangential = b[3 + n_pressing, 0]
            fits = fits and abs(tangential) <= mu * carried
        elif mode != MODE_FREE:
            fits = fits and -drag_sign(code) * _reaches(contacts, tangent_row(code, contacts), b, miss) >= -scale
        if not fits:
            continue

        for i in range(3):
            du[i] = b[i, 0]
        for k in range(MAX_CONTACTS):
            impulse[k] = 0.0
        for i in range(n_pressing):
            impulse[row[i]] = b[3 + i, 0]
        impulse[MAX_CONTACTS] = tangential
        return code
    return NO_MODE
