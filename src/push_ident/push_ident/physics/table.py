"""The effects between table and cells during one step (compiled). Their inputs are those of `active_effects.py`."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from push_ident.physics.active_effects import INPUT_CENTRE, INPUT_MASS, N_FIXED_INPUTS, N_SUMS, ActiveEffects
from push_ident.physics.effect import MAX_LOAD_NUMBERS, STEP_OF_INPUT, Body, ComplexArray, Load, equation
from push_ident.physics.effects import EFFECTS
from push_ident.physics.kernel import kernel
from push_ident.physics.table_laws import all_loads, all_memories, all_planes, all_pulls, all_skews
from push_ident.types import Float64Array

__all__ = [
    "EVERY_INPUT", "TableScratch", "body_of", "fill_inputs", "friction_demand", "load_of", "new_table_scratch", "sum_limits",
    "table_action", "update_memory",
]  # fmt: skip

EVERY_INPUT = -1
"""As the index of the input with the complex step: no input has it, and everything is evaluated."""
_PADDING = MAX_LOAD_NUMBERS  # inputs behind the last, so that as many can be read from any place


class TableScratch(NamedTuple):
    """Space for the effects on the table."""

    inputs: Float64Array
    turned: ComplexArray
    """The inputs, one of them with the complex step added."""
    unit: Float64Array
    """The inputs with all values zero but one, which is 1."""
    factor: Float64Array
    """Of the friction limit of each cell, shape (n_cells,)."""
    factors: Float64Array
    """The same for each single effect, where it acts, shape (n_effects, n_cells)."""
    d_factors: ComplexArray
    planes: Float64Array
    """(even, x, y) of the factor even + x rx + y ry of each effect that is linear over the object, shape (n_effects, 3)."""
    d_planes: ComplexArray
    weighted: Float64Array
    """Friction of each cell per factor of each effect (fx, fy, torque), object axes, shape (n_effects, 3, n_cells)."""
    moments: Float64Array
    """Its sums with (1, rx, ry) over all cells, shape (n_effects, 3, 3)."""
    limit: Float64Array
    """Friction limit of each cell in this step [N], shape (n_cells,)."""
    force: Float64Array
    """Friction of each cell per factor (fx, fy, torque), object axes, shape (3, n_cells)."""
    result: Float64Array
    """Skew (a, b) and pull (fx, fy, torque) [N, N, N m] of `table_action`, object axes, shape (5,)."""
    d_memory: ComplexArray


def new_table_scratch(n_memory: int, n_values: int, n_cells: int) -> TableScratch:
    """Scratch space of the effects; `n_cells` is 0 where none acts on the table."""
    n_inputs, n_effects = N_FIXED_INPUTS + n_memory + n_values + N_SUMS + _PADDING, len(EFFECTS)
    return TableScratch(
        inputs=np.zeros(n_inputs),
        turned=np.zeros(n_inputs, dtype=np.complex128),
        unit=np.zeros(n_inputs),
        factor=np.ones(n_cells),
        factors=np.ones((n_effects, n_cells)),
        d_factors=np.zeros((n_effects, n_cells), dtype=np.complex128),
        planes=np.zeros((n_effects, 3)),
        d_planes=np.zeros((n_effects, 3), dtype=np.complex128),
        weighted=np.zeros((n_effects, 3, n_cells)),
        moments=np.zeros((n_effects, 3, 3)),
        limit=np.zeros(n_cells),
        force=np.zeros((3, n_cells)),
        result=np.zeros(5),
        d_memory=np.zeros(n_memory, dtype=np.complex128),
    )


@kernel
def fill_inputs(state: Float64Array, mass: float, centre: Float64Array, memory: Float64Array, values: Float64Array, inputs: Any) -> None:
    """Enter the state of a step in its inputs."""
    inputs[:6] = state
    inputs[INPUT_MASS] = mass
    inputs[INPUT_CENTRE : INPUT_CENTRE + 2] = centre
    inputs[N_FIXED_INPUTS : N_FIXED_INPUTS + memory.shape[0]] = memory
    first = N_FIXED_INPUTS + memory.shape[0]
    inputs[first : first + values.shape[0]] = values


@equation
def body_of(effects: ActiveEffects, inputs: Any, centre: Float64Array) -> Any:
    """The object as an argument of equations, and the displacement of its centre of mass from the nominal one."""
    yaw = inputs[2].real
    turn = inputs[2] - yaw
    cos, sin = math.cos(yaw) - math.sin(yaw) * turn, math.sin(yaw) + math.cos(yaw) * turn
    dx, dy = inputs[INPUT_CENTRE] - centre[0], inputs[INPUT_CENTRE + 1] - centre[1]
    x, y, squared = effects.spread
    spread = squared - 2.0 * (x * dx + y * dy) + dx * dx + dy * dy
    return Body(inputs[0], inputs[1], cos, sin, inputs[3], inputs[4], inputs[5], inputs[INPUT_MASS], spread, effects.order), dx, dy


@equation
def load_of(effects: ActiveEffects, inputs: Any, dx: Any, dy: Any) -> Load:
    """Position of the friction limits; (dx, dy) is the displacement of the centre of mass from the nominal one."""
    at = N_FIXED_INPUTS + effects.n_memory + effects.values.shape[0]
    total = inputs[at] if effects.shifts else inputs[INPUT_MASS]  # no effect uses it then
    x, y = inputs[at + 1] / total, inputs[at + 2] / total
    own = effects.cell_size * effects.cell_size / 12.0
    return Load(
        x - dx, y - dy, inputs[at + 3] / total - x * x + own, inputs[at + 4] / total - x * y, inputs[at + 5] / total - y * y + own
    )  # fmt: skip


@kernel
def sum_limits(effects: ActiveEffects, arms: Float64Array, limit: Float64Array, inputs: Any) -> None:
    """Enter the sums of the friction limits of a push in the inputs."""
    at = N_FIXED_INPUTS + effects.n_memory + effects.values.shape[0]
    inputs[at : at + N_SUMS] = 0.0
    for i in range(limit.shape[0]):
        x, y, f = arms[0, i], arms[1, i], limit[i]
        inputs[at] += f
        inputs[at + 1] += f * x
        inputs[at + 2] += f * y
        inputs[at + 3] += f * x * x
        inputs[at + 4] += f * x * y
        inputs[at + 5] += f * y * y


@equation
def table_action(effects: ActiveEffects, centre: Float64Array, arms: Float64Array, scratch: TableScratch) -> None:
    """The effects on the table, for the inputs in `scratch`: fills its `factor` and its `result`.

    Args:
        effects: which act.
        centre, arms: nominal centre of mass, shape (2,), and the cells' centres from there, shape (2, n_cells), object axes.
        scratch: holds the inputs.
    """
    inputs, factor, factors, planes, result = scratch.inputs, scratch.factor, scratch.factors, scratch.planes, scratch.result
    body, dx, dy = body_of(effects, inputs, centre)
    if effects.loads:
        if effects.planes:
            all_planes(effects.places, inputs, EVERY_INPUT, body, load_of(effects, inputs, dx, dy), dx, dy, planes)
        if effects.uneven:
            all_loads(effects.places, inputs, EVERY_INPUT, body, arms, dx, dy, factors)
        factor[:] = 1.0
        for place in effects.loading:
            if effects.is_plane[place]:
                for i in range(arms.shape[1]):
                    factors[place, i] = planes[place, 0] + planes[place, 1] * arms[0, i] + planes[place, 2] * arms[1, i]
            for i in range(arms.shape[1]):
                factor[i] *= factors[place, i]
        for i in range(arms.shape[1]):
            factor[i] = max(factor[i], 0.0)
    if effects.skews:
        result[0], result[1] = all_skews(effects.places, inputs, body)
    if effects.pulls:
        fx, fy, torque = all_pulls(effects.places, inputs, body)
        result[2], result[3], result[4] = body.cos * fx + body.sin * fy, body.cos * fy - body.sin * fx, torque


@equation
def friction_demand(effects: ActiveEffects, arms: Float64Array, limit: Float64Array, scratch: TableScratch) -> float:
    """Upper bound of the share of an object's friction that keeps it at rest against the pull of `table_action`, too large by a factor of
    at most about two; `limit` is the friction limit of each cell without effects [N], shape (n_cells,).
    """
    pull = scratch.result[2:]
    force = torque = 0.0
    for i in range(arms.shape[1]):
        own = limit[i] * (scratch.factor[i] if effects.loads else 1.0)
        force += own
        torque += own * math.sqrt(arms[0, i] * arms[0, i] + arms[1, i] * arms[1, i])
    return 2.0 * (math.hypot(pull[0], pull[1]) / force + abs(pull[2]) / torque)


@equation
def _remember(effects: ActiveEffects, inputs: Any, centre: Float64Array, dt: float, after: Any) -> None:
    body, _, _ = body_of(effects, inputs, centre)
    all_memories(effects.places, inputs, body, dt, after)


@kernel
def update_memory(
    effects: ActiveEffects,
    centre: Float64Array,
    dt: float,
    derive: bool,
    memory: Float64Array,
    by_inputs: Float64Array,
    scratch: TableScratch,
) -> None:
    """Carry the memory over a step; where `derive`, fill its derivative by the inputs, shape (n_memory, n_inputs)."""
    inputs, turned, after = scratch.inputs, scratch.turned, scratch.d_memory
    if derive:
        turned[:] = inputs
        for column in range(by_inputs.shape[1]):
            turned[column] += STEP_OF_INPUT * 1j
            _remember(effects, turned, centre, dt, after)
            turned[column] = inputs[column]
            for i in range(memory.shape[0]):
                by_inputs[i, column] = after[i].imag / STEP_OF_INPUT
    _remember(effects, inputs, centre, dt, memory)
