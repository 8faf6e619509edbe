"""What a rollout keeps for its derivative, and the order of the parameters in derivatives.

The state is s = (centre of mass x, y, yaw; velocity x, y, yaw rate), table axes. With v = R(yaw) u for the linear part, a step is

    s+ = (x + dt v, y.., yaw + dt omega, v, omega),      du = B ds + C dp + A sum_i (d impulse_i / d limit_i) d limit_i

(with the mean of the velocities before and after in place of v and omega where `Tape.coasting` says so)

where the 3 x 14 block [A B C] of a step is all that a rollout must keep. The impulse of the pusher depends on the same numbers; its
derivative is a second block of that form, kept where forces are wanted. Active effects (`table.py`) add to it the response E to their
memory m and their values q, and where an effect shifts the load to the sums of the limits of all cells that it depends on. The memory
evolves by m+ = G (s, mass, centre, m, q), whose derivative is kept as well.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from push_ident.physics.active_effects import N_FIXED_INPUTS
from push_ident.types import Float64Array


class Param(IntEnum):
    """First column of each parameter in the derivative of a motion."""

    POSE = 0
    """Of the first pose (x, y, yaw), three columns."""
    MASS = 3
    CENTRE = 4
    """Of the centre of mass, object frame, two columns."""
    INERTIA = 6
    MU = 7
    LIMIT = 8
    """Of the friction limits of the cells; the values of the active effects follow them."""


N_BODY_PARAMETERS: Final = Param.LIMIT.value


class Block(IntEnum):
    """First column of each part in the block of a step: A is the response to a unit impulse on each velocity, then B (state), C (body)."""

    IMPULSE = 0
    STATE = 3
    YAW = 5
    VELOCITY = 6
    MASS = 9
    CENTRE = 10
    INERTIA = 12
    MU = 13
    EFFECTS = 14
    """Of the memory of the effects, then their values."""


class Event(IntEnum):
    """Result of a step."""

    IDLE = 0
    """No motion."""
    MOVED = 1
    """One implicit step."""
    CAME_TO_REST = 2
    """One after which the velocities were set to zero."""


class Frames(NamedTuple):
    """When poses are reported."""

    step: NDArray[np.int64]
    """Step within which each frame lies, ascending, shape (n_frames,)."""
    fraction: Float64Array
    """Fraction of that step before the frame, shape (n_frames,)."""


class Tape(NamedTuple):
    """What the derivative needs of each step of a rollout."""

    event: NDArray[np.int8]
    """An `Event`, shape (n_steps,)."""
    block: Float64Array
    """[A B C E], shape (n_steps, 3, 14 + n_memory + n_values), object axes; `N_SUMS` columns more where one shifts the load."""
    reaction: Float64Array
    """Derivative of the impulse that the pusher gives the object in the step [N s, N s, N m s], by the columns of the block, object axes;
    of no steps where it is not wanted."""
    twist: Float64Array
    """After the step, object axes at its start, shape (n_steps, 3)."""
    heading: Float64Array
    """cos and sin of the yaw at the start of each step and at the end of the last, shape (n_steps + 1, 2)."""
    factor: Float64Array
    """Of the friction limit of each cell, shape (n_steps, n_cells); of no cells where no effect changes them."""
    coasting: Float64Array
    """Share of the velocity before a step in its motion: 1/2 where the object coasts and events are resolved, otherwise 0, shape
    (n_steps,)."""
    skew: Float64Array
    """Of the friction's direction, (a, b) in object axes, shape (n_steps, 2); of no steps where there is none."""
    memory: Float64Array
    """Derivative of the memory after a step by the inputs at its start (`table.py`), shape (n_steps, n_memory, n_inputs)."""


def new_tape(
    n_steps: int, n_cells: int = 0, n_memory: int = 0, n_values: int = 0, n_sums: int = 0, *, skewed: bool = False, forces: bool = False
) -> Tape:
    """Empty tape of a rollout; `n_cells` is 0 where no effect changes friction limits, `forces` whether their derivative is wanted."""
    n_inputs, n_columns = N_FIXED_INPUTS + n_memory + n_values, Block.EFFECTS + n_memory + n_values + n_sums
    return Tape(
        np.zeros(n_steps, dtype=np.int8), np.zeros((n_steps, 3, n_columns)), np.zeros((n_steps if forces else 0, 3, n_columns)),
        np.zeros((n_steps, 3)), np.zeros((n_steps + 1, 2)), np.ones((n_steps, n_cells)), np.zeros(n_steps),
        np.zeros((n_steps if skewed else 0, 2)),
        np.zeros((n_steps, n_memory, n_inputs)),
    )  # fmt: skip
