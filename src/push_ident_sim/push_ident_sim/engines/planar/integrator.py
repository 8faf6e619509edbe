"""One push, integrated in steps of some 40 microseconds.

Bristles under every cell, a spring and damper at the pusher, a bed of springs below.

Bristles follow Dahl's model in two dimensions, ds/dt = v - |v| s / travel with force -limit s / travel, so that friction opposes the
motion once a cell has slid a few hundredths of a millimetre; it stores energy and gives less of it back, and never makes any. A step of
s is implicit, so that it is stable at any speed.

The table under the cells is a bed of equal springs on which the rigid base stands with heave, pitch and roll: the loads are a linear
function of the place in the base, and none is below zero. A cell without friction hangs above the table and bears nothing.

All kernels stand in this file, as numba does not notice that a kernel of another file changed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from push_ident_sim.engines.planar.laws import Laws

__all__ = ["bed_loads", "integrate"]

FloatArray = NDArray[np.float64]

_BED_TIME = 5e-3  # in which the bed gives way under a moment [s]
_BRISTLE_DAMPING = 1.0  # of a bristle that does not slide, share of critical damping
_FINGER_INERTIA = 0.02  # of a finger that turns: 20 g at half the square of its radius [kg]
_MAGNET_REACH, _MAGNET_X, _MAGNET_Y = 0.04, 0.03, -0.04  # [m]
_SPOT_REACH = 0.06  # [m]
_COLD_WAY = 0.02  # [m]
_GUST_RATE = 2.0 * np.pi * 1.5  # [rad/s]
_MOVING = 5e-3  # loose contents slide while the object is faster than this [m/s]
_LEAST = 0.05  # share of its friction that a cell keeps

_kernel: Any = njit(cache=True, error_model="numpy")


@_kernel
def bed_loads(place: FloatArray, bears: NDArray[np.bool_], weight: float, centre: FloatArray, plane: FloatArray, load: FloatArray) -> bool:
    """Loads [N] of cells on equal springs under a weight [N] whose centre lies at `centre` [m].

    Args:
        place: of the cells from the centre of mass [m], shape (n_cells, 2), object axes.
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
            x, y = place[i, 0], place[i, 1]
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


@_kernel
def _touch(
    normal_x: float, normal_y: float, px: float, py: float, gap: float, laws: Laws, mass: float, inertia: float, velocity: FloatArray,
    pusher_velocity: FloatArray, bend: float, finger: float, dt: float, force: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Force of one contact on the object at (px, py) from its centre of mass; adds (fx, fy, torque) to `force`, returns the bend and
    the finger's spin after the step."""
    arm_n = px * normal_y - py * normal_x
    tangent_x, tangent_y = -normal_y, normal_x
    arm_t = px * tangent_y - py * tangent_x
    slip_x = velocity[0] - velocity[2] * py - pusher_velocity[0]
    slip_y = velocity[1] + velocity[2] * px - pusher_velocity[1]
    approach = slip_x * normal_x + slip_y * normal_y
    effective = 1.0 / (1.0 / mass + arm_n * arm_n / inertia)
    press = -laws.contact_stiffness * gap + 2.0 * laws.damping_ratio * np.sqrt(laws.contact_stiffness * effective) * approach
    if press <= 0.0:
        return 0.0, finger
    # The finger's skin moves along the tangent at -spin times radius where the object is.
    slide = slip_x * tangent_x + slip_y * tangent_y + finger * laws.finger_radius
    limit = laws.pusher_friction * press
    effective_t = 1.0 / (1.0 / mass + arm_t * arm_t / inertia)
    finger_inertia = 0.5 * _FINGER_INERTIA * laws.finger_radius * laws.finger_radius
    if laws.finger_radius > 0.0:
        effective_t = 1.0 / (1.0 / effective_t + 2.0 / _FINGER_INERTIA)
    bend = (bend + dt * slide) / (1.0 + dt * abs(slide) / laws.contact_travel)
    stiffness = limit / laws.contact_travel
    held = max(0.0, 1.0 - abs(bend) / laws.contact_travel)
    drag = -stiffness * bend - _BRISTLE_DAMPING * 2.0 * np.sqrt(stiffness * effective_t) * held * slide
    drag = min(limit, max(-limit, drag))
    if laws.finger_radius > 0.0:
        finger += dt * drag * laws.finger_radius / finger_inertia
        brake = dt * laws.bearing_torque / finger_inertia
        finger = max(0.0, abs(finger) - brake) * np.sign(finger)
    fx, fy = -press * normal_x + drag * tangent_x, -press * normal_y + drag * tangent_y
    force[0] += fx
    force[1] += fy
    force[2] += px * fy - py * fx
    return bend, finger


@_kernel
def _push(
    outline: FloatArray, cos: float, sin: float, pose: FloatArray, velocity: FloatArray, pusher: FloatArray, pusher_velocity: FloatArray,
    laws: Laws, mass: float, inertia: float, bends: FloatArray, finger: float, dt: float, force: FloatArray,
) -> float:  # fmt: skip
    """Forces of a disc on a polygon (object axes, from the centre of mass): on faces it overlaps, and on corners between two of them."""
    n, reach = len(outline), laws.pusher_radius + laws.outline_offset
    dx, dy = pusher[0] - pose[0], pusher[1] - pose[1]
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
        place = 2 * j
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
                place = 2 * j + 1
        if not touches:
            bends[2 * j] = 0.0
            bends[2 * j + 1] = 0.0
            continue
        # The surface lies outside the outline by the offset.
        qx += laws.outline_offset * nx
        qy += laws.outline_offset * ny
        gap -= laws.outline_offset
        bends[4 * j + 1 - place] = 0.0
        bends[place], finger = _touch(
            cos * nx - sin * ny, sin * nx + cos * ny, cos * qx - sin * qy, sin * qx + cos * qy, gap, laws, mass, inertia, velocity,
            pusher_velocity, bends[place], finger, dt, force,
        )  # fmt: skip
    return finger


@_kernel
def _rub(
    place: FloatArray, load: FloatArray, friction: FloatArray, cos: float, sin: float, pose: FloatArray, velocity: FloatArray,
    bend: FloatArray, way: FloatArray, laws: Laws, mass: float, weight: float, dt: float, force: FloatArray,
) -> None:  # fmt: skip
    """Friction of the table on all cells; adds (fx, fy, torque) to `force`."""
    # Both grains in table axes: one of the base turns at twice the yaw.
    cos2, sin2 = cos * cos - sin * sin, 2.0 * sin * cos
    e1 = laws.table_e1 + cos2 * laws.base_e1 - sin2 * laws.base_e2
    e2 = laws.table_e2 + sin2 * laws.base_e1 + cos2 * laws.base_e2
    for i in range(len(load)):
        rx, ry = cos * place[i, 0] - sin * place[i, 1], sin * place[i, 0] + cos * place[i, 1]
        vx, vy = velocity[0] - velocity[2] * ry, velocity[1] + velocity[2] * rx
        speed = np.sqrt(vx * vx + vy * vy)
        x, y = pose[0] + rx, pose[1] + ry
        factor = laws.level + laws.gradient_x * x + laws.gradient_y * y
        if laws.log_speed != 0.0:
            factor *= 1.0 + laws.log_speed * np.log((speed + 0.01) / 0.11)
        if laws.stribeck != 0.0:
            factor *= 1.0 + laws.stribeck * np.exp(-((speed / laws.stribeck_speed) ** 2))
        if laws.greasy != 0.0:
            factor *= 1.0 - laws.greasy * np.exp(-0.5 * (x * x + y * y) / _SPOT_REACH**2)
        if laws.heating != 0.0:
            way[i] += dt * speed
            factor *= 1.0 - laws.heating * (1.0 - np.exp(-way[i] / _COLD_WAY))
        limit = load[i] * friction[i] * max(_LEAST, factor)
        shrink = 1.0 / (1.0 + dt * speed / laws.travel)
        bend[i, 0] = (bend[i, 0] + dt * vx) * shrink
        bend[i, 1] = (bend[i, 1] + dt * vy) * shrink
        sx, sy = bend[i, 0] / laws.travel, bend[i, 1] / laws.travel
        held = max(0.0, 1.0 - np.sqrt(sx * sx + sy * sy))
        if held > 0.0 and limit > 0.0:
            damping = _BRISTLE_DAMPING * 2.0 * np.sqrt(mass * load[i] / (weight * limit * laws.travel)) * held
            sx += damping * vx
            sy += damping * vy
            # Spring and damper of a bristle together never hold more than it bears.
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
    force[1] += laws.gust * np.sin(_GUST_RATE * time + laws.gust_phase)
    if laws.magnet != 0.0:
        dx, dy = (_MAGNET_X - pose[0]) / _MAGNET_REACH, (_MAGNET_Y - pose[1]) / _MAGNET_REACH
        pull = laws.magnet * np.exp(0.5 - 0.5 * (dx * dx + dy * dy))
        force[0] += pull * dx
        force[1] += pull * dy


@_kernel
def integrate(
    laws: Laws,
    place: FloatArray,
    friction: FloatArray,
    mass: float,
    inertia: float,
    outline: FloatArray,
    first: FloatArray,
    first_velocity: FloatArray,
    path_time: FloatArray,
    path: FloatArray,
    n_rows: int,
    row_time: float,
    n_inner: int,
    rest_speed: float,
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """One push from `first` until the path is over and the object rests.

    Args:
        laws: that hold.
        place: of the cells from the centre of mass [m], shape (n_cells, 2), object axes.
        friction: of the cells, shape (n_cells,).
        mass: [kg].
        inertia: about the centre of mass [kg m^2].
        outline: from the centre of mass [m], shape (n_vertices, 2), object axes, counter-clockwise.
        first: of the centre of mass (x, y) and the yaw, shape (3,), table axes.
        first_velocity: of them, shape (3,).
        path_time: [s], shape (n_samples,), from 0.
        path: of the pusher's axis [m], shape (n_samples, 2); beyond the last sample it stands.
        n_rows: at most so many are returned.
        row_time: between two rows [s].
        n_inner: steps in that time.
        rest_speed: [m/s]; ten times it in rad/s.

    Returns:
        Rows of pose, shape (n, 3), of the pusher's place, shape (n, 2), of its mean force in the row before, shape (n, 2), and whether the
        object stood all the time.
    """
    dt = row_time / n_inner
    weight = mass * laws.gravity
    poses, places, forces = np.empty((n_rows, 3)), np.empty((n_rows, 2)), np.zeros((n_rows, 2))
    pose, velocity, pusher = first.copy(), first_velocity.copy(), path[0].copy()
    bend, way, bends = np.zeros((len(friction), 2)), np.zeros(len(friction)), np.zeros(2 * len(outline))
    load, plane, lean, contents = np.empty(len(friction)), np.zeros(3), np.zeros(2), np.zeros(2)
    bears = friction > 0.0
    plane[0] = weight / len(friction)
    shifts = laws.height != 0.0 or laws.contents != 0.0
    stands = bed_loads(place, bears, weight, lean, plane, load)
    contact, rubbed, force, pusher_velocity = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(2)
    finger, sample, count, still = 0.0, 0, 1, 0
    poses[0], places[0] = pose, pusher
    for row in range(1, n_rows):
        if not stands:
            break
        for inner in range(n_inner):
            time = ((row - 1) * n_inner + inner) * dt
            while sample + 2 < len(path_time) and path_time[sample + 1] <= time:
                sample += 1
            if time < path_time[-1]:
                pusher_velocity[:] = (path[sample + 1] - path[sample]) / (path_time[sample + 1] - path_time[sample])
                pusher[:] = path[sample] + (time - path_time[sample]) * pusher_velocity
            else:
                pusher_velocity[:] = 0.0
                pusher[:] = path[-1]
            cos, sin = np.cos(pose[2]), np.sin(pose[2])
            contact[:] = 0.0
            finger = _push(outline, cos, sin, pose, velocity, pusher, pusher_velocity, laws, mass, inertia, bends, finger, dt, contact)
            if shifts:
                share = dt / _BED_TIME
                # Pushed at the height of its centre of mass, the object leans by the moment of the table's friction alone.
                lean[0] -= share * (laws.height * (cos * rubbed[0] + sin * rubbed[1]) / weight + lean[0])
                lean[1] -= share * (laws.height * (cos * rubbed[1] - sin * rubbed[0]) / weight + lean[1])
                speed = np.sqrt(velocity[0] ** 2 + velocity[1] ** 2)
                if laws.contents != 0.0 and speed > _MOVING:
                    share = dt / (dt + laws.contents_time)
                    contents[0] += share * (-laws.contents * (cos * velocity[0] + sin * velocity[1]) / speed - contents[0])
                    contents[1] += share * (-laws.contents * (cos * velocity[1] - sin * velocity[0]) / speed - contents[1])
                stands = bed_loads(place, bears, weight, lean + contents, plane, load)
            rubbed[:] = 0.0
            _rub(place, load, friction, cos, sin, pose, velocity, bend, way, laws, mass, weight, dt, rubbed)
            force[:] = contact + rubbed
            _pull(pose, time, laws, mass, force)
            velocity[0] += dt * force[0] / mass
            velocity[1] += dt * force[1] / mass
            velocity[2] += dt * force[2] / inertia
            pose += dt * velocity
            forces[row, 0] += contact[0] / n_inner
            forces[row, 1] += contact[1] / n_inner
        poses[row], places[row] = pose, pusher
        count = row + 1
        rests = max(abs(velocity[0]), abs(velocity[1])) < rest_speed and abs(velocity[2]) < 10.0 * rest_speed
        still = still + 1 if rests else 0
        if row * row_time >= path_time[-1] and still >= 30:
            break
    return poses[:count], places[:count], forces[:count], stands
