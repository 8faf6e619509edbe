"""Constraints that the contacts between pusher and outline impose on a step, and their derivative, object axes (compiled).

The physical surface may lie `offset` outside the outline: gaps are those of a pusher that is larger by the offset, and contact points
move with the surface. An impact may be elastic, see `add_rebound`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from push_ident.physics.contact import PARALLEL, Field, Kind
from push_ident.physics.kernel import kernel
from push_ident.physics.modes import MAX_CONTACTS, Row, StepGeometry
from push_ident.types import Float64Array

RECOVERY_SPEED = 0.02
"""Greatest speed at which an overlap closes [m/s]. Noisy poses cause overlaps; closing one within a step would throw the object."""

_TOUCHES = 2e-5  # greatest gap of a contact that closed in the last step [m]


class RelativePusher(NamedTuple):
    """The pusher during one step, in the object frame at the start of the step. Each step overwrites the arrays."""

    centre: Float64Array
    """[m], shape (2,)."""
    velocity: Float64Array
    """[m/s], shape (2,)."""
    spin: Float64Array
    """Angular velocity [rad/s], shape (1,)."""
    corners: Float64Array
    """Of the pusher's core [m], shape (n_corners, 2)."""
    separate: bool
    """The corners are fingers."""


@kernel
def new_relative_pusher(n_corners: int, separate: bool) -> RelativePusher:
    """Space for one step."""
    return RelativePusher(np.zeros(2), np.zeros(2), np.zeros(1), np.zeros((n_corners, 2)), separate)


class RelativeChange(NamedTuple):
    """Derivative of the pusher relative to the object, and of the centre of mass, with respect to one input."""

    pusher: Float64Array
    """Of the pusher's centre, shape (2,)."""
    angle: Float64Array
    """Of its angle, shape (1,)."""
    centre: Float64Array
    """Of the centre of mass, shape (2,)."""
    velocity: Float64Array
    """Of the pusher's velocity, shape (2,)."""


class Rebound(NamedTuple):
    """State of an elastic impact, from the step before."""

    acts: bool
    """Whether a contact pressed in the last step."""
    restitution: float
    """From 0 (pusher and object stay in contact) to 1."""
    twist: Float64Array
    """Of the centre of mass before the last step, object axes, shape (3,)."""


class ContactEffects(NamedTuple):
    """How effects change the contacts of a step, and the derivatives of these changes with respect to one input."""

    offset: float
    """Of the surface from the outline [m]."""
    rebound: Rebound
    d_spin: float
    """Of the pusher's angular velocity."""
    d_offset: float
    d_restitution: float
    d_twist: Float64Array
    """Of the twist of `Rebound`, shape (3,)."""
    d_vertices: Float64Array
    """Of the vertices of the outline, shape (n_vertices, 2); of no vertices where the outline stays."""


@kernel
def _contact_share(gap: float, approach: float, dt: float) -> float:
    """Share of a step that is left when a gap [m] has closed at the speed `approach` [m/s]; 0 where it does not close."""
    if gap <= 0.0:
        return 1.0
    return 1.0 - gap / (approach * dt) if approach * dt > gap else 0.0


@kernel
def contact_rows(
    contact: Float64Array, k: int, geometry: StepGeometry, pusher: RelativePusher, face: Float64Array, rows: Float64Array
) -> None:
    """Write contact k into `rows`, shape (2 MAX_CONTACTS, Row.WIDTH), see `modes.py`; `face` is the first contact.

    N u >= b,   b = -n . v_pusher - max(gap / dt, -RECOVERY_SPEED)        v_pusher at the contact point
    T u - t . v_pusher                                                   slip

    In the step that strikes an object at rest (`StepGeometry.is_struck`), contact lasts for the share `_contact_share` of the step only. N
    takes this share of the pusher's normal velocity, by the gap; T takes the same share of its tangential velocity. Then this step and the
    next one together give the impulse of one impact, wherever in a step it happens.
    """
    centre, dt = geometry.centre, geometry.dt
    velocity, spin = pusher.velocity, pusher.spin[0]
    nx, ny = contact[Field.NORMAL], contact[Field.NORMAL + 1]
    ax, ay = contact[Field.POINT] - centre[0], contact[Field.POINT + 1] - centre[1]
    vx = velocity[0] - spin * (contact[Field.POINT + 1] - pusher.centre[1])
    vy = velocity[1] + spin * (contact[Field.POINT] - pusher.centre[0])
    tx, ty = -ny, nx
    i = MAX_CONTACTS + k
    rows[k, 0], rows[k, 1], rows[k, 2] = -nx, -ny, -(ax * ny - ay * nx)
    rows[i, 0], rows[i, 1], rows[i, 2] = tx, ty, ax * ty - ay * tx
    rows[k, Row.BOUND] = -(nx * vx + ny * vy) - max(contact[Field.GAP] / dt, -RECOVERY_SPEED)
    rows[i, Row.BOUND] = tx * vx + ty * vy
    if geometry.is_struck:
        rows[i, Row.BOUND] *= _contact_share(contact[Field.GAP], -(nx * vx + ny * vy), dt)
    if pusher.separate:
        rows[k, Row.SHARES_TANGENT] = 1.0 if k == 0 else 0.0
        rows[k, Row.OF_SECOND] = 1.0 if k == 1 and contact[Field.OWNER] != face[Field.OWNER] else 0.0
    else:
        rows[k, Row.SHARES_TANGENT] = 1.0 if nx * face[Field.NORMAL] + ny * face[Field.NORMAL + 1] >= PARALLEL else 0.0


@kernel
def shift_surface(contacts: Float64Array, n_contacts: int, offset: float) -> None:
    """Move contact points to the surface, for contacts that were found with a radius larger by `offset` [m]."""
    for k in range(n_contacts):
        contacts[k, Field.POINT] += offset * contacts[k, Field.NORMAL]
        contacts[k, Field.POINT + 1] += offset * contacts[k, Field.NORMAL + 1]


@kernel
def add_rebound(contact: Float64Array, k: int, rebound: Rebound, dt: float, rows: Float64Array) -> None:
    """Newton's law of impact at contact k: the surfaces separate at `restitution` times their speed of approach.

    The law acts in the step after one in which the contact pressed. That step has closed the gap without rebound, so that an impact
    takes two steps. As the restitution tends to 0, the motion tends to the one without it.
    """
    if rebound.acts and contact[Field.GAP] <= _TOUCHES:
        before = rebound.twist
        pusher = rows[k, Row.BOUND] + max(contact[Field.GAP] / dt, -RECOVERY_SPEED)
        approach = pusher - rows[k, 0] * before[0] - rows[k, 1] * before[1] - rows[k, 2] * before[2]
        rows[k, Row.BOUND] += rebound.restitution * max(0.0, approach)


@kernel
def _change_of_place(contact: Float64Array, is_edge: bool, d_vertices: Float64Array) -> tuple[float, float, float]:
    """How the place that a contact touches moves with the vertices of the outline: x and y, for an edge along its normal only, and how much
    an edge turns."""
    i = int(contact[Field.EDGE])
    j = i + 1 if i + 1 < d_vertices.shape[0] else 0
    begin, end, along = d_vertices[i], d_vertices[j], contact[Field.ALONG]
    x, y = begin[0] + along * (end[0] - begin[0]), begin[1] + along * (end[1] - begin[1])
    if not is_edge:
        return x, y, 0.0
    nx, ny = contact[Field.NORMAL], contact[Field.NORMAL + 1]
    outward = nx * x + ny * y
    return outward * nx, outward * ny, -(nx * (end[0] - begin[0]) + ny * (end[1] - begin[1])) / contact[Field.LENGTH]


@kernel
def contact_rows_seed(
    contact: Float64Array,
    k: int,
    geometry: StepGeometry,
    relative: RelativePusher,
    change: RelativeChange,
    effects: ContactEffects | None,
    d_rows: Float64Array,
) -> None:
    """Derivative of `contact_rows` for a change of the pusher, of the centre of mass and, where effects act, of their values and of the
    vertices of the outline."""
    centre, dt = geometry.centre, geometry.dt
    pusher, velocity, spin = relative.centre, relative.velocity, relative.spin[0]
    d_pusher, d_angle, d_centre, d_velocity = change.pusher, change.angle[0], change.centre, change.velocity
    nx, ny = contact[Field.NORMAL], contact[Field.NORMAL + 1]
    tx, ty = -ny, nx
    ax, ay = contact[Field.POINT] - centre[0], contact[Field.POINT + 1] - centre[1]
    bx, by = contact[Field.POINT] - pusher[0], contact[Field.POINT + 1] - pusher[1]
    vx, vy = velocity[0] - spin * by, velocity[1] + spin * bx
    d_tip_x = d_pusher[0] - d_angle * (contact[Field.TIP + 1] - pusher[1])
    d_tip_y = d_pusher[1] + d_angle * (contact[Field.TIP] - pusher[0])
    is_edge = contact[Field.KIND] == Kind.EDGE.value
    d_place_x = d_place_y = d_heading = 0.0
    if effects is not None and effects.d_vertices.shape[0] > 0:
        d_place_x, d_place_y, d_heading = _change_of_place(contact, is_edge, effects.d_vertices)
        # What matters is where the pusher is relative to the place that it touches.
        d_tip_x -= d_place_x
        d_tip_y -= d_place_y
    along = tx * d_tip_x + ty * d_tip_y
    turn = d_angle if contact[Field.KIND] == Kind.SIDE.value else contact[Field.CURVATURE] * along + d_heading
    slide = along if is_edge else 0.0
    dnx, dny = turn * tx, turn * ty
    dtx, dty = -dny, dnx
    d_point_x, d_point_y = slide * tx, slide * ty
    d_gap = nx * d_tip_x + ny * d_tip_y
    if effects is not None:
        height = nx * (contact[Field.TIP] - contact[Field.POINT]) + ny * (contact[Field.TIP + 1] - contact[Field.POINT + 1])
        height += effects.offset
        d_point_x += d_place_x - height * d_heading * tx
        d_point_y += d_place_y - height * d_heading * ty
        d_point_x += effects.offset * dnx + effects.d_offset * nx
        d_point_y += effects.offset * dny + effects.d_offset * ny
        d_gap -= effects.d_offset
    dax, day = d_point_x - d_centre[0], d_point_y - d_centre[1]
    dvx = d_velocity[0] - spin * (d_point_y - d_pusher[1])
    dvy = d_velocity[1] + spin * (d_point_x - d_pusher[0])
    if effects is not None:
        dvx -= effects.d_spin * by
        dvy += effects.d_spin * bx
    # A deeper overlap closes at the recovery speed, whatever its depth.
    if contact[Field.GAP] <= -RECOVERY_SPEED * dt:
        d_gap = 0.0
    d_rows[k, 0], d_rows[k, 1] = -dnx, -dny
    d_rows[k, 2] = -(dax * ny + ax * dny - day * nx - ay * dnx)
    d_bound = -(dnx * vx + dny * vy + nx * dvx + ny * dvy)
    d_rows[k, Row.BOUND] = d_bound - d_gap / dt
    if effects is not None and effects.rebound.acts and contact[Field.GAP] <= _TOUCHES:
        before, d_before = effects.rebound.twist, effects.d_twist
        approach = nx * (before[0] - vx) + ny * (before[1] - vy) + (ax * ny - ay * nx) * before[2]
        if approach > 0.0:
            d_approach = d_bound + nx * d_before[0] + ny * d_before[1] + (ax * ny - ay * nx) * d_before[2]
            d_approach -= d_rows[k, 0] * before[0] + d_rows[k, 1] * before[1] + d_rows[k, 2] * before[2]
            d_rows[k, Row.BOUND] += effects.d_restitution * approach + effects.rebound.restitution * d_approach
    i = MAX_CONTACTS + k
    d_rows[i, 0], d_rows[i, 1] = dtx, dty
    d_rows[i, 2] = dax * ty + ax * dty - day * tx - ay * dtx
    d_rows[i, Row.BOUND] = dtx * vx + dty * vy + tx * dvx + ty * dvy
    if geometry.is_struck:
        closing = -(nx * vx + ny * vy)
        share = _contact_share(contact[Field.GAP], closing, dt)
        d_rows[i, Row.BOUND] *= share
        if 0.0 < share < 1.0:
            d_rows[i, Row.BOUND] += (tx * vx + ty * vy) * (contact[Field.GAP] * d_bound / closing - d_gap) / (closing * dt)
