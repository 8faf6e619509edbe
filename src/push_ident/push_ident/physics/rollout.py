"""A whole push, step by step (compiled).

A step n:

    locate the pusher in the object frame                        _locate_pusher
    find the contacts within reach                               contact.find_contacts
    solve for the twist after the step and the impulses          step.step or pyramid.pyramid_step
    where a derivative is wanted, keep the block of the step     step_derivative.step_sensitivity
    advance the state: x+ = x + dt v, v = R(yaw) u
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from push_ident.physics.active_effects import N_SUMS, ActiveEffects
from push_ident.physics.contact import REACH, Field, find_contacts, max_candidates
from push_ident.physics.contact_rows import Rebound, RelativePusher, add_rebound, contact_rows, new_relative_pusher, shift_surface
from push_ident.physics.kernel import kernel
from push_ident.physics.modes import MAX_CONTACTS, N_IMPULSES, SECOND, Mode, Row, StepContacts, StepGeometry, second_row, tangent_row
from push_ident.physics.overhang import Overhang, share_loads
from push_ident.physics.pyramid import new_pyramid_scratch, pyramid_friction, pyramid_step
from push_ident.physics.step import TableForces, new_step_scratch, step
from push_ident.physics.step_derivative import EffectDrive, StepBalance, new_effect_drive, new_sensitivity_scratch, step_sensitivity
from push_ident.physics.support import SupportImpulse, add_skew, support_friction
from push_ident.physics.table import (
    TableScratch,
    fill_inputs,
    friction_demand,
    new_table_scratch,
    sum_limits,
    table_action,
    table_sensitivity,
    update_memory,
)
from push_ident.physics.tape import Event, Frames, Tape
from push_ident.types import Float64Array


class Push(NamedTuple):
    """A push, in the arrays that the kernels take."""

    pose: Float64Array
    """First pose of the object frame in the table frame, shape (3,)."""
    pusher: Float64Array
    """Pose (x, y, yaw) of the pusher at the steps' ends, shape (n_steps + 1, 3), table frame."""
    corners: Float64Array
    """Of the pusher's core, counter-clockwise [m], shape (n_corners, 2), pusher frame; one point for a disc."""
    radius: float
    """Of the rounding of the pusher [m]."""
    outline: Float64Array
    """Of the object [m], shape (n_vertices, 2), object frame, counter-clockwise."""
    arms: Float64Array
    """Cell centres from the centre of mass [m], shape (2, n_cells), object axes."""
    limit: Float64Array
    """Sliding friction of each cell [N], shape (n_cells,)."""
    centre: Float64Array
    """Of mass [m], shape (2,), object frame."""
    inertia: Float64Array
    """(m, m, I) about the centre of mass [kg, kg, kg m^2], shape (3,)."""
    mu: float
    """Friction coefficient of the pusher."""
    surface: float = 0.0
    """How far the surface lies outside the outline [m], for rollouts without a derivative; with one, an effect says it."""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the centre of mass at the start (vx, vy, yaw rate) [m/s, m/s, rad/s], table frame."""
    separate: bool = False
    """The corners are two fingers."""


class Numerics(NamedTuple):
    """How a push is simulated."""

    dt: Float64Array
    """Length of each step [s], shape (n_steps,)."""
    eps: float
    """Smoothing speed of the circular cone [m/s]."""
    diamond: bool
    """The paper's friction pyramid instead of the circular cone."""
    quasi_static: bool
    """Without inertia."""
    resolved: bool
    """Resolve the first contact within its step, and coasting to second order."""


class EffectScratch(NamedTuple):
    """Space that effects work in."""

    table: TableScratch
    forces: TableForces
    drive: EffectDrive


def new_effect_scratch(n_cells: int, effects: ActiveEffects) -> EffectScratch:
    """Scratch space of the effects in `rollout`."""
    n_memory, n_values, on_table = effects.n_memory, len(effects.values), bool(np.any(effects.on_table))
    drive = new_effect_drive(n_memory, n_values, N_SUMS if effects.shifts else 0, effects.vertices)
    drive.touches[n_memory : n_memory + n_values] |= effects.moves
    if effects.offset >= 0:
        drive.touches[n_memory + effects.offset] = True
    if effects.restitution >= 0:
        drive.touches[n_memory + effects.restitution] = True
        drive.touches[effects.rebound : effects.rebound + 3] = True
    table = new_table_scratch(n_memory, n_values, n_cells if on_table else 0)
    return EffectScratch(table, TableForces(np.zeros(2), np.zeros(3)), drive)


@kernel
def _emit_pose(state: Float64Array, cos: float, sin: float, centre: Float64Array, weight: float, pose: Float64Array) -> None:
    """Add `weight` times the pose of the object frame to that of one frame."""
    pose[0] += weight * (state[0] - (cos * centre[0] - sin * centre[1]))
    pose[1] += weight * (state[1] - (sin * centre[0] + cos * centre[1]))
    pose[2] += weight * state[2]


@kernel
def _locate_pusher(push: Push, n: int, geometry: StepGeometry, state: Float64Array, relative: RelativePusher) -> float:
    """The pusher during step n in the object frame: fills `relative`. Returns the greatest speed of any of its points [m/s]."""
    pusher, shape, dt, cos, sin = push.pusher, push.corners, geometry.dt, geometry.heading[0], geometry.heading[1]
    centre, velocity, corners = relative.centre, relative.velocity, relative.corners
    px, py = pusher[n, 0] - state[0], pusher[n, 1] - state[1]
    centre[0], centre[1] = cos * px + sin * py + push.centre[0], -sin * px + cos * py + push.centre[1]
    vx, vy = (pusher[n + 1, 0] - pusher[n, 0]) / dt, (pusher[n + 1, 1] - pusher[n, 1]) / dt
    velocity[0], velocity[1] = cos * vx + sin * vy, -sin * vx + cos * vy
    spin = (pusher[n + 1, 2] - pusher[n, 2]) / dt
    relative.spin[0] = spin
    cos_relative, sin_relative = math.cos(pusher[n, 2] - state[2]), math.sin(pusher[n, 2] - state[2])
    extent = 0.0
    for j in range(shape.shape[0]):
        corners[j, 0] = centre[0] + cos_relative * shape[j, 0] - sin_relative * shape[j, 1]
        corners[j, 1] = centre[1] + sin_relative * shape[j, 0] + cos_relative * shape[j, 1]
        extent = max(extent, math.hypot(shape[j, 0], shape[j, 1]) + push.radius)
    return math.hypot(vx, vy) + abs(spin) * extent


@kernel
def _rebound(effects: ActiveEffects, memory: Float64Array, code: int, heading: Float64Array, before: Float64Array) -> Rebound:
    """State of the step before, whose mode was `code`, for an elastic impact; fills the twist `before` it."""
    if effects.restitution < 0:
        return Rebound(False, 0.0, before)
    at, cos, sin = effects.rebound, heading[0], heading[1]
    before[0], before[1] = cos * memory[at] + sin * memory[at + 1], -sin * memory[at] + cos * memory[at + 1]
    before[2] = memory[at + 2]
    return Rebound(code >= 4, effects.values[effects.restitution], before)


@kernel
def _drive_contacts(effects: ActiveEffects, rebound: Rebound, n: int, geometry: StepGeometry, drive: EffectDrive) -> EffectDrive:
    """Derivatives of the pusher and of the contacts in step n by the effects on them."""
    m, dt, cos, sin = effects.n_memory, geometry.dt, geometry.heading[0], geometry.heading[1]
    for k in range(effects.values.shape[0]):
        if effects.moves[k]:
            now, then = effects.d_path[k, n], effects.d_path[k, n + 1]
            vx, vy = (then[0] - now[0]) / dt, (then[1] - now[1]) / dt
            drive.pusher[m + k, 0], drive.pusher[m + k, 1] = cos * now[0] + sin * now[1], -sin * now[0] + cos * now[1]
            drive.velocity[m + k, 0], drive.velocity[m + k, 1] = cos * vx + sin * vy, -sin * vx + cos * vy
            drive.angle[m + k], drive.spin[m + k] = now[2], (then[2] - now[2]) / dt
    offset = 0.0
    if effects.offset >= 0:
        offset = effects.values[effects.offset]
        drive.by_offset[m + effects.offset] = 1.0
    if effects.restitution >= 0:
        drive.restitution[m + effects.restitution] = 1.0
        at = effects.rebound
        drive.twist[at, 0], drive.twist[at, 1] = cos, -sin
        drive.twist[at + 1, 0], drive.twist[at + 1, 1] = sin, cos
        drive.twist[at + 2, 2] = 1.0
    return EffectDrive(
        offset, rebound, drive.pusher, drive.angle, drive.velocity, drive.spin, drive.by_offset, drive.restitution, drive.twist,
        drive.seeds, drive.touches, drive.vertices, drive.no_vertices,
    )  # fmt: skip


@kernel
def _force_of_pusher(contacts: StepContacts, code: int, impulse: Float64Array, geometry: StepGeometry, force: Float64Array) -> None:
    """Force of the pusher on the object in a step, table axes: fills `force` [N], shape (2,)."""
    rows, cos, sin, dt = contacts.rows, geometry.heading[0], geometry.heading[1], geometry.dt
    fx = fy = 0.0
    for k in range(contacts.number):
        fx += rows[k, 0] * impulse[k]
        fy += rows[k, 1] * impulse[k]
    tangent = tangent_row(code, rows)
    fx += rows[tangent, 0] * impulse[MAX_CONTACTS]
    fy += rows[tangent, 1] * impulse[MAX_CONTACTS]
    if impulse[SECOND] != 0.0:
        second = second_row(rows)
        fx += rows[second, 0] * impulse[SECOND]
        fy += rows[second, 1] * impulse[SECOND]
    force[0], force[1] = (cos * fx - sin * fy) / dt, (sin * fx + cos * fy) / dt


@kernel
def rollout(
    push: Push,
    numerics: Numerics,
    effects: ActiveEffects | None,
    edge: Overhang | None,
    frames: Frames,
    poses: Float64Array,
    force: Float64Array,
    tape: Tape,
    scratch: Any,
) -> tuple[int, int]:
    """Simulate one push.

    Kept whole, since effects that are absent must vanish at compilation, and what the stages share is all of its state.

    Args:
        push: the push.
        numerics: how.
        effects: effects beside the base model; None compiles to the base model only, at its speed.
        edge: of the table, where the object may overhang it; then there is no derivative. Effects change the friction of the loads that
            the cells on the table bear.
        frames: when to report poses.
        poses: filled with the poses at the frames, shape (n_frames, 3), table frame.
        force: filled with the pusher's force on the object at each step [N], shape (n_steps, 2), table frame.
        tape: filled for the derivative; of no steps where none is wanted.
        scratch: `EffectScratch`; None without effects.

    Returns:
        The step that did not converge, or -1; and the total number of iterations.
    """
    eps, derive = numerics.eps, tape.event.shape[0] > 0
    # Without inertia, there are neither impacts nor coasting.
    resolved = numerics.resolved and not numerics.quasi_static
    centre, arms, limit = push.centre, push.arms, push.limit
    rows, features = np.zeros((2 * MAX_CONTACTS, Row.WIDTH)), np.zeros((MAX_CONTACTS, Field.WIDTH))
    candidates = np.zeros((max_candidates(push.corners.shape[0], push.outline.shape[0]), Field.WIDTH))
    pusher, workspace = new_relative_pusher(push.corners.shape[0], push.separate), new_step_scratch()
    cells = new_pyramid_scratch(arms.shape[1] if numerics.diamond else 0)
    sensitivity = new_sensitivity_scratch(tape.block.shape[2], workspace.mode)
    inertia = np.zeros(3) if numerics.quasi_static else push.inertia
    reach_of_body = math.sqrt(push.inertia[2] / push.inertia[0])
    cos, sin = math.cos(push.pose[2]), math.sin(push.pose[2])
    state, heading = np.zeros(6), np.zeros(2)
    state[0] = push.pose[0] + cos * centre[0] - sin * centre[1]
    state[1] = push.pose[1] + sin * centre[0] + cos * centre[1]
    state[2] = push.pose[2]
    state[3], state[4], state[5] = push.velocity
    poses[:] = 0.0
    force[:] = 0.0
    impulse, twist = np.zeros(N_IMPULSES), np.zeros(3)
    friction, by_yaw, stiffness, stuck = np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 4))
    support = SupportImpulse(friction, stiffness, by_yaw, stuck)
    offset, is_pulled = push.surface, False
    borne = push.limit
    if edge is not None:
        borne, loaded = push.limit.copy(), np.ones(len(push.limit))
        limit = borne
    no_reaction = np.zeros((0, 0))
    forces: Any = None
    drive: Any = None
    if effects is not None:
        table, forces, drive = scratch.table, scratch.forces, scratch.drive
        memory, before, no_derivative = np.zeros(effects.n_memory), np.zeros(3), np.zeros((0, 0))
        acts_on_table = effects.loads or effects.skews or effects.pulls
        offset += effects.values[effects.offset] if effects.offset >= 0 else 0.0
        # An object under a pull is idle only if friction keeps it at rest; without inertia, friction always does.
        is_pulled = effects.pulls and not numerics.quasi_static
        if effects.loads:
            limit = table.limit
        if effects.shifts:
            sum_limits(effects, arms, push.limit, table.inputs)
    radius = push.radius + offset
    n_steps, n_frames = push.pusher.shape[0] - 1, frames.step.shape[0]
    frame = iterations = code = 0
    for n in range(n_steps):
        heading[0], heading[1] = cos, sin
        dt = numerics.dt[n]
        coasts = not numerics.quasi_static and (state[3] != 0.0 or state[4] != 0.0 or state[5] != 0.0)
        geometry = StepGeometry(arms, limit, inertia, reach_of_body, centre, heading, dt, resolved and not coasts)
        begin = frame
        while frame < n_frames and frames.step[frame] == n:
            _emit_pose(state, cos, sin, centre, 1.0 - frames.fraction[frame], poses[frame])
            frame += 1

        speed = _locate_pusher(push, n, geometry, state, pusher)
        n_contacts = find_contacts(pusher.corners, radius, push.outline, REACH + speed * dt, candidates, features, push.separate)
        if offset != 0.0:
            shift_surface(features, n_contacts, offset)
        if edge is not None:
            # An object that falls keeps its last loads: whoever asks sees by its pose where its centre of mass is.
            share_loads(edge, arms, state, cos, sin, loaded)
            for i in range(borne.shape[0]):
                borne[i] = loaded[i] * push.limit[i]
            if effects is not None and effects.shifts:
                sum_limits(effects, arms, borne, table.inputs)
        if effects is not None:
            fill_inputs(state, push.inertia[0], centre, memory, effects.values, table.inputs)

        untouched = n_contacts == 0 or (features[0, 0] >= -1e-9 and (speed == 0.0 or features[0, 0] > speed * dt))
        demand = 0.0
        if effects is not None and is_pulled:
            table_action(effects, centre, arms, table)
            demand = friction_demand(effects, arms, borne, table)
        event = Event.IDLE if untouched and not coasts and demand < 1.0 else Event.MOVED
        if event == Event.IDLE:
            workspace.rate[:] = 0.0
        if event != Event.IDLE:
            twist[0], twist[1], twist[2] = cos * state[3] + sin * state[4], -sin * state[3] + cos * state[4], state[5]
            contacts = StepContacts(rows, n_contacts, push.mu)
            for k in range(n_contacts):
                contact_rows(features[k], k, geometry, pusher, features[0], rows)
            if effects is not None:
                rebound = _rebound(effects, memory, code, heading, before)
                for k in range(n_contacts):
                    add_rebound(features[k], k, rebound, dt, rows)
                if acts_on_table:
                    if not is_pulled:
                        table_action(effects, centre, arms, table)
                    forces.skew[:], forces.pull[:] = table.result[:2], table.result[2:]
                if effects.loads:
                    for i in range(limit.shape[0]):
                        limit[i] = table.factor[i] * borne[i]
            if numerics.diamond:
                code, used = pyramid_step(twist, geometry, contacts, code, impulse, workspace, cells)
            else:
                code, used = step(twist, geometry, contacts, eps, code, impulse, workspace, forces)
            iterations += used
            if code == Mode.NONE:
                return n, iterations
            _force_of_pusher(contacts, code, impulse, geometry, force[n])
            # Without contact an object is at rest below a thousandth of the smoothing speed; under a pull it would creep at `demand` of it.
            creep = max(1e-3, demand) * eps if demand < 1.0 else 0.0
            if code == Mode.FREE and max(math.hypot(twist[0], twist[1]), abs(twist[2]) * reach_of_body) < creep:
                event = Event.CAME_TO_REST
            if derive:
                if numerics.diamond:
                    pyramid_friction(twist, geometry, cells, support)
                else:
                    support_friction(twist, arms, limit, eps, True, friction, stiffness)
                    if effects is not None and effects.skews:
                        add_skew(twist, arms, limit, forces.skew, eps, True, friction, stiffness)
                    for i in range(3):
                        friction[i] *= dt
                        for j in range(3):
                            stiffness[i, j] *= dt
                if effects is not None:
                    drive = _drive_contacts(effects, rebound, n, geometry, drive)
                    if acts_on_table:
                        table_sensitivity(effects, twist, geometry, push.limit, forces.skew, eps, table, drive.seeds)
                    if effects.loads:
                        tape.factor[n] = table.factor
                    if effects.skews:
                        tape.skew[n] = forces.skew
                balance = StepBalance(twist, workspace.old, code, impulse, support)
                reaction = tape.reaction[n] if tape.reaction.shape[0] > 0 else no_reaction
                if not step_sensitivity(balance, geometry, contacts, features, pusher, drive, sensitivity, tape.block[n], reaction):
                    return n, iterations
                tape.twist[n] = twist
            vx, vy = cos * twist[0] - sin * twist[1], sin * twist[0] + cos * twist[1]
            if resolved and coasts and code == Mode.FREE:
                # Friction slows the object evenly: the mean velocity is exact to second order.
                state[0] += 0.5 * dt * (state[3] + vx)
                state[1] += 0.5 * dt * (state[4] + vy)
                state[2] += 0.5 * dt * (state[5] + twist[2])
                if derive:
                    tape.coasting[n] = 0.5
            else:
                state[0] += dt * vx
                state[1] += dt * vy
                state[2] += dt * twist[2]
            state[3], state[4], state[5] = vx, vy, twist[2]
        if effects is not None and effects.n_memory > 0:
            update_memory(effects, centre, dt, derive, memory, tape.memory[n] if derive else no_derivative, table)
        if derive:
            tape.event[n] = event
            tape.heading[n, 0], tape.heading[n, 1] = cos, sin
        if event == Event.CAME_TO_REST or (event == Event.IDLE and numerics.quasi_static):
            state[3:] = 0.0
        cos, sin = math.cos(state[2]), math.sin(state[2])
        for j in range(begin, frame):
            _emit_pose(state, cos, sin, centre, frames.fraction[j], poses[j])
    if derive:
        tape.heading[n_steps, 0], tape.heading[n_steps, 1] = cos, sin
    return -1, iterations
