"""The change of a motion by small forces and displacements in its steps, chained over all of them (compiled), as in `chain.py`."""

from __future__ import annotations

import numpy as np

from push_ident.physics.chain import Chain, add_impulse, advance, emit_state
from push_ident.physics.kernel import kernel
from push_ident.physics.tape import BLOCK_IMPULSE, BLOCK_STATE, IDLE, MOVED, Frames
from push_ident.types import Float64Array

__all__ = ["chain_response"]


@kernel
def _forced(block: Float64Array, impulse: Float64Array, nearer: Float64Array, own: Float64Array) -> None:
    """What a block makes of impulses on the object, shape (3, n), and displacements of the pusher, shape (2, n); fills `own`, (3, n)."""
    for i in range(3):
        for p in range(own.shape[1]):
            own[i, p] = -block[i, BLOCK_STATE] * nearer[0, p] - block[i, BLOCK_STATE + 1] * nearer[1, p]
            for j in range(3):
                own[i, p] += block[i, BLOCK_IMPULSE + j] * impulse[j, p]


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
    own, total = np.zeros((3, n)), np.zeros((2, n))
    response[:] = 0.0
    by_impulse[:] = 0.0
    frame = at = 0
    for step in range(tape.event.shape[0]):
        cos, sin, dt = tape.heading[step, 0], tape.heading[step, 1], chain.dt[step]
        begin, begin_impulse = frame, at
        while frame < frame_step.shape[0] and frame_step[frame] == step:
            emit_state(s, cos, sin, centre, 1.0 - frame_fraction[frame], response[frame])
            frame += 1
        while at < n_impulses and impulses.step[at] == step:
            by_impulse[at] = (1.0 - impulses.fraction[at]) * total
            at += 1
        if tape.event[step] != IDLE:
            block, before = tape.block[step], tape.coasting[step]
            _forced(block, impulse[step], nearer[step], du)
            if n_impulses > 0 and (chain.force[step, 0] != 0.0 or chain.force[step, 1] != 0.0):
                _forced(tape.reaction[step], impulse[step], nearer[step], own)
                add_impulse(chain, step, s, own, total)
            velocity[:] = s[3:]
            advance(s, du, block, tape.twist[step], cos, sin, (1.0 - before) * dt)
            s[:3] += before * dt * velocity
        if tape.event[step] != MOVED:
            s[3:] = 0.0
        for j in range(begin, frame):
            emit_state(s, tape.heading[step + 1, 0], tape.heading[step + 1, 1], centre, frame_fraction[j], response[j])
        for j in range(begin_impulse, at):
            by_impulse[j] += impulses.fraction[j] * total
