"""One push, integrated in steps of some 40 microseconds.

Bristles under every cell, a spring and damper at the pusher, a bed of springs below.

Bristles follow Dahl's model in two dimensions, ds/dt = v - |v| s / travel with force -limit s / travel, so that friction opposes the
motion once a cell has slid a few hundredths of a millimetre. It stores energy, gives less of it back, and never makes any. A step of s is
implicit and so stable at any speed.

The table under the cells is a bed of equal springs on which the rigid base stands with heave, pitch and roll: the loads are a linear
function of the position in the base, and none is below zero. A cell without friction hangs above the table and bears nothing.

All kernels are in this file, as numba does not notice a change of a kernel in another file.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from push_ident_sim.engines.planar.laws import CONSTANTS, Laws

FloatArray = NDArray[np.float64]

_kernel: Any = njit(cache=True, error_model="numpy")


class Body(NamedTuple):
    """The object; points from its centre of mass, object axes."""

    arms: FloatArray
    """Of the cells [m], shape (n_cells, 2)."""
    friction: FloatArray
    """Friction coefficients of the cells, shape (n_cells,)."""
    outline: FloatArray
    """[m], shape (n_vertices, 2), counter-clockwise."""
    mass: float
    """[kg]"""
    inertia: float
    """About the centre of mass [kg m^2]."""


class Path(NamedTuple):
    """The path of the pusher's axis; after the last sample it is at rest."""

    time: FloatArray
    """[s], shape (n_samples,), from 0."""
    position: FloatArray
    """[m], shape (n_samples, 2), table axes."""


class StepChange(NamedTuple):
    """What effects do that this engine has no law of its own for; it holds for a row of steps."""

    factor: FloatArray
    """Of the friction limits of the cells, shape (n_cells,)."""
    skew: FloatArray
    """(a, b) of the friction's dependence on direction, object axes, shape (2,)."""
    wrench: FloatArray
    """(fx, fy) [N] and torque about the centre of mass [N m], table axes, shape (3,)."""


class Clock(NamedTuple):
    """Times of a simulation."""

    row_time: float
    """Between two rows [s]."""
    n_inner: int
    """Steps in that time."""
    rest_speed: float
    """The object rests below this [m/s], and ten times it in rad/s."""


class State(NamedTuple):
    """What changes during a push; all arrays are changed in place."""

    pose: FloatArray
    """Centre of mass (x, y) and yaw, table axes, shape (3,)."""
    velocity: FloatArray
    """Of them, shape (3,)."""
    pusher: FloatArray
    """Of the pusher's axis [m], shape (2,)."""
    pusher_velocity: FloatArray
    """[m/s], shape (2,)."""
    bend: FloatArray
    """Bristles under the cells [m], shape (n_cells, 2)."""
    travel: FloatArray
    """Distance that each cell has slid in this push [m], shape (n_cells,)."""
    bends: FloatArray
    """Tangential bristle of each face and each corner of the outline [m], shape (2 n_vertices,)."""
    load: FloatArray
    """Of the cells [N], shape (n_cells,)."""
    plane: FloatArray
    """Heave, pitch and roll of the bed, shape (3,)."""
    lean: FloatArray
    """Shift of the load by the height of the push [m], shape (2,), object axes."""
    contents: FloatArray
    """Shift of the load by loose contents [m], shape (2,), object axes."""
    table_wrench: FloatArray
    """Wrench of the table's friction in the last step, shape (3,)."""
    finger: FloatArray
    """Spin of the finger about its own axis [rad/s], shape (1,)."""
    sample: NDArray[np.int64]
    """Last sample of the path that lies behind, shape (1,)."""
    still: NDArray[np.int64]
    """Rows for which the object has been at rest, shape (1,)."""


def new_state(body: Body, path: Path, pose: FloatArray, velocity: FloatArray, weight: float) -> tuple[State, bool]:
    """The state at the start of a push, at rest but for `velocity`, and whether the object stands; `weight` [N]."""
    n_cells = len(body.friction)
    state = State(
        pose=pose.copy(),
        velocity=velocity.copy(),
        pusher=path.position[0].copy(),
        pusher_velocity=np.zeros(2),
        bend=np.zeros((n_cells, 2)),
        travel=np.zeros(n_cells),
        bends=np.zeros(2 * len(body.outline)),
        load=np.empty(n_cells),
        plane=np.array([weight / n_cells, 0.0, 0.0]),
        lean=np.zeros(2),
        contents=np.zeros(2),
        table_wrench=np.zeros(3),
        finger=np.zeros(1),
        sample=np.zeros(1, dtype=np.int64),
        still=np.zeros(1, dtype=np.int64),
    )
    stands = bed_loads(body.arms, body.friction > 0.0, weight, state.lean, state.plane, state.load)
    return state, stands


@_kernel
def bed_loads(arms: FloatArray, bears: NDArray[np.bool_], weight: float, centre: FloatArray, plane: FloatArray, load: FloatArray) -> bool:
    """Loads [N] of cells on equal springs under a weight [N] whose centre lies at `centre` [m].

    Args:
        arms: of the cells from the centre of mass [m], shape (n_cells, 2), object axes.
        bears: whether a cell touches the table, shape (n_cells,).
        plane: heave, pitch and roll of the last call (load at the centre and its slopes), shape (3,); changed in place.
        load: filled in, shape (n_cells,).

    Returns:
        Whether the object stands; else it tips over.
    """
    for _ in range(30):
        total = mx = my = 0.0
        n = sx = sy = sxx = sxy = syy = 0.0
        for i in range(len(load)):
            x, y = arms[i, 0], arms[i, 1]
            load[i] = max(0.0, plane[0] + plane[1] * x + plane[2] * y) if bears[i] else 0.0
            total += load[i]
            mx += load[i] * x
            my += load[i] * y
            if load[i] > 0.0:
                n += 1.0
                sx += x
                sy += y
                sxx += x * x
                sxy += x * y
                syy += y * y
        # Newton's step: the cells that bear now, as if no other would come or go.
        r0, r1, r2 = weight - total, weight * centre[0] - mx, weight * centre[1] - my
        if abs(r0) < 1e-9 * weight and abs(r1) + abs(r2) < 1e-10 * weight:
            return True
        c00, c01, c02 = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
        c11, c12, c22 = n * syy - sy * sy, sx * sy - n * sxy, n * sxx - sx * sx
        determinant = n * c00 + sx * c01 + sy * c02
        if determinant < 1e-18:
            return False
        plane[0] += (c00 * r0 + c01 * r1 + c02 * r2) / determinant
        plane[1] += (c01 * r0 + c11 * r1 + c12 * r2) / determinant
        plane[2] += (c02 * r0 + c12 * r1 + c22 * r2) / determinant
    return False


class _Frame(NamedTuple):
    """Where the object is in one step; table axes."""

    cos: float
    """Of the yaw."""
    sin: float
    pose: FloatArray
    velocity: FloatArray


class _Touch(NamedTuple):
    """One contact; table axes."""

    normal_x: float
    """Outward from the object."""
    normal_y: float
    px: float
    """From the centre of mass [m]."""
    py: float
    gap: float
    """Below 0 where the bodies overlap [m]."""
    slot: int
    """Its bristle in `State.bends`."""


@_kernel
def _contact_force(touch: _Touch, laws: Laws, body: Body, frame: _Frame, state: State, dt: float, force: FloatArray) -> None:
    """Add (fx, fy, torque) of one contact on the object to `force`."""
    normal_x, normal_y, px, py, gap, slot = touch
    velocity, pusher_velocity, finger = frame.velocity, state.pusher_velocity, state.finger[0]
    arm_n = px * normal_y - py * normal_x
    tangent_x, tangent_y = -normal_y, normal_x
    arm_t = px * tangent_y - py * tangent_x
    slip_x = velocity[0] - velocity[2] * py - pusher_velocity[0]
    slip_y = velocity[1] + velocity[2] * px - pusher_velocity[1]
    approach = slip_x * normal_x + slip_y * normal_y
    effective = 1.0 / (1.0 / body.mass + arm_n * arm_n / body.inertia)
    press = -laws.contact_stiffness * gap + 2.0 * laws.damping_ratio * np.sqrt(laws.contact_stiffness * effective) * approach
    if press <= 0.0:
        state.bends[slot] = 0.0
        return
    # At the contact the surface of the finger moves along the tangent at -spin times radius.
    slide = slip_x * tangent_x + slip_y * tangent_y + finger * laws.finger_radius
    limit = laws.pusher_friction * press
    effective_t = 1.0 / (1.0 / body.mass + arm_t * arm_t / body.inertia)
    finger_inertia = 0.5 * CONSTANTS.finger_mass * laws.finger_radius * laws.finger_radius
    if laws.finger_radius > 0.0:
        effective_t = 1.0 / (1.0 / effective_t + 2.0 / CONSTANTS.finger_mass)
    bend = (state.bends[slot] + dt * slide) / (1.0 + dt * abs(slide) / laws.contact_travel)
    stiffness = limit / laws.contact_travel
    held = max(0.0, 1.0 - abs(bend) / laws.contact_travel)
    drag = -stiffness * bend - CONSTANTS.bristle_damping * 2.0 * np.sqrt(stiffness * effective_t) * held * slide
    drag = min(limit, max(-limit, drag))
    if laws.finger_radius > 0.0:
        finger += dt * drag * laws.finger_radius / finger_inertia
        brake = dt * laws.bearing_torque / finger_inertia
        state.finger[0] = max(0.0, abs(finger) - brake) * np.sign(finger)
    fx, fy = -press * normal_x + drag * tangent_x, -press * normal_y + drag * tangent_y
    force[0] += fx
    force[1] += fy
    force[2] += px * fy - py * fx
    state.bends[slot] = bend


@_kernel
def _pusher_force(laws: Laws, body: Body, frame: _Frame, state: State, dt: float, force: FloatArray) -> None:
    """Forces of a disc on a polygon (object axes, from the centre of mass): on faces it overlaps, and on corners between two of them."""
    outline, cos, sin, pusher, bends = body.outline, frame.cos, frame.sin, state.pusher, state.bends
    n, reach = len(outline), laws.pusher_radius + laws.outline_offset
    dx, dy = pusher[0] - frame.pose[0], pusher[1] - frame.pose[1]
    cx, cy = cos * dx + sin * dy, cos * dy - sin * dx
    for j in range(n):
        ax, ay = outline[j, 0], outline[j, 1]
        k = j + 1 if j + 1 < n else 0
        ex, ey = outline[k, 0] - ax, outline[k, 1] - ay
        length = np.sqrt(ex * ex + ey * ey)
        ex /= length
        ey /= length
        along = (cx - ax) * ex + (cy - ay) * ey
        away = (cx - ax) * ey - (cy - ay) * ex
        touches = False
        nx = ny = qx = qy = gap = 0.0
        slot = 2 * j
        if 0.0 < along < length:
            if 0.0 < away < reach:
                touches, gap = True, away - laws.pusher_radius
                nx, ny = ey, -ex
                qx, qy = ax + along * ex, ay + along * ey
        elif along <= 0.0:
            b = j - 1 if j > 0 else n - 1
            bx, by = ax - outline[b, 0], ay - outline[b, 1]
            distance = np.sqrt((cx - ax) ** 2 + (cy - ay) ** 2)
            if (cx - ax) * bx + (cy - ay) * by >= 0.0 and 0.0 < distance < reach:
                touches, gap = True, distance - laws.pusher_radius
                nx, ny = (cx - ax) / distance, (cy - ay) / distance
                qx, qy = ax, ay
                slot = 2 * j + 1
        if not touches:
            bends[2 * j] = 0.0
            bends[2 * j + 1] = 0.0
            continue
        # The surface lies outside the outline by the offset.
        qx += laws.outline_offset * nx
        qy += laws.outline_offset * ny
        gap -= laws.outline_offset
        bends[4 * j + 1 - slot] = 0.0
        touch = _Touch(cos * nx - sin * ny, sin * nx + cos * ny, cos * qx - sin * qy, sin * qx + cos * qy, gap, slot)
        _contact_force(touch, laws, body, frame, state, dt, force)


@_kernel
def _table_friction(laws: Laws, body: Body, frame: _Frame, state: State, change: StepChange, dt: float, force: FloatArray) -> None:
    """Friction of the table on all cells; adds (fx, fy, torque) to `force`."""
    cos, sin, pose, velocity = frame.cos, frame.sin, frame.pose, frame.velocity
    arms, load, friction, bend, travel = body.arms, state.load, body.friction, state.bend, state.travel
    mass, weight = body.mass, body.mass * laws.gravity
    # Both grains in table axes: one of the base turns at twice the yaw.
    cos2, sin2 = cos * cos - sin * sin, 2.0 * sin * cos
    base_e1, base_e2 = laws.base_e1 + change.skew[0], laws.base_e2 + change.skew[1]
    e1 = laws.table_e1 + cos2 * base_e1 - sin2 * base_e2
    e2 = laws.table_e2 + sin2 * base_e1 + cos2 * base_e2
    for i in range(len(load)):
        rx, ry = cos * arms[i, 0] - sin * arms[i, 1], sin * arms[i, 0] + cos * arms[i, 1]
        vx, vy = velocity[0] - velocity[2] * ry, velocity[1] + velocity[2] * rx
        speed = np.sqrt(vx * vx + vy * vy)
        x, y = pose[0] + rx, pose[1] + ry
        factor = laws.level + laws.gradient_x * x + laws.gradient_y * y
        if laws.log_speed != 0.0:
            factor *= 1.0 + laws.log_speed * np.log((speed + 0.01) / 0.11)
        if laws.stribeck != 0.0:
            factor *= 1.0 + laws.stribeck * np.exp(-((speed / laws.stribeck_speed) ** 2))
        if laws.greasy != 0.0:
            factor *= 1.0 - laws.greasy * np.exp(-0.5 * (x * x + y * y) / CONSTANTS.spot_reach**2)
        if laws.heating != 0.0:
            travel[i] += dt * speed
            factor *= 1.0 - laws.heating * (1.0 - np.exp(-travel[i] / CONSTANTS.cold_travel))
        factor *= 1.0 + laws.linear_speed * speed / 0.1
        if x > 0.0:
            factor *= 1.0 + laws.step
        limit = load[i] * friction[i] * max(CONSTANTS.min_factor, factor) * change.factor[i]
        shrink = 1.0 / (1.0 + dt * speed / laws.travel)
        bend[i, 0] = (bend[i, 0] + dt * vx) * shrink
        bend[i, 1] = (bend[i, 1] + dt * vy) * shrink
        sx, sy = bend[i, 0] / laws.travel, bend[i, 1] / laws.travel
        held = max(0.0, 1.0 - np.sqrt(sx * sx + sy * sy))
        if held > 0.0 and limit > 0.0:
            damping = CONSTANTS.bristle_damping * 2.0 * np.sqrt(mass * load[i] / (weight * limit * laws.travel)) * held
            sx += damping * vx
            sy += damping * vy
            # Spring and damper of a bristle together never exceed its friction limit.
            size = max(1.0, np.sqrt(sx * sx + sy * sy))
            sx /= size
            sy /= size
        fx = -limit * (sx + e1 * sx + e2 * sy) - laws.film * vx
        fy = -limit * (sy + e2 * sx - e1 * sy) - laws.film * vy
        force[0] += fx
        force[1] += fy
        force[2] += rx * fy - ry * fx


@_kernel
def _pull(pose: FloatArray, time: float, laws: Laws, mass: float, force: FloatArray) -> None:
    """Forces at the centre of mass that come neither from the table's friction nor from the pusher."""
    force[0] += mass * laws.tilt_x - laws.tether * (pose[0] - laws.anchor_x)
    force[1] += mass * laws.tilt_y - laws.tether * (pose[1] - laws.anchor_y)
    force[1] += laws.gust * np.sin(CONSTANTS.gust_rate * time + laws.gust_phase)
    if laws.magnet != 0.0:
        dx, dy = (CONSTANTS.magnet[0] - pose[0]) / CONSTANTS.magnet_reach, (CONSTANTS.magnet[1] - pose[1]) / CONSTANTS.magnet_reach
        pull = laws.magnet * np.exp(0.5 - 0.5 * (dx * dx + dy * dy))
        force[0] += pull * dx
        force[1] += pull * dy


@_kernel
def _drive(path: Path, time: float, state: State) -> None:
    """Position and velocity of the pusher at a time [s]."""
    sample = state.sample[0]
    while sample + 2 < len(path.time) and path.time[sample + 1] <= time:
        sample += 1
    state.sample[0] = sample
    if time < path.time[-1]:
        state.pusher_velocity[:] = (path.position[sample + 1] - path.position[sample]) / (path.time[sample + 1] - path.time[sample])
        state.pusher[:] = path.position[sample] + (time - path.time[sample]) * state.pusher_velocity
    else:
        state.pusher_velocity[:] = 0.0
        state.pusher[:] = path.position[-1]


@_kernel
def _shift_loads(laws: Laws, body: Body, frame: _Frame, state: State, bears: NDArray[np.bool_], dt: float) -> bool:
    """Loads of the cells where the object leans or its contents move; returns whether it stands."""
    cos, sin, velocity, lean, contents, table_wrench = frame.cos, frame.sin, frame.velocity, state.lean, state.contents, state.table_wrench
    weight = body.mass * laws.gravity
    share = dt / CONSTANTS.bed_time
    # Pushed at the height of its centre of mass, only the moment of the table's friction makes the object lean.
    lean[0] -= share * (laws.height * (cos * table_wrench[0] + sin * table_wrench[1]) / weight + lean[0])
    lean[1] -= share * (laws.height * (cos * table_wrench[1] - sin * table_wrench[0]) / weight + lean[1])
    speed = np.sqrt(velocity[0] ** 2 + velocity[1] ** 2)
    if laws.contents != 0.0 and speed > CONSTANTS.moving:
        share = dt / (dt + laws.contents_time)
        contents[0] += share * (-laws.contents * (cos * velocity[0] + sin * velocity[1]) / speed - contents[0])
        contents[1] += share * (-laws.contents * (cos * velocity[1] - sin * velocity[0]) / speed - contents[1])
    stands: bool = bed_loads(body.arms, bears, weight, lean + contents, state.plane, state.load)
    return stands


@_kernel
def advance(
    laws: Laws, body: Body, path: Path, state: State, change: StepChange, clock: Clock, first: int, n_rows: int
) -> tuple[FloatArray, FloatArray, FloatArray, bool, bool]:
    """Up to `n_rows` rows of a push from row `first` on, fewer where it ends before; row 0 is the state at its start.

    Args:
        laws: that hold.
        body: the object.
        path: of the pusher.
        state: at the start of the first of these rows; afterwards that at the end of the last.
        change: what further effects do, the same in all these rows.
        clock: times of the simulation.
        first: number of the first row, from 1.
        n_rows: largest number of rows to return.

    Returns:
        Rows of pose, shape (n, 3), of the pusher's position, shape (n, 2), of its mean force in the row, shape (n, 2); whether the object
        stood all the time; whether the path is over and the object at rest.
    """
    n_inner = clock.n_inner
    dt = clock.row_time / n_inner
    poses, positions, forces = np.empty((n_rows, 3)), np.empty((n_rows, 2)), np.zeros((n_rows, 2))
    pose, velocity = state.pose, state.velocity
    bears = body.friction > 0.0
    shifts = laws.height != 0.0 or laws.contents != 0.0
    stands = True
    contact, force = np.zeros(3), np.zeros(3)
    for k in range(n_rows):
        row = first + k
        for inner in range(n_inner):
            time = ((row - 1) * n_inner + inner) * dt
            _drive(path, time, state)
            frame = _Frame(np.cos(pose[2]), np.sin(pose[2]), pose, velocity)
            contact[:] = 0.0
            _pusher_force(laws, body, frame, state, dt, contact)
            if shifts:
                stands = _shift_loads(laws, body, frame, state, bears, dt)
            state.table_wrench[:] = 0.0
            _table_friction(laws, body, frame, state, change, dt, state.table_wrench)
            force[:] = contact + state.table_wrench
            _pull(pose, time, laws, body.mass, force)
            force += change.wrench
            velocity[0] += dt * force[0] / body.mass
            velocity[1] += dt * force[1] / body.mass
            velocity[2] += dt * force[2] / body.inertia
            pose += dt * velocity
            forces[k, 0] += contact[0] / n_inner
            forces[k, 1] += contact[1] / n_inner
        poses[k], positions[k] = pose, state.pusher
        rests = max(abs(velocity[0]), abs(velocity[1])) < clock.rest_speed and abs(velocity[2]) < 10.0 * clock.rest_speed
        state.still[0] = state.still[0] + 1 if rests else 0
        over = row * clock.row_time >= path.time[-1] and state.still[0] >= CONSTANTS.still_rows
        if over or not stands:
            return poses[: k + 1], positions[: k + 1], forces[: k + 1], stands, over
    return poses, positions, forces, stands, False
