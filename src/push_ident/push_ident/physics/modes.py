"""The contact problem of one step, solved exactly by enumeration of its modes (compiled).

With support friction linearised about the present twist, a step is

    H du = r + sum_k N_k' n_k + T' t,     0 <= n_k  perpendicular to  N_k du - miss_k >= 0,     |t| <= mu sum_k n_k, opposite to the slip

with the normal impulses n_k of up to five contacts and one tangential impulse t. The sum runs over the contacts that share the
tangent T: the first, and those on the same flat face (a line contact, whose points have one slip velocity). Other contacts are
frictionless, but for one: where the pusher has two fingers, each has a tangent of its own at its nearest contact.

A mode states which contacts press, and whether each tangent is free, sticks or slips. Within a mode the problem is linear. Its matrix
is unsymmetric where a contact slips: the impulse acts along N + drag T, while the constraint is on N only.

Three velocities satisfy three conditions. Two fingers that both stick state four, which hold the object in the frame of the tool: the two
of the tangents count as their sum, so that neither finger is preferred. The impulses, of which only the resultant matters, are those
within both friction cones whose tangential ones differ least.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from push_ident.physics.kernel import kernel
from push_ident.types import Float64Array

MAX_CONTACTS = 5
N_IMPULSES = MAX_CONTACTS + 2
"""Normal impulses of the contacts, the tangential one, and that of the second finger."""
SECOND = MAX_CONTACTS + 1
"""Index of the tangential impulse of the second finger."""
_TANGENT = MAX_CONTACTS  # row of the tangent of contact 0
_CODES = 4 << MAX_CONTACTS  # of the modes of one tangent


class Mode(IntEnum):
    """Mode of a tangent. A mode code is that of the first + 4 * (sum of 2^k over the contacts k that press) + 128 * that of the second."""

    FREE = 0
    STICK = 1
    SLIDE_PLUS = 2
    """The object slides along +T on the pusher, so that t = -mu sum n_k."""
    SLIDE_MINUS = 3
    NONE = -1
    """As a code: no mode satisfies the inequalities."""


class Row(IntEnum):
    """Columns of the contacts of one step, object axes, shape (2 MAX_CONTACTS, Row.WIDTH): the rows N_k, then the rows T_k.

    The first three are the velocity of the contact point along -n (N_k) or along t (T_k) for a unit of each velocity of the twist.
    """

    BOUND = 3
    """[m/s]: lower bound of N_k u; velocity of the pusher along t, which T_k u equals without slip."""
    SHARES_TANGENT = 4
    """Of N_k: 1 for a contact on the face of the first one, else 0."""
    OF_SECOND = 5
    """Of N_k: 1 for the contact of the second finger that has friction, else 0."""
    WIDTH = 6
    """Number of columns."""


class StepGeometry(NamedTuple):
    """The object in a step. It is made once for a rollout; what changes from step to step is written into its arrays."""

    arms: Float64Array
    """Cell centres from the centre of mass [m], shape (2, n_cells), object axes."""
    limit: Float64Array
    """Sliding friction of each cell in this step [N], shape (n_cells,)."""
    inertia: Float64Array
    """(m, m, I) about the centre of mass [kg, kg, kg m^2], shape (3,); zeros for a quasi-static step."""
    reach: float
    """Length that turns a rate of rotation into a speed [m]."""
    centre: Float64Array
    """Of mass [m], shape (2,), object frame."""
    heading: Float64Array
    """cos and sin of the yaw at the start of this step, shape (2,)."""
    dt: float
    """Length of this step [s]."""
    is_struck: bool = False
    """The object was at rest before this step, which resolves the time of the first contact within it (`contact_rows.py`)."""


class StepContacts(NamedTuple):
    """The contacts of one step."""

    rows: Float64Array
    """Shape (2 MAX_CONTACTS, Row.WIDTH), see `Row.WIDTH`."""
    number: int
    """Number of contacts."""
    mu: float
    """Friction coefficient of the pusher."""


class ModeScratch(NamedTuple):
    """Scratch space for the linear system of a mode: du and the impulses x from H du - P' x = r and C du = miss."""

    row: NDArray[np.int64]
    """Indices of the contact rows in C, shape (MAX_CONTACTS + 1,)."""
    matrix: Float64Array
    """[H -P'; C 0] with room for three more conditions, shape (12, 12)."""
    right: Float64Array
    """Shape (9, 2)."""


@kernel
def new_mode_scratch() -> ModeScratch:
    """Scratch space of `solve_modes`."""
    n = MAX_CONTACTS + 1
    return ModeScratch(np.zeros(n, dtype=np.int64), np.zeros((6 + n, 6 + n)), np.zeros((3 + n, 2)))


@kernel
def solve_small(a: Float64Array, b: Float64Array, n: int, m: int) -> bool:
    """Solve a[:n, :n] x = b[:n, :m] in place by Gaussian elimination with partial pivoting. b becomes x. False where a is singular."""
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
    """Row of the tangent along which friction acts in a mode: that of the first pressing contact of the common face."""
    for k in range(MAX_CONTACTS):
        if (code >> (2 + k)) & 1 and contacts[k, Row.SHARES_TANGENT] != 0.0:
            return _TANGENT + k
    return _TANGENT


@kernel
def second_mode(code: int) -> int:
    """Mode of the tangent of the second finger."""
    return code // _CODES


@kernel
def holds(code: int) -> bool:
    """Whether both fingers stick, so that the object moves with the tool."""
    return code % 4 == Mode.STICK and second_mode(code) == Mode.STICK


@kernel
def second_row(contacts: Float64Array) -> int:
    """Row of the tangent of the second finger."""
    for k in range(MAX_CONTACTS):
        if contacts[k, Row.OF_SECOND] != 0.0:
            return _TANGENT + k
    return _TANGENT


@kernel
def drag_sign(code: int) -> float:
    """Sign of t / (mu sum n_k): -1 when the object slips along +T, +1 along -T, 0 when it does not slip. Of a code, that of the first
    tangent; of `second_mode`, that of the second."""
    mode = code % 4
    return -1.0 if mode == Mode.SLIDE_PLUS else (1.0 if mode == Mode.SLIDE_MINUS else 0.0)


@kernel
def mode_system(code: int, h: Float64Array, step_contacts: StepContacts, row: NDArray[np.int64], a: Float64Array) -> int:
    """Fill `row` and the matrix `a` of a mode. Returns the number of impulses: normal ones, then the tangential ones that stick, as one
    where both do."""
    contacts = step_contacts.rows
    tangent, drag = tangent_row(code, contacts), drag_sign(code) * step_contacts.mu
    second = second_mode(code)
    drag_of_second = drag_sign(second) * step_contacts.mu
    n = 0
    for k in range(MAX_CONTACTS):
        if (code >> (2 + k)) & 1:
            along = drag * contacts[k, Row.SHARES_TANGENT]
            row[n] = k
            for i in range(3):
                a[i, 3 + n] = -(contacts[k, i] + along * contacts[tangent, i])
                a[3 + n, i] = contacts[k, i]
            if drag_of_second != 0.0 and contacts[k, Row.OF_SECOND] != 0.0:
                for i in range(3):
                    a[i, 3 + n] -= drag_of_second * contacts[_TANGENT + k, i]
            n += 1
    if code % 4 == Mode.STICK:
        row[n] = tangent
        for i in range(3):
            a[i, 3 + n] = -contacts[tangent, i]
            a[3 + n, i] = contacts[tangent, i]
        n += 1
    if holds(code):
        for i in range(3):
            a[i, 2 + n] -= contacts[second_row(contacts), i]
            a[2 + n, i] += contacts[second_row(contacts), i]
    elif second == Mode.STICK:
        row[n] = second_row(contacts)
        for i in range(3):
            a[i, 3 + n] = -contacts[row[n], i]
            a[3 + n, i] = contacts[row[n], i]
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
    """Whether a code is a mode of `n_contacts` contacts: friction acts if and only if a contact with this tangent presses."""
    pressing, second = (code // 4) % (1 << MAX_CONTACTS), second_mode(code)
    if pressing >= 1 << n_contacts:
        return False
    touches = touches_second = False
    number = 0
    for k in range(n_contacts):
        if (pressing >> k) & 1:
            number += 1
            touches = touches or contacts[k, Row.SHARES_TANGENT] != 0.0
            touches_second = touches_second or contacts[k, Row.OF_SECOND] != 0.0
    if touches == (code % 4 == Mode.FREE) or touches_second == (second == Mode.FREE):
        return False
    # Three velocities can satisfy at most three conditions, and the fourth of two fingers that stick follows from the others.
    sticking = (1 if code % 4 == Mode.STICK else 0) + (1 if second == Mode.STICK else 0)
    return number + sticking <= 3 or (number == 2 and sticking == 2)


@kernel
def _reaches(contacts: Float64Array, k: int, b: Float64Array, miss: Float64Array) -> float:
    """Excess of row k over its bound after the change of the twist in `b` [m/s]."""
    return contacts[k, 0] * b[0, 0] + contacts[k, 1] * b[1, 0] + contacts[k, 2] * b[2, 0] - miss[k]


@kernel
def _share_friction(b: Float64Array, contacts: Float64Array, row: NDArray[np.int64], mu: float) -> float:
    """Half the difference of the tangential impulses of two fingers that both stick; adds what it changes to the first column of `b`.

    Args:
        b: solution with equal tangential impulses, and its change for a unit of the difference, shape (9, 2): the twist, two normal
            impulses, the tangential one of each finger.
        contacts, mu: those of the step.
        row: of the conditions.

    Returns:
        The smallest with which all impulses lie within their cones [N s]; NaN where there is none.
    """
    low, high = -math.inf, math.inf
    for i in range(2):
        own = -1.0 if contacts[row[i], Row.OF_SECOND] != 0.0 else 1.0
        for sign in (-1.0, 1.0):
            # mu n + sign t >= 0, which makes n >= 0 too.
            at_zero = mu * b[3 + i, 0] + sign * b[5, 0]
            slope = mu * b[3 + i, 1] + sign * (b[5, 1] + own)
            if slope > 0.0:
                low = max(low, -at_zero / slope)
            elif slope < 0.0:
                high = min(high, -at_zero / slope)
            elif at_zero < 0.0:
                return math.nan
    if low > high:
        return math.nan
    difference = min(max(0.0, low), high)
    for i in range(b.shape[0]):
        b[i, 0] += difference * b[i, 1]
    return difference


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
    """Change of the twist, and impulses, of a step with linear support friction.

    Args:
        h: H, shape (3, 3).
        r: shape (3,).
        step_contacts: the contacts.
        miss: bounds - rows times the present twist [m/s], shape (2 MAX_CONTACTS,).
        first_guess: mode code to try first, usually that of the step before.
        du: filled, shape (3,).
        impulse: filled with the normal impulses and the tangential ones [N s], shape (N_IMPULSES,).
        scratch: scratch space.

    Returns:
        The code of the mode, or `Mode.NONE`.
    """
    contacts, n_contacts, mu = step_contacts.rows, step_contacts.number, step_contacts.mu
    row, a, b = scratch.row, scratch.matrix, scratch.right
    scale = 1e-12
    for k in range(n_contacts):
        scale += 1e-12 * (abs(contacts[k, Row.BOUND]) + abs(contacts[_TANGENT + k, Row.BOUND]))
    n_codes = 4 << n_contacts
    has_second = False
    for k in range(n_contacts):
        has_second = has_second or contacts[k, Row.OF_SECOND] != 0.0
    for trial in range(-1, 4 * n_codes if has_second else n_codes):
        code = first_guess if trial < 0 else trial % n_codes + _CODES * (trial // n_codes)
        if not _exists(code, contacts, n_contacts):
            continue
        n = mode_system(code, h, step_contacts, row, a)
        for i in range(3):
            b[i, 0] = r[i]
        for i in range(n):
            b[3 + i, 0] = miss[row[i]]
        second = second_mode(code)
        is_held = holds(code)
        if is_held:
            b[2 + n, 0] += miss[second_row(contacts)]
            b[:, 1] = 0.0
            for i in range(3):
                b[i, 1] = contacts[row[n - 1], i] - contacts[second_row(contacts), i]
        if not solve_small(a, b, 3 + n, 2 if is_held else 1):
            continue

        # Check the inequalities that the mode assumes.
        mode = code % 4
        n_pressing = n - (1 if mode == Mode.STICK or second == Mode.STICK else 0)
        difference = _share_friction(b, contacts, row, mu) if is_held else 0.0
        of_second = 0.0
        carried = carried_by_second = 0.0
        fits = math.isfinite(difference)
        for i in range(n_pressing):
            carried += b[3 + i, 0] * contacts[row[i], Row.SHARES_TANGENT]
            carried_by_second += b[3 + i, 0] * contacts[row[i], Row.OF_SECOND]
            fits = fits and b[3 + i, 0] >= 0.0
        for k in range(n_contacts):
            fits = fits and ((code >> (2 + k)) & 1 == 1 or _reaches(contacts, k, b, miss) >= -scale)
        tangential = drag_sign(code) * mu * carried
        if mode == Mode.STICK:
            tangential = b[3 + n_pressing, 0] + difference
            fits = fits and (is_held or abs(tangential) <= mu * carried)
        elif mode != Mode.FREE:
            fits = fits and -drag_sign(code) * _reaches(contacts, tangent_row(code, contacts), b, miss) >= -scale
        if second == Mode.STICK:
            of_second = b[3 + n_pressing, 0] - difference
            fits = fits and (is_held or abs(of_second) <= mu * carried_by_second)
        elif second != Mode.FREE:
            of_second = drag_sign(second) * mu * carried_by_second
            fits = fits and -drag_sign(second) * _reaches(contacts, second_row(contacts), b, miss) >= -scale
        if not fits:
            continue

        for i in range(3):
            du[i] = b[i, 0]
        for k in range(MAX_CONTACTS):
            impulse[k] = 0.0
        for i in range(n_pressing):
            impulse[row[i]] = b[3 + i, 0]
        impulse[MAX_CONTACTS] = tangential
        impulse[SECOND] = of_second
        return code
    return Mode.NONE
