"""The derivatives of the steps of a push, chained over all of them (compiled): forward to the Jacobian and to the response to small
forces in any step, backward to a gradient.

Forward, each step carries the derivative of the state (`tape.py`),

    ds+ = J ds + K dp,      J, K from the block [A B C] of the step,

a part of the columns at a time. Backward, the adjoint variables pass through the transposed blocks: J' and K'. The kernels stay long
where their parts would share all of their arrays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from push_ident.physics.active_effects import N_FIXED_INPUTS
from push_ident.physics.kernel import fast_kernel, kernel
from push_ident.physics.support import Cone, unit_friction
from push_ident.physics.tape import N_BODY_PARAMETERS, Block, Event, Frames, Param, Tape
from push_ident.types import Float64Array


class Chain(NamedTuple):
    """A rollout, ready to be differentiated."""

    tape: Tape
    centre: Float64Array
    """Of mass [m], shape (2,), object frame."""
    arms: Float64Array
    """Cell centres from the centre of mass [m], shape (2, n_cells)."""
    diamond: bool
    """Law of the support friction, with `eps` (`support.py`)."""
    eps: float
    """[m/s]"""
    dt: Float64Array
    """Length of each step [s], shape (n_steps,)."""
    frames: Frames
    force: Float64Array
    """Of the pusher on the object in each step [N], shape (n_steps, 2), table frame."""


class _Columns(NamedTuple):
    """A part of the columns of the Jacobian."""

    first: int
    last: int
    arms: Float64Array
    """Of the cells among them, shape (2, n)."""


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
    """Add friction that depends on the direction of motion to `_limit_columns` of the circular cone."""
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
    chain: Chain, n: int, block: Float64Array, columns: _Columns, n_values: int, memory: Float64Array, du: Float64Array
) -> None:
    """Let effects change what `_direct_columns` fills."""
    tape, arms, eps, dt = chain.tape, chain.arms, chain.eps, chain.dt[n]
    column_arms, first, last = columns.arms, columns.first, columns.last
    n_memory = tape.memory.shape[1]
    n_body = max(0, N_BODY_PARAMETERS - first)
    if tape.skew.shape[0] > 0:
        _add_skew_columns(block, tape.twist[n], column_arms, tape.skew[n], eps, dt, du[:, n_body:])
    if tape.factor.shape[1] > 0:
        factor = tape.factor[n, first + n_body - N_BODY_PARAMETERS :]
        for i in range(3):
            for p in range(column_arms.shape[1]):
                du[i, n_body + p] *= factor[p]
    first_value = N_BODY_PARAMETERS + arms.shape[1]
    first_sum = Block.EFFECTS + n_memory + n_values
    if block.shape[1] > first_sum:
        x, y = column_arms[0], column_arms[1]
        for i in range(3):
            b = block[i, first_sum:]
            for p in range(column_arms.shape[1]):
                du[i, n_body + p] += b[0] + (b[1] + b[3] * x[p] + b[4] * y[p]) * x[p] + (b[2] + b[5] * y[p]) * y[p]
    for i in range(3):
        for p in range(max(first, first_value), last):
            du[i, p - first] = block[i, Block.EFFECTS + n_memory + p - first_value]
        if n_memory > 0 and first == 0:
            du[i, : Param.MASS] = 0.0
        for j in range(n_memory):
            for p in range(last - first):
                du[i, p] += block[i, Block.EFFECTS + j] * memory[j, p]


@kernel
def _direct_columns(
    chain: Chain, n: int, block: Float64Array, columns: _Columns, n_values: int, memory: Float64Array, du: Float64Array
) -> None:
    """The part of the derivative of the twist after step n, or of the pusher's impulse in it, that does not come from the state.

    Args:
        chain: the rollout.
        n: the step.
        block: that of the step, or its reaction (`tape.py`).
        columns: the columns that are filled.
        n_values: number of values of the effects.
        memory: derivative of the memory at the start of the step.
        du: filled, shape (3, n).
    """
    n_body = max(0, N_BODY_PARAMETERS - columns.first)
    if columns.first == 0:
        for i in range(3):
            for p in range(Param.MASS, N_BODY_PARAMETERS):
                du[i, p] = block[i, Block.MASS + p - Param.MASS]
    cos, sin = chain.tape.heading[n, 0], chain.tape.heading[n, 1]
    _limit_columns(block, chain.tape.twist[n], columns.arms, Cone(chain.diamond, chain.eps, cos, sin), chain.dt[n], du[:, n_body:])
    if n_values > 0:
        _effect_columns(chain, n, block, columns, n_values, memory, du)


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
                memory[j, Param.MASS + i] += g[6 + i]
        for p in range(max(first, first_value), last):
            memory[j, p - first] += g[N_FIXED_INPUTS + n_memory + p - first_value]


@fast_kernel
def _advance(s: Float64Array, du: Float64Array, d: Float64Array, twist: Float64Array, cos: float, sin: float, dt: float) -> None:
    """Carry the derivative of the state, shape (6, n), over one step; `du` is the part of the twist that does not come from the state,
    and `dt` the time for which the body moves at the new velocity."""
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
def _emit_state(s: Float64Array, cos: float, sin: float, centre: Float64Array, weight: float, by_pose: Float64Array) -> None:
    """Add to `by_pose`, shape (3, n), what the derivative `s` of the state does to the pose of the object frame."""
    rx, ry = cos * centre[0] - sin * centre[1], sin * centre[0] + cos * centre[1]
    for p in range(by_pose.shape[1]):
        by_pose[0, p] += weight * (s[0, p] + ry * s[2, p])
        by_pose[1, p] += weight * (s[1, p] - rx * s[2, p])
        by_pose[2, p] += weight * s[2, p]


@kernel
def _emit(
    s: Float64Array, cos: float, sin: float, centre: Float64Array, weight: float, first: int, last: int, jacobian: Float64Array
) -> None:
    """Add `weight` times the derivative of the pose of the object frame, columns `first` to `last`, to that of one frame."""
    _emit_state(s, cos, sin, centre, weight, jacobian[:, first:last])
    if first == 0:
        jacobian[0, Param.CENTRE] -= weight * cos
        jacobian[0, Param.CENTRE + 1] += weight * sin
        jacobian[1, Param.CENTRE] -= weight * sin
        jacobian[1, Param.CENTRE + 1] -= weight * cos


@kernel
def _add_impulse(chain: Chain, n: int, s: Float64Array, direct: Float64Array, total: Float64Array) -> None:
    """Add the pusher's impulse in step n, table axes, to the derivative `total` of their sum, shape (2, n).

    Args:
        chain: the rollout.
        n: the step.
        s: derivative of the state at its start, shape (6, n).
        direct: what does not come from the state, as from `_direct_columns`.
        total: changed.
    """
    r, cos, sin = chain.tape.reaction[n], chain.tape.heading[n, 0], chain.tape.heading[n, 1]
    x, y = chain.dt[n] * chain.force[n, 0], chain.dt[n] * chain.force[n, 1]
    for p in range(s.shape[1]):
        along, across = direct[0, p], direct[1, p]
        for j in range(6):
            along += r[0, Block.STATE + j] * s[j, p]
            across += r[1, Block.STATE + j] * s[j, p]
        total[0, p] += cos * along - sin * across - y * s[2, p]
        total[1, p] += sin * along + cos * across + x * s[2, p]


@kernel
def chain_forward(chain: Chain, jacobian: Float64Array, impulses: Frames, by_impulse: Float64Array) -> None:
    """Derivative of the poses at the frames, and of the pusher's impulse until other times, with respect to all parameters.

    Args:
        chain: the rollout; with reactions where impulses are wanted.
        jacobian: filled, shape (n_frames, 3, 8 + n_cells + n_values), columns: `Param`.
        impulses: when the impulse is wanted; of no frames where it is not.
        by_impulse: filled with the derivative of the impulse from the start on, table axes, shape (n_impulses, 2, as `jacobian`).
    """
    tape, centre, arms = chain.tape, chain.centre, chain.arms
    frame_step, frame_fraction = chain.frames.step, chain.frames.fraction
    n_impulses = impulses.step.shape[0]
    n_parameters = jacobian.shape[2]
    n_frames = frame_step.shape[0]
    n_memory = tape.memory.shape[1]
    n_values = n_parameters - N_BODY_PARAMETERS - arms.shape[1]
    jacobian[:] = 0.0
    by_impulse[:] = 0.0
    chunk = 256  # columns carried at a time, so that they stay in the cache
    for first in range(0, n_parameters, chunk):
        last = min(first + chunk, n_parameters)
        n_body = max(0, N_BODY_PARAMETERS - first)
        column_arms = arms[:, first + n_body - N_BODY_PARAMETERS : last - N_BODY_PARAMETERS]
        columns = _Columns(first, last, column_arms)
        s = np.zeros((6, last - first))
        du = np.zeros((3, last - first))
        velocity = np.zeros((3, last - first))
        memory = np.zeros((n_memory, last - first))
        direct, total = np.zeros((3, last - first)), np.zeros((2, last - first))
        if first == 0:
            cos, sin = tape.heading[0, 0], tape.heading[0, 1]
            s[0, 0], s[1, 1], s[2, 2] = 1.0, 1.0, 1.0
            s[0, 2], s[1, 2] = -(sin * centre[0] + cos * centre[1]), cos * centre[0] - sin * centre[1]
            s[0, Param.CENTRE], s[0, Param.CENTRE + 1] = cos, -sin
            s[1, Param.CENTRE], s[1, Param.CENTRE + 1] = sin, cos
        frame = impulse = 0
        for n in range(tape.event.shape[0]):
            cos, sin, dt = tape.heading[n, 0], tape.heading[n, 1], chain.dt[n]
            begin, begin_impulse = frame, impulse
            while frame < n_frames and frame_step[frame] == n:
                _emit(s, cos, sin, centre, 1.0 - frame_fraction[frame], first, last, jacobian[frame])
                frame += 1
            while impulse < n_impulses and impulses.step[impulse] == n:
                by_impulse[impulse, :, first:last] = (1.0 - impulses.fraction[impulse]) * total
                impulse += 1
            if tape.event[n] != Event.IDLE:
                _direct_columns(chain, n, tape.block[n], columns, n_values, memory, du)
                if n_impulses > 0 and (chain.force[n, 0] != 0.0 or chain.force[n, 1] != 0.0):
                    _direct_columns(chain, n, tape.reaction[n], columns, n_values, memory, direct)
                    _add_impulse(chain, n, s, direct, total)
            if n_memory > 0:
                _advance_memory(tape.memory[n], s, first, last, arms.shape[1], memory)
            if tape.event[n] != Event.IDLE:
                before = tape.coasting[n]
                if before > 0.0:
                    velocity[:] = s[3:]
                _advance(s, du, tape.block[n], tape.twist[n], cos, sin, (1.0 - before) * dt)
                if before > 0.0:
                    for i in range(3):
                        for p in range(last - first):
                            s[i, p] += before * dt * velocity[i, p]
            if tape.event[n] != Event.MOVED:
                s[3:] = 0.0
            for j in range(begin, frame):
                _emit(s, tape.heading[n + 1, 0], tape.heading[n + 1, 1], centre, frame_fraction[j], first, last, jacobian[j])
            for j in range(begin_impulse, impulse):
                by_impulse[j, :, first:last] += impulses.fraction[j] * total


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
    gradient[Param.CENTRE] -= cos * gx + sin * gy
    gradient[Param.CENTRE + 1] += sin * gx - cos * gy


@kernel
def chain_backward(chain: Chain, by_pose: Float64Array, gradient: Float64Array) -> None:
    """Gradient of a loss of the poses with respect to all parameters: the transpose of `chain_forward`, at the cost of one pass.

    Args:
        chain: the rollout.
        by_pose: d loss / d pose at the frames, shape (n_frames, 3).
        gradient: filled, shape (8 + n_cells + n_values,), entries: `Param`.
    """
    tape, centre, arms = chain.tape, chain.centre, chain.arms
    diamond, eps, frame_step, frame_fraction = chain.diamond, chain.eps, chain.frames.step, chain.frames.fraction
    gradient[:] = 0.0
    by_state = np.zeros(6)
    by_twist = np.zeros(3)
    by_impulse = np.zeros(3)
    n_cells, n_memory = arms.shape[1], tape.memory.shape[1]
    first_value = N_BODY_PARAMETERS + n_cells
    n_values = gradient.shape[0] - first_value
    first_sum = Block.EFFECTS + n_memory + n_values
    by_memory = np.zeros(n_memory)
    by_limit = np.zeros(n_cells if n_values > 0 else 0)
    frame = frame_step.shape[0] - 1
    for n in range(tape.event.shape[0] - 1, -1, -1):
        cos, sin, dt = tape.heading[n, 0], tape.heading[n, 1], chain.dt[n]
        end = frame
        while frame >= 0 and frame_step[frame] == n:
            _take_frame(by_pose[frame], tape.heading[n + 1, 0], tape.heading[n + 1, 1], centre, frame_fraction[frame], by_state, gradient)
            frame -= 1
        if tape.event[n] != Event.MOVED:
            by_state[3:] = 0.0
        by_memory_after = by_memory.copy()
        if n_memory > 0:
            by_memory[:] = 0.0
        if tape.event[n] != Event.IDLE:
            block, twist = tape.block[n], tape.twist[n]
            before, after = tape.coasting[n] * dt, (1.0 - tape.coasting[n]) * dt
            vx, vy = by_state[3] + after * by_state[0], by_state[4] + after * by_state[1]
            by_twist[0], by_twist[1] = cos * vx + sin * vy, -sin * vx + cos * vy
            by_twist[2] = by_state[5] + after * by_state[2]
            by_state[3:] = before * by_state[:3]
            by_state[2] += vy * (cos * twist[0] - sin * twist[1]) - vx * (sin * twist[0] + cos * twist[1])
            by_impulse[:] = 0.0
            for i in range(3):
                for j in range(3):
                    by_impulse[j] += block[i, Block.IMPULSE + j] * by_twist[i]
                for j in range(6):
                    by_state[j] += block[i, Block.STATE + j] * by_twist[i]
                for p in range(Param.MASS, N_BODY_PARAMETERS):
                    gradient[p] += block[i, Block.MASS + p - Param.MASS] * by_twist[i]
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
                        by_memory[j] += block[i, Block.EFFECTS + j] * by_twist[i]
                    for j in range(n_values):
                        gradient[first_value + j] += block[i, Block.EFFECTS + n_memory + j] * by_twist[i]
        for j in range(n_memory):
            g = tape.memory[n, j]
            for i in range(6):
                by_state[i] += g[i] * by_memory_after[j]
            for i in range(3):
                gradient[Param.MASS + i] += g[6 + i] * by_memory_after[j]
            for i in range(n_memory):
                by_memory[i] += g[N_FIXED_INPUTS + i] * by_memory_after[j]
            for i in range(n_values):
                gradient[first_value + i] += g[N_FIXED_INPUTS + n_memory + i] * by_memory_after[j]
        for j in range(frame + 1, end + 1):
            _take_frame(by_pose[j], cos, sin, centre, 1.0 - frame_fraction[j], by_state, gradient)
    cos, sin = tape.heading[0, 0], tape.heading[0, 1]
    gradient[Param.POSE], gradient[Param.POSE + 1] = by_state[0], by_state[1]
    gradient[Param.POSE + 2] = (
        by_state[2] - (sin * centre[0] + cos * centre[1]) * by_state[0] + (cos * centre[0] - sin * centre[1]) * by_state[1]
    )
    gradient[Param.CENTRE] += cos * by_state[0] + sin * by_state[1]
    gradient[Param.CENTRE + 1] += -sin * by_state[0] + cos * by_state[1]


@kernel
def _forced(block: Float64Array, impulse: Float64Array, nearer: Float64Array, direct: Float64Array) -> None:
    """Response to impulses on the object, shape (3, n), and displacements of the pusher, shape (2, n): fills `direct`, shape (3, n)."""
    for i in range(3):
        for p in range(direct.shape[1]):
            direct[i, p] = -block[i, Block.STATE] * nearer[0, p] - block[i, Block.STATE + 1] * nearer[1, p]
            for j in range(3):
                direct[i, p] += block[i, Block.IMPULSE + j] * impulse[j, p]


@kernel
def chain_response(
    chain: Chain, impulse: Float64Array, nearer: Float64Array, response: Float64Array, impulses: Frames, by_impulse: Float64Array
) -> None:
    """Change of the poses at the frames, and of the pusher's impulse until other times, by small forces on the object and displacements of
    the pusher, which no parameter stands for.

    Args:
        chain: the rollout; with reactions where impulses are wanted.
        impulse: on the object in each step, object axes, about the centre of mass, shape (n_steps, 3, n) [N s, N s, N m s].
        nearer: displacement of the pusher in each step, table axes, shape (n_steps, 2, n) [m]; the sliding of a contact that this adds is
            left out.
        response: filled, shape (n_frames, 3, n).
        impulses: when the impulse is wanted; of no frames where it is not.
        by_impulse: filled with its change from the start on, table axes, shape (n_impulses, 2, n).
    """
    tape, centre, frame_step, frame_fraction = chain.tape, chain.centre, chain.frames.step, chain.frames.fraction
    n, n_impulses = response.shape[2], impulses.step.shape[0]
    s, du, velocity = np.zeros((6, n)), np.zeros((3, n)), np.zeros((3, n))
    reaction, total = np.zeros((3, n)), np.zeros((2, n))
    response[:] = 0.0
    by_impulse[:] = 0.0
    frame = at = 0
    for step in range(tape.event.shape[0]):
        cos, sin, dt = tape.heading[step, 0], tape.heading[step, 1], chain.dt[step]
        begin, begin_impulse = frame, at
        while frame < frame_step.shape[0] and frame_step[frame] == step:
            _emit_state(s, cos, sin, centre, 1.0 - frame_fraction[frame], response[frame])
            frame += 1
        while at < n_impulses and impulses.step[at] == step:
            by_impulse[at] = (1.0 - impulses.fraction[at]) * total
            at += 1
        if tape.event[step] != Event.IDLE:
            block, before = tape.block[step], tape.coasting[step]
            _forced(block, impulse[step], nearer[step], du)
            if n_impulses > 0 and (chain.force[step, 0] != 0.0 or chain.force[step, 1] != 0.0):
                _forced(tape.reaction[step], impulse[step], nearer[step], reaction)
                _add_impulse(chain, step, s, reaction, total)
            velocity[:] = s[3:]
            _advance(s, du, block, tape.twist[step], cos, sin, (1.0 - before) * dt)
            s[:3] += before * dt * velocity
        if tape.event[step] != Event.MOVED:
            s[3:] = 0.0
        for j in range(begin, frame):
            _emit_state(s, tape.heading[step + 1, 0], tape.heading[step + 1, 1], centre, frame_fraction[j], response[j])
        for j in range(begin_impulse, at):
            by_impulse[j] += impulses.fraction[j] * total
