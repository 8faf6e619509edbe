"""The active effects of a push, in the arrays that the kernels take.

The effects work on one array of inputs, real or complex, so that a complex step can turn any of them:

    0-5   state: centre of mass x, y, yaw and their velocities, table axes
    6     mass
    7-8   centre of mass, object frame
    9-    memory of the effects, then their values, then the sums over the cells of f (1, rx, ry, rx rx, rx ry, ry ry), f their friction
          limits and r from the nominal centre of mass, object axes; behind them a few that are not used

As far as inputs act on a step, they are columns of its block too (`tape.py`): the first nine of them from its state on, the
rest behind those of the body; the sums only where an effect shifts the load.
"""

from __future__ import annotations

from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from push_ident.physics.effect import OnContact, OnPusherPath, OnTable
from push_ident.physics.effect_values import EffectValues
from push_ident.physics.effects import EFFECTS
from push_ident.types import BoolArray, CellGrid, Float64Array


class Input(IntEnum):
    """Inputs of the effects by their index, see above."""

    MASS = 6
    CENTRE = 7


N_FIXED_INPUTS = 9
N_SUMS = 6
"""Number of sums of the friction limits among the inputs."""


class InputIndices(NamedTuple):
    """Indices of the numbers of each effect of `EFFECTS` among the inputs."""

    values: NDArray[np.int64]
    """Index of its first value, -1 where it is not active, shape (n_effects,)."""
    memory: NDArray[np.int64]
    """Index of the first number of its memory; 0 where it has none."""


class ActiveEffects(NamedTuple):
    """The active effects of a rollout, in the arrays that the kernels take."""

    values: Float64Array
    """Of all parameters of the active effects, then zeros for the modes of `vertices`, shape (n_values,)."""
    on_table: BoolArray
    """Which values belong to effects that act on the table, shape (n_values,)."""
    pulled: BoolArray
    """Which of them are those of a pull, which is linear in them, shape (n_values,)."""
    indices: InputIndices
    n_memory: int
    loading: NDArray[np.int64]
    """Numbers in `EFFECTS` of those that change the friction limits of the cells."""
    is_plane: BoolArray
    """Of each of `EFFECTS`, whether it does so by a factor that is linear over the object, shape (n_effects,)."""
    loads: bool
    """Whether one of them does; kernels skip kinds of effects that are absent, which saves time."""
    planes: bool
    """Whether one does so by such a factor."""
    shifts: bool
    """Whether one does so by such a factor that depends on where the limits lie."""
    uneven: bool
    """Whether one does so by a factor of any other shape."""
    skews: bool
    pulls: bool
    offset: int
    """Index of the value that shifts the contact surface, or -1."""
    restitution: int
    """Index of the coefficient of restitution, or -1."""
    rebound: int
    """Index of the first of three numbers of the memory: the velocity before the last step."""
    moves: BoolArray
    """Which values move the pusher, shape (n_values,)."""
    d_path: Float64Array
    """Derivative of the pusher's path by the values, shape (n_values, n_steps + 1, 3)."""
    spread: tuple[float, float, float]
    """Mean of rx, ry and r' r over the area of the cells [m, m, m^2], from the nominal centre of mass, object axes."""
    cell_size: float
    """[m]"""
    order: float
    """Number of pushes made before this one."""
    vertices: Float64Array
    """Derivative of the vertices of the outline by the modes in which it may differ, object frame, shape (n_modes, n_vertices, 2)."""


NO_MODES = np.zeros((0, 0, 2))
"""Of an outline that is known exactly."""


def active_effects(
    effects: EffectValues, d_path: Float64Array, arms: Float64Array, cells: CellGrid, order: float, vertices: Float64Array = NO_MODES
) -> ActiveEffects:
    """The effects in the arrays of the kernels.

    Args:
        effects: which act.
        d_path: derivative of the path, as from `driven_path`.
        arms: cell centres from the centre of mass [m], shape (2, n_cells).
        cells: of the object.
        order: how many pushes went before.
        vertices: see `ActiveEffects.vertices`; the outline itself is the one that the rollout has.
    """
    kinds, n_modes = _kinds_of(effects.names), len(vertices)
    (x, y), parts, size = arms, cells.parts, float(cells.size)
    mean_x, mean_y, mean_r2, mean_part = (float(np.average(values, weights=parts)) for values in (x, y, x * x + y * y, parts))
    spread = (mean_x, mean_y, mean_r2 + mean_part * size**2 / 6)
    if n_modes:
        none, of_path = np.zeros(n_modes, dtype=np.bool_), np.zeros((n_modes, *d_path.shape[1:]))
        on_table, pulled, moves = (np.append(kind, none) for kind in (kinds.on_table, kinds.pulled, kinds.moves))
        kinds, d_path = kinds._replace(on_table=on_table, pulled=pulled, moves=moves), np.concatenate([d_path, of_path])
    return kinds._replace(
        values=np.append(effects.values, np.zeros(n_modes)),
        d_path=d_path,
        spread=spread,
        cell_size=size,
        order=float(order),
        vertices=vertices,
    )


@cache
def _kinds_of(names: tuple[str, ...]) -> ActiveEffects:
    """The part that depends on the names of the effects only; the rest is zero or empty."""
    effects = EffectValues(names, np.zeros(sum(len(EFFECTS[name].parameters) for name in names)))
    first_value = N_FIXED_INPUTS + sum(effect.memory.size for effect in effects.effects if effect.memory is not None)
    indices = InputIndices(np.full(len(EFFECTS), -1, dtype=np.int64), np.zeros(len(EFFECTS), dtype=np.int64))
    on_table, pulled, moves = (np.zeros(len(effects), dtype=np.bool_) for _ in range(3))
    catalogue = list(EFFECTS)
    quantities = {"offset": -1, "restitution": -1}
    n_memory = 0
    rebound = -1
    for effect, positions in [(effect, effects.slice_of(effect.name)) for effect in effects.effects]:
        index, acts = catalogue.index(effect.name), effect.acts
        indices.values[index] = first_value + positions.start
        on_table[positions], moves[positions] = isinstance(acts, OnTable), isinstance(acts, OnPusherPath)
        pulled[positions] = isinstance(acts, OnTable) and acts.pull is not None
        if isinstance(acts, OnContact):
            quantities[acts.quantity] = positions.start
            rebound = n_memory if acts.quantity == "restitution" else rebound
        if effect.memory is not None:
            indices.memory[index] = N_FIXED_INPUTS + n_memory
            n_memory += effect.memory.size
    loading = np.array(
        [catalogue.index(e.name) for e in effects.effects if isinstance(e.acts, OnTable) and (e.acts.load or e.acts.is_plane)],
        dtype=np.int64,
    )
    table = [effect.acts for effect in effects.effects if isinstance(effect.acts, OnTable)]
    return ActiveEffects(
        values=effects.values,
        on_table=on_table,
        pulled=pulled,
        indices=indices,
        n_memory=n_memory,
        loading=loading,
        is_plane=np.array([isinstance(effect.acts, OnTable) and effect.acts.is_plane for effect in EFFECTS.values()]),
        loads=len(loading) > 0,
        planes=any(acts.is_plane for acts in table),
        shifts=any(acts.shift is not None for acts in table),
        uneven=any(acts.load is not None for acts in table),
        skews=any(acts.skew is not None for acts in table),
        pulls=any(acts.pull is not None for acts in table),
        offset=quantities["offset"],
        restitution=quantities["restitution"],
        rebound=rebound,
        moves=moves,
        d_path=np.zeros((len(effects), 0, 3)),
        spread=(0.0, 0.0, 0.0),
        cell_size=0.0,
        order=0.0,
        vertices=NO_MODES,
    )
