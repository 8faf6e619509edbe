"""Contact between a disc pusher and the exact outline polygon, in the object frame (compiled).

The pusher is a disc; its centre is seen from the object. At most two contacts act at once: the nearest feature of the
outline, and the nearest other feature whose normal points elsewhere (a pusher in a concave corner). Cells play no part:
a staircase of cells would turn every oblique face into a row of steps.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from push_ident.types import Float64Array

__all__ = ["CONTACT_FIELDS", "MAX_CONTACTS", "find_contacts"]

MAX_CONTACTS = 2
CONTACT_FIELDS = 7
"""Columns of a contact: gap [m], outward normal x, y, contact point x, y [m], curvature [1/m], kind.

`curvature` c [1/m] gives the turn of the normal, dn = c (I - n n') d(centre): 0 on an edge, +-1/distance at a vertex.
`kind` is 0 on an edge (the contact point follows the pusher) and 1 at a vertex (it stays)."""

_PARALLEL = 0.9  # cosine above which a second contact repeats the first
_TINY = 1e-12


@njit(cache=True)
def _inside(px: float, py: float, outline: Float64Array) -> bool:
    inside = False
    n = outline.shape[0]
    j = n - 1
    for i in range(n):
        yi, yj = outline[i, 1], outline[j, 1]
        if (yi > py) != (yj > py) and px < (outline[j, 0] - outline[i, 0]) * (py - yi) / (yj - yi) + outline[i, 0]:
            inside = not inside
        j = i
    return inside


@njit(cache=True)
def _edge_feature(px: float, py: float, outline: Float64Array, i: int) -> tuple[float, float, float, float]:
    """Distance to edge i, its nearest point, and where along the edge (0..1) that lies."""
    j = i + 1 if i + 1 < outline.shape[0] else 0
    ax, ay = outline[i, 0], outline[i, 1]
    ex, ey = outline[j, 0] - ax, outline[j, 1] - ay
    length2 = ex * ex + ey * ey
    s = 0.0 if length2 < _TINY else ((px - ax) * ex + (py - ay) * ey) / length2
    s = min(1.0, max(0.0, s))
    qx, qy = ax + s * ex, ay + s * ey
    return math.hypot(px - qx, py - qy), qx, qy, s


@njit(cache=True)
def _fill(contact: Float64Array, px: float, py: float, radius: float, outline: Float64Array, i: int, inside: bool) -> None:
    """Contact of the pusher with the nearest point of edge i."""
    distance, qx, qy, s = _edge_feature(px, py, outline, i)
    sign = -1.0 if inside else 1.0
    if 0.0 < s < 1.0 or distance < 1e-9:
        j = i + 1 if i + 1 < outline.shape[0] else 0
        ex, ey = outline[j, 0] - outline[i, 0], outline[j, 1] - outline[i, 1]
        length = math.hypot(ex, ey)
        # The outline runs counter-clockwise, so the outside lies to the right of each edge.
        contact[1], contact[2] = ey / length, -ex / length
        contact[5], contact[6] = 0.0, 0.0
    else:
        contact[1], contact[2] = sign * (px - qx) / distance, sign * (py - qy) / distance
        contact[5], contact[6] = sign / distance, 1.0
    contact[0] = sign * distance - radius
    contact[3], contact[4] = qx, qy


@njit(cache=True)
def find_contacts(px: float, py: float, radius: float, outline: Float64Array, reach: float, contacts: Float64Array) -> int:
    """Contacts of a disc with the outline.

    Args:
        px, py: centre of the disc [m], object frame.
        radius: of the disc [m]; 0 is a point.
        outline: counter-clockwise polygon [m], shape (n_vertices, 2), object frame.
        reach: features with a gap above it are left out [m].
        contacts: filled with one row a contact, shape (MAX_CONTACTS, CONTACT_FIELDS); see `CONTACT_FIELDS`.

    Returns:
        The number of rows filled. The first is the nearest.
    """
    n = outline.shape[0]
    nearest, nearest_distance = 0, np.inf
    for i in range(n):
        distance, _, _, _ = _edge_feature(px, py, outline, i)
        if distance < nearest_distance:
            nearest, nearest_distance = i, distance
    inside = _inside(px, py, outline)
    _fill(contacts[0], px, py, radius, outline, nearest, inside)
    if contacts[0, 0] > reach:
        return 0
    # A second contact needs a feature of its own: an edge that the pusher faces, not a neighbour of the same vertex.
    if inside:
        return 1
    second, second_distance = -1, np.inf
    for i in range(n):
        distance, qx, qy, s = _edge_feature(px, py, outline, i)
        if not 0.0 < s < 1.0 or distance - radius > reach or distance >= second_distance:
            continue
        dx, dy = (px - qx) / max(distance, _TINY), (py - qy) / max(distance, _TINY)
        j = i + 1 if i + 1 < n else 0
        faces = (outline[j, 1] - outline[i, 1]) * dx - (outline[j, 0] - outline[i, 0]) * dy > 0.0
        if faces and dx * contacts[0, 1] + dy * contacts[0, 2] < _PARALLEL:
            second, second_distance = i, distance
    if second < 0:
        return 1
    _fill(contacts[1], px, py, radius, outline, second, False)
    return 2
