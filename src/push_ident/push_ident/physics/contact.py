"""Contact between the pusher and the exact outline polygon, in the object frame (compiled).

The pusher is a convex polygon rounded by a radius; a disc is a single point rounded by a radius, a plate two points. Two fingers are two
discs, of which each has the contacts of a disc. There are two kinds of contacts: a
corner of the pusher on the outline, and a corner of the outline on a straight side of the pusher. At most five are kept: the nearest;
its neighbours to the left and right on the same flat face (a line contact); the nearest on a face with another normal (a pusher in a
concave corner); for a polygon one more on such a face. Of two gaps that agree to within a nanometre, the one that comes first along the
outline counts as nearer: rounding must not decide at which face friction acts. Contact uses the outline, not the cells, because the
cells would turn an oblique face into a staircase.

`contact_rows.py` turns contacts into constraints of a step.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from push_ident.physics.kernel import kernel
from push_ident.types import Float64Array


class Field(IntEnum):
    """First column of each field of a contact."""

    GAP = 0
    """[m]"""
    NORMAL = 1
    """Outward normal x, y."""
    POINT = 3
    """Contact point x, y [m]."""
    CURVATURE = 5
    """c [1/m] gives the rotation of the normal, dn = c (I - n n') d(tip): 0 on an edge, +-1/distance at a corner."""
    KIND = 6
    TIP = 7
    """Point of the pusher's core that determines the gap x, y [m]."""
    OWNER = 9
    """Index of the pusher's corner, -1 for a side."""
    EDGE = 10
    """Index of the edge of the outline that is touched, or of the one behind the corner."""
    ALONG = 11
    """Place of the nearest point on it, from 0 at its first vertex to 1."""
    LENGTH = 12
    """Of that edge [m]."""
    WIDTH = 13
    """Number of columns."""


class Kind(IntEnum):
    """Kind of a contact."""

    EDGE = 0
    """Corner of the pusher on an edge of the outline: the contact point follows the pusher."""
    CORNER = 1
    """Corner of the pusher on a corner of the outline: the point is fixed."""
    SIDE = 2
    """Corner of the outline on a side of the pusher: the point is fixed, the normal rotates with the pusher."""


MAX_DISC_CONTACTS = 2
"""Of a disc: the nearest, and one on a face with another normal."""

PARALLEL = 0.9
"""Cosine between normals above which two contacts belong to the same face."""

REACH = 2e-3
"""Contacts nearer than this take part in a step, in addition to what the pusher covers in it [m]."""


class _Tolerances(NamedTuple):
    """When contacts count as equal, lengths [m]: far below the accuracy of outlines, far above rounding."""

    support: float = 0.3
    """Sine of the angle by which a corner of the pusher may lie behind the foremost one [1]."""
    equal_gaps: float = 1e-9
    """Gaps that differ by less are equal."""
    shallow: float = 1e-4
    """Overlap up to which a corner of the pusher is treated as outside for the other faces."""
    same_point: float = 1e-4
    """Contacts of one face closer together are duplicates."""


_TOLERANCES = _Tolerances()


@kernel
def _edge_feature(px: float, py: float, outline: Float64Array, i: int) -> tuple[float, float, float, float]:
    """Distance to edge i, its nearest point, and the position of that point along the edge (0 to 1)."""
    j = i + 1 if i + 1 < outline.shape[0] else 0
    ax, ay = outline[i, 0], outline[i, 1]
    ex, ey = outline[j, 0] - ax, outline[j, 1] - ay
    length2 = ex * ex + ey * ey
    s = 0.0 if length2 < 1e-12 else ((px - ax) * ex + (py - ay) * ey) / length2
    s = min(1.0, max(0.0, s))
    qx, qy = ax + s * ex, ay + s * ey
    return math.sqrt((px - qx) ** 2 + (py - qy) ** 2), qx, qy, s


@kernel
def _crosses(px: float, py: float, outline: Float64Array, i: int) -> bool:
    """Whether a ray from the point along +x crosses edge i. An odd number of crossings means that the point is inside."""
    j = i + 1 if i + 1 < outline.shape[0] else 0
    yi, yj = outline[i, 1], outline[j, 1]
    return (yi > py) != (yj > py) and px < (outline[j, 0] - outline[i, 0]) * (py - yi) / (yj - yi) + outline[i, 0]


@kernel
def _fill(contact: Float64Array, px: float, py: float, radius: float, outline: Float64Array, i: int, inside: bool, owner: int) -> None:
    """Contact of a corner of the pusher with the nearest point of edge i."""
    distance, qx, qy, s = _edge_feature(px, py, outline, i)
    sign = -1.0 if inside else 1.0
    j = i + 1 if i + 1 < outline.shape[0] else 0
    ex, ey = outline[j, 0] - outline[i, 0], outline[j, 1] - outline[i, 1]
    length = math.hypot(ex, ey)
    if 0.0 < s < 1.0 or distance < 1e-9:
        # The outline runs counter-clockwise, so the outside lies to the right of each edge.
        contact[Field.NORMAL], contact[Field.NORMAL + 1] = ey / length, -ex / length
        contact[Field.CURVATURE], contact[Field.KIND] = 0.0, Kind.EDGE.value
    else:
        contact[Field.NORMAL], contact[Field.NORMAL + 1] = sign * (px - qx) / distance, sign * (py - qy) / distance
        contact[Field.CURVATURE], contact[Field.KIND] = sign / distance, Kind.CORNER.value
    contact[Field.GAP] = sign * distance - radius
    contact[Field.POINT], contact[Field.POINT + 1] = qx, qy
    contact[Field.TIP], contact[Field.TIP + 1] = px, py
    contact[Field.OWNER] = owner
    contact[Field.EDGE], contact[Field.ALONG], contact[Field.LENGTH] = i, s, length


@kernel
def _fill_edge(contact: Float64Array, px: float, py: float, radius: float, outline: Float64Array, i: int, owner: int) -> None:
    """Contact of a corner of the pusher with the line of edge i."""
    j = i + 1 if i + 1 < outline.shape[0] else 0
    ex, ey = outline[j, 0] - outline[i, 0], outline[j, 1] - outline[i, 1]
    length = math.hypot(ex, ey)
    nx, ny = ey / length, -ex / length
    height = nx * (px - outline[i, 0]) + ny * (py - outline[i, 1])
    contact[Field.GAP], contact[Field.NORMAL], contact[Field.NORMAL + 1] = height - radius, nx, ny
    contact[Field.POINT], contact[Field.POINT + 1] = px - height * nx, py - height * ny
    contact[Field.CURVATURE], contact[Field.KIND] = 0.0, Kind.EDGE.value
    contact[Field.TIP], contact[Field.TIP + 1] = px, py
    contact[Field.OWNER] = owner
    along = (ex * (px - outline[i, 0]) + ey * (py - outline[i, 1])) / length
    contact[Field.EDGE], contact[Field.ALONG], contact[Field.LENGTH] = i, along / length, length


@kernel
def _foremost(contact: Float64Array, tips: Float64Array, j: int) -> bool:
    """Whether corner j of the pusher is nearly the foremost one against the normal. No other corner can touch there."""
    m = tips.shape[0]
    nx, ny = contact[Field.NORMAL], contact[Field.NORMAL + 1]
    for k in ((j + 1) % m, (j + m - 1) % m):
        ex, ey = tips[k, 0] - tips[j, 0], tips[k, 1] - tips[j, 1]
        if -(nx * ex + ny * ey) > _TOLERANCES.support * math.sqrt(ex * ex + ey * ey):
            return False
    return True


@kernel
def _corner_candidates(
    tips: Float64Array, j: int, radius: float, outline: Float64Array, reach: float, candidates: Float64Array, n: int
) -> int:
    """Append the contacts of corner j of the pusher to the `n` candidates, the nearest feature and others that it faces. Returns `n`."""
    px, py = tips[j, 0], tips[j, 1]
    nearest, nearest_distance = 0, np.inf
    inside = False
    for i in range(outline.shape[0]):
        distance, _, _, _ = _edge_feature(px, py, outline, i)
        if distance < nearest_distance:
            nearest, nearest_distance = i, distance
        if _crosses(px, py, outline, i):
            inside = not inside
    if not inside and nearest_distance - radius > reach:
        return n
    polygon = tips.shape[0] > 1
    _fill(candidates[n], px, py, radius, outline, nearest, inside, j)
    if not polygon or _foremost(candidates[n], tips, j):
        n += 1
    if inside and not polygon:
        return n
    if inside and nearest_distance < _TOLERANCES.shallow and n > 0 and candidates[n - 1, Field.OWNER] == j:
        # The corner overlaps one face slightly. Find the other faces from its mirror image outside that face.
        out_x, out_y = px + 2.0 * (candidates[n - 1, Field.POINT] - px), py + 2.0 * (candidates[n - 1, Field.POINT + 1] - py)
        for i in range(outline.shape[0]):
            distance, qx, qy, s = _edge_feature(out_x, out_y, outline, i)
            k = i + 1 if i + 1 < outline.shape[0] else 0
            faces = (outline[k, 1] - outline[i, 1]) * (out_x - qx) - (outline[k, 0] - outline[i, 0]) * (out_y - qy) > 0.0
            if i == nearest or not 0.0 < s < 1.0 or not faces or distance - radius > reach:
                continue
            _fill_edge(candidates[n], px, py, radius, outline, i, j)
            if _foremost(candidates[n], tips, j):
                n += 1
        return n
    _, _, _, s_before = _edge_feature(px, py, outline, outline.shape[0] - 1)
    for i in range(outline.shape[0]):
        distance, qx, qy, s = _edge_feature(px, py, outline, i)
        # A convex corner of the outline, nearer than the edges beside it: a pusher in a narrow pocket rests on two of them.
        on_corner = not inside and s == 0.0 and s_before == 1.0
        s_before = s
        if i == nearest or not (0.0 < s < 1.0 or on_corner) or distance - radius > reach:
            continue
        k = i + 1 if i + 1 < outline.shape[0] else 0
        faces = (outline[k, 1] - outline[i, 1]) * (px - qx) - (outline[k, 0] - outline[i, 0]) * (py - qy) > 0.0
        if faces == inside:
            continue
        _fill(candidates[n], px, py, radius, outline, i, inside, j)
        if polygon and not _foremost(candidates[n], tips, j):
            continue
        # A corner inside the outline leaves it through one edge only, the nearest of those that it can touch.
        if inside and n > 0 and candidates[n - 1, Field.OWNER] == j:
            if candidates[n, Field.GAP] > candidates[n - 1, Field.GAP]:
                candidates[n - 1] = candidates[n]
            continue
        n += 1
    return n


@kernel
def _side_candidates(tips: Float64Array, radius: float, outline: Float64Array, reach: float, candidates: Float64Array, n: int) -> int:
    """Append the contacts of convex corners of the outline with straight sides of the pusher to the `n` candidates. Returns the new `n`."""
    m = tips.shape[0]
    n_outline = outline.shape[0]
    for i in range(n_outline):
        ox, oy = outline[i, 0], outline[i, 1]
        a, b = outline[i - 1 if i > 0 else n_outline - 1], outline[i + 1 if i + 1 < n_outline else 0]
        if (ox - a[0]) * (b[1] - oy) - (oy - a[1]) * (b[0] - ox) <= 0.0:
            continue
        height, mx, my, along = -np.inf, 0.0, 0.0, 0.0
        for j in range(m):
            k = j + 1 if j + 1 < m else 0
            ex, ey = tips[k, 0] - tips[j, 0], tips[k, 1] - tips[j, 1]
            length = math.sqrt(ex * ex + ey * ey)
            h = (ey * (ox - tips[j, 0]) - ex * (oy - tips[j, 1])) / length
            # In a convex polygon the side with the greatest height faces the point.
            if h > height:
                height, mx, my = h, ey / length, -ex / length
                along = (ex * (ox - tips[j, 0]) + ey * (oy - tips[j, 1])) / (length * length)
        if not 0.0 < along < 1.0 or abs(height) - radius > reach:
            continue
        contact = candidates[n]
        contact[Field.GAP] = height - radius
        contact[Field.NORMAL], contact[Field.NORMAL + 1] = -mx, -my
        contact[Field.POINT], contact[Field.POINT + 1] = ox, oy
        contact[Field.CURVATURE], contact[Field.KIND] = 0.0, Kind.SIDE.value
        contact[Field.TIP], contact[Field.TIP + 1] = ox, oy
        contact[Field.OWNER] = -1
        contact[Field.EDGE], contact[Field.ALONG], contact[Field.LENGTH] = i, 0.0, math.hypot(b[0] - ox, b[1] - oy)
        n += 1
    return n


@kernel
def count_inside(points: Float64Array, outline: Float64Array) -> int:
    """Number of `points`, shape (n, 2), inside the outline."""
    number = 0
    for k in range(points.shape[0]):
        inside = False
        for i in range(outline.shape[0]):
            if _crosses(points[k, 0], points[k, 1], outline, i):
                inside = not inside
        number += inside
    return number


@kernel
def max_candidates(n_tips: int, n_outline: int) -> int:
    """Number of rows that `find_contacts` needs in `candidates`."""
    return n_tips * (n_outline + 1) + n_outline + 1


@kernel
def _duplicates(contact: Float64Array, other: Float64Array) -> bool:
    """Whether two contacts are the same: on one face, and of the same corner of the pusher or at the same point."""
    mx, my = other[Field.NORMAL], other[Field.NORMAL + 1]
    if contact[Field.NORMAL] * mx + contact[Field.NORMAL + 1] * my < PARALLEL:
        return False
    offset = -my * (contact[Field.POINT] - other[Field.POINT]) + mx * (contact[Field.POINT + 1] - other[Field.POINT + 1])
    return (contact[Field.OWNER] >= 0.0 and contact[Field.OWNER] == other[Field.OWNER]) or abs(offset) < _TOLERANCES.same_point


@kernel
def find_contacts(
    tips: Float64Array,
    radius: float,
    outline: Float64Array,
    reach: float,
    candidates: Float64Array,
    contacts: Float64Array,
    separate: bool = False,
) -> int:
    """Contacts of the pusher with the outline.

    Args:
        tips: corners of the pusher's core, counter-clockwise [m], shape (n_tips, 2), object frame. A disc has one, its centre.
        radius: radius of the rounding [m].
        outline: counter-clockwise polygon [m], shape (n_vertices, 2), object frame.
        reach: greatest gap of a contact [m].
        candidates: scratch, shape (max_candidates(n_tips, n_vertices), Field.WIDTH).
        contacts: filled with one row for each contact, shape (MAX_CONTACTS, Field.WIDTH); see `Field.WIDTH`.
        separate: the tips are two fingers.

    Returns:
        The number of rows filled. The first is the nearest; of fingers that both touch, the second is the nearest of the other one.
    """
    if not separate:
        return _contacts_of_body(tips, radius, outline, reach, candidates, contacts)
    first, n_first = contacts[:MAX_DISC_CONTACTS], 0
    other, n_other = contacts[MAX_DISC_CONTACTS : 2 * MAX_DISC_CONTACTS], 0
    n_first = _contacts_of_body(tips[:1], radius, outline, reach, candidates, first)
    n_other = _contacts_of_body(tips[1:2], radius, outline, reach, candidates, other)
    other[:n_other, Field.OWNER] = 1.0
    kept = candidates[: 2 * MAX_DISC_CONTACTS]
    kept[:] = contacts[: 2 * MAX_DISC_CONTACTS]
    begin, end, n_begin, n_end = 0, MAX_DISC_CONTACTS, n_first, n_other
    if n_first == 0 or (n_other > 0 and other[0, Field.GAP] < first[0, Field.GAP] - _TOLERANCES.equal_gaps):
        begin, end, n_begin, n_end = MAX_DISC_CONTACTS, 0, n_other, n_first
    number = 0
    for i in range(MAX_DISC_CONTACTS):
        if i < n_begin:
            contacts[number] = kept[begin + i]
            number += 1
        if i < n_end:
            contacts[number] = kept[end + i]
            number += 1
    return number


@kernel
def _contacts_of_body(
    tips: Float64Array, radius: float, outline: Float64Array, reach: float, candidates: Float64Array, contacts: Float64Array
) -> int:
    """Contacts of a pusher in one piece; arguments as those of `find_contacts`, contacts of as many rows as it may have."""
    n = 0
    for j in range(tips.shape[0]):
        n = _corner_candidates(tips, j, radius, outline, reach, candidates, n)
    if tips.shape[0] > 1:
        n = _side_candidates(tips, radius, outline, reach, candidates, n)
    first = -1
    for i in range(n):
        if candidates[i, Field.GAP] <= reach and (
            first < 0 or candidates[i, Field.GAP] < candidates[first, Field.GAP] - _TOLERANCES.equal_gaps
        ):
            first = i
    if first < 0:
        return 0
    contacts[0] = candidates[first]
    nx, ny = contacts[0, Field.NORMAL], contacts[0, Field.NORMAL + 1]
    # On the face of the first contact, on each side of it: the contact that the smallest relative rotation would close.
    left = right = elsewhere = -1
    left_turn = right_turn = elsewhere_gap = np.inf
    for i in range(n):
        if i == first or candidates[i, Field.GAP] > reach:
            continue
        if candidates[i, Field.NORMAL] * nx + candidates[i, Field.NORMAL + 1] * ny < PARALLEL:
            if candidates[i, Field.GAP] < elsewhere_gap - _TOLERANCES.equal_gaps:
                elsewhere, elsewhere_gap = i, candidates[i, Field.GAP]
            continue
        if candidates[i, Field.OWNER] >= 0.0 and candidates[i, Field.OWNER] == contacts[0, Field.OWNER]:
            continue
        offset = -ny * (candidates[i, Field.POINT] - contacts[0, Field.POINT]) + nx * (
            candidates[i, Field.POINT + 1] - contacts[0, Field.POINT + 1]
        )
        if abs(offset) < _TOLERANCES.same_point:
            continue
        turn = (candidates[i, Field.GAP] - contacts[0, Field.GAP] + _TOLERANCES.same_point) / abs(offset)
        if offset > 0.0 and turn < left_turn:
            left, left_turn = i, turn
        elif offset < 0.0 and turn < right_turn:
            right, right_turn = i, turn
    # A polygon may touch the other face with a side, or touch a third face.
    another = -1
    if elsewhere >= 0 and tips.shape[0] > 1:
        for i in range(n):
            if (
                i in (first, elsewhere)
                or candidates[i, Field.GAP] > reach
                or candidates[i, Field.NORMAL] * nx + candidates[i, Field.NORMAL + 1] * ny >= PARALLEL
            ):
                continue
            if _duplicates(candidates[i], candidates[elsewhere]):
                continue
            if another < 0 or candidates[i, Field.GAP] < candidates[another, Field.GAP] - _TOLERANCES.equal_gaps:
                another = i
    number = 1
    while number < contacts.shape[0]:
        best = -1
        for i in (left, right, elsewhere, another):
            if i >= 0 and (best < 0 or candidates[i, Field.GAP] < candidates[best, Field.GAP]):
                best = i
        if best < 0:
            break
        contacts[number] = candidates[best]
        number += 1
        if best == left:
            left = -1
        elif best == right:
            right = -1
        elif best == elsewhere:
            elsewhere = -1
        else:
            another = -1
    return number
