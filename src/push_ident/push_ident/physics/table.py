"""What active effects do between the table and the cells during one step, and its derivative (compiled).

Inputs are one array, real or complex, so that a complex step can turn any of them:

    0-5   state: centre of mass x, y, yaw and their velocities, table axes
    6     mass
    7-8   centre of mass, object frame
    9-    memory of the effects, then their values

As far as inputs act on a step, they are columns of its block too (`sensitivity.py`): the first nine of them from its state on, the
rest behind those of the body.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from push_ident.physics.effect import STEP_OF_INPUT, Body, Cell, Equation, OnTable, equation
from push_ident.physics.effects import EFFECTS
from push_ident.physics.kernel import kernel
from push_ident.physics.support import cell_friction
from push_ident.types import BoolArray, Float64Array

__all__ = [
    "N_FIXED_INPUTS", "ActiveEffects", "TableScratch", "fill_inputs", "new_table_scratch", "table_action", "table_sensitivity",
    "update_memory",
]  # fmt: skip

N_FIXED_INPUTS = 9
_MASS = 6
_CENTRE = 7


class ActiveEffects(NamedTuple):
    """The effects that act in a rollout, in the arrays that the kernels take. Each effect has a place, that in `EFFECTS`."""

    values: Float64Array
    """Of all parameters of the active effects, shape (n_values,)."""
    on_table: BoolArray
    """Which values belong to effects that act on the table or have a memory, shape (n_values,)."""
    first: NDArray[np.int64]
    """Index of the first value of each effect, -1 where it is not active, shape (n_effects,)."""
    memory: NDArray[np.int64]
    """Index of the first number of its memory, -1 where it has none, shape (n_effects,)."""
    n_memory: int
    loads: bool
    """Whether one changes the friction limits of the cells."""
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
    cell_moment: float
    """Second moment of a cell about an axis through its middle, per area [m^2]."""
    order: float
    """How many pushes went before this one."""


class TableScratch(NamedTuple):
    """Space for the effects on the table."""

    inputs: Float64Array
    turned: NDArray[np.complex128]
    """The inputs, one of them turned by the complex step."""
    factor: Float64Array
    """Of the friction limit of each cell, shape (n_cells,)."""
    limit: Float64Array
    """Friction limit of each cell in this step [N], shape (n_cells,)."""
    d_factor: NDArray[np.complex128]
    force: Float64Array
    """Friction of each cell per factor (fx, fy, torque), object axes, shape (3, n_cells)."""
    result: Float64Array
    """Skew (a, b) and pull (fx, fy, torque) of `table_action`, shape (5,)."""
    d_result: NDArray[np.complex128]
    d_memory: NDArray[np.complex128]


def new_table_scratch(n_memory: int, n_values: int, n_cells: int) -> TableScratch:
    """Scratch space of the effects; `n_cells` is 0 where none acts on the table."""
    n_inputs = N_FIXED_INPUTS + n_memory + n_values
    return TableScratch(
        np.zeros(n_inputs), np.zeros(n_inputs, dtype=np.complex128), np.ones(n_cells), np.zeros(n_cells),
        np.zeros(n_cells, dtype=np.complex128), np.zeros((3, n_cells)), np.zeros(5),
        np.zeros(5, dtype=np.complex128), np.zeros(n_memory, dtype=np.complex128),
    )  # fmt: skip


# All effects of a kind, folded into one function each: a loop over functions would hide them from the compiler.


@equation
def _no_load(effects: ActiveEffects, values: Any, body: Body, cell: Cell, memory: Any) -> Any:
    return body.mass * 0.0 + 1.0


@equation
def _no_skew(effects: ActiveEffects, values: Any, body: Body) -> Any:
    return body.mass * 0.0, body.mass * 0.0


@equation
def _no_pull(effects: ActiveEffects, values: Any, body: Body) -> Any:
    return body.mass * 0.0, body.mass * 0.0, body.mass * 0.0


@equation
def _no_memory(effects: ActiveEffects, values: Any, body: Body, dt: float, memory: Any, after: Any) -> None:
    after[:] = 0.0


def _with_load(others: Equation, load: Equation, place: int) -> Equation:
    @equation
    def loads(effects: ActiveEffects, values: Any, body: Body, cell: Cell, memory: Any) -> Any:
        factor = others(effects, values, body, cell, memory)
        if effects.first[place] >= 0:
            factor = factor * load(values[effects.first[place] :], body, cell, memory[effects.memory[place] :])
        return factor

    return loads


def _with_skew(others: Equation, skew: Equation, place: int) -> Equation:
    @equation
    def skews(effects: ActiveEffects, values: Any, body: Body) -> Any:
        a, b = others(effects, values, body)
        if effects.first[place] >= 0:
            more_a, more_b = skew(values[effects.first[place] :], body)
            a, b = a + more_a, b + more_b
        return a, b

    return skews


def _with_pull(others: Equation, pull: Equation, place: int) -> Equation:
    @equation
    def pulls(effects: ActiveEffects, values: Any, body: Body) -> Any:
        fx, fy, torque = others(effects, values, body)
        if effects.first[place] >= 0:
            more_x, more_y, more_torque = pull(values[effects.first[place] :], body)
            fx, fy, torque = fx + more_x, fy + more_y, torque + more_torque
        return fx, fy, torque

    return pulls


def _with_memory(others: Equation, remember: Equation, place: int) -> Equation:
    @equation
    def memories(effects: ActiveEffects, values: Any, body: Body, dt: float, memory: Any, after: Any) -> None:
        others(effects, values, body, dt, memory, after)
        if effects.first[place] >= 0:
            at = effects.memory[place]
            remember(values[effects.first[place] :], body, dt, memory[at:], after[at:])

    return memories


_loads, _skews, _pulls, _memories = _no_load, _no_skew, _no_pull, _no_memory
for _place, _effect in enumerate(EFFECTS.values()):
    if isinstance(_effect.acts, OnTable):
        if _effect.acts.load is not None:
            _loads = _with_load(_loads, _effect.acts.load, _place)
        if _effect.acts.skew is not None:
            _skews = _with_skew(_skews, _effect.acts.skew, _place)
        if _effect.acts.pull is not None:
            _pulls = _with_pull(_pulls, _effect.acts.pull, _place)
    if _effect.memory is not None:
        _memories = _with_memory(_memories, _effect.memory.remember, _place)


@kernel
def fill_inputs(state: Float64Array, mass: float, centre: Float64Array, memory: Float64Array, values: Float64Array, inputs: Any) -> None:
    """Enter the state of a step in its inputs."""
    inputs[:6] = state
    inputs[_MASS] = mass
    inputs[_CENTRE : _CENTRE + 2] = centre
    inputs[N_FIXED_INPUTS : N_FIXED_INPUTS + memory.shape[0]] = memory
    inputs[N_FIXED_INPUTS + memory.shape[0] :] = values


@equation
def _body_of(effects: ActiveEffects, inputs: Any, centre: Float64Array, arms: Float64Array) -> Any:
    """The object as equations see it, and by how much the centre of mass is off `centre`, from which the `arms` run."""
    yaw = inputs[2].real
    turn = inputs[2] - yaw
    cos, sin = math.cos(yaw) - math.sin(yaw) * turn, math.sin(yaw) + math.cos(yaw) * turn
    dx, dy = inputs[_CENTRE] - centre[0], inputs[_CENTRE + 1] - centre[1]
    x = y = sxy = 0.0
    sxx = syy = effects.cell_moment
    if effects.loads or effects.n_memory > 0:
        share = 1.0 / arms.shape[1]
        for i in range(arms.shape[1]):
            rx, ry = arms[0, i], arms[1, i]
            x += share * rx
            y += share * ry
            sxx += share * rx * rx
            sxy += share * rx * ry
            syy += share * ry * ry
    body = Body(
        inputs[0], inputs[1], cos, sin, inputs[3], inputs[4], inputs[5], inputs[_MASS],
        sxx - 2.0 * x * dx + dx * dx, sxy - x * dy - y * dx + dx * dy, syy - 2.0 * y * dy + dy * dy, effects.order,
    )  # fmt: skip
    return body, dx, dy


@equation
def table_action(effects: ActiveEffects, inputs: Any, centre: Float64Array, arms: Float64Array, factor: Any, result: Any) -> None:
    """The effects on the table for these inputs.

    Args:
        effects: which act.
        inputs: as above, real or complex.
        centre, arms: nominal centre of mass, shape (2,), and the cells' centres from there, shape (2, n_cells), object axes.
        factor: filled with the factor of the friction limit of each cell, shape (n_cells,), where an effect changes it.
        result: filled with the skew (a, b) and the pull (fx, fy, torque) [N, N, N m], object axes, shape (5,).
    """
    n_memory = effects.n_memory
    memory, values = inputs[N_FIXED_INPUTS : N_FIXED_INPUTS + n_memory], inputs[N_FIXED_INPUTS + n_memory :]
    body, dx, dy = _body_of(effects, inputs, centre, arms)
    cos, sin = body.cos, body.sin
    if effects.loads:
        for i in range(arms.shape[1]):
            rx, ry = arms[0, i] - dx, arms[1, i] - dy
            x, y = cos * rx - sin * ry, sin * rx + cos * ry
            cell = Cell(body.x + x, body.y + y, body.vx - body.omega * y, body.vy + body.omega * x, rx, ry)
            share = _loads(effects, values, body, cell, memory)
            factor[i] = share if share.real > 0.0 else 0.0 * share
    result[0], result[1] = _skews(effects, values, body)
    fx, fy, torque = _pulls(effects, values, body)
    result[2], result[3], result[4] = cos * fx + sin * fy, -sin * fx + cos * fy, torque


@equation
def _remember(effects: ActiveEffects, inputs: Any, centre: Float64Array, arms: Float64Array, dt: float, after: Any) -> None:
    n_memory = effects.n_memory
    body, _, _ = _body_of(effects, inputs, centre, arms)
    memory, values = inputs[N_FIXED_INPUTS : N_FIXED_INPUTS + n_memory], inputs[N_FIXED_INPUTS + n_memory :]
    _memories(effects, values, body, dt, memory, after)


@kernel
def update_memory(
    effects: ActiveEffects,
    centre: Float64Array,
    arms: Float64Array,
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
        for column in range(inputs.shape[0]):
            turned[column] += STEP_OF_INPUT * 1j
            _remember(effects, turned, centre, arms, dt, after)
            turned[column] = inputs[column]
            for i in range(memory.shape[0]):
                by_inputs[i, column] = after[i].imag / STEP_OF_INPUT
    _remember(effects, inputs, centre, arms, dt, memory)


@kernel
def table_sensitivity(
    effects: ActiveEffects,
    twist: Float64Array,
    centre: Float64Array,
    arms: Float64Array,
    limit: Float64Array,
    skew: Float64Array,
    eps: float,
    dt: float,
    scratch: TableScratch,
    seeds: Float64Array,
) -> None:
    """Derivative of the impulse on the object that the effects change, by all inputs, at the twist after the step.

    Args:
        twist: after the step, object axes, shape (3,).
        limit: friction limit of each cell without effects [N], shape (n_cells,).
        skew: (a, b) in this step, shape (2,).
        eps: smoothing speed [m/s].
        seeds: filled in the columns of a step's block that belong to inputs [N s, N s, N m s], shape (3, n_columns).

    The other arguments are those of `table_action`.
    """
    inputs, turned, factor, d_factor, force = scratch.inputs, scratch.turned, scratch.factor, scratch.d_factor, scratch.force
    n_values = effects.values.shape[0]
    n_inputs = inputs.shape[0]
    along_a, along_b = np.zeros(3), np.zeros(3)
    cell_friction(twist, arms, limit, skew, eps, force)
    if effects.skews:
        unit = np.zeros((3, arms.shape[1]))
        for which in range(2):
            # What E = [[1, 0], [0, -1]] or [[0, 1], [1, 0]] alone would add.
            direction = np.zeros(2)
            direction[which] = 1.0
            cell_friction(twist, arms, limit, direction, eps, unit)
            total = along_a if which == 0 else along_b
            for i in range(arms.shape[1]):
                for j in range(3):
                    total[j] += factor[i] * unit[j, i]
        cell_friction(twist, arms, limit, np.zeros(2), eps, unit)
        for i in range(arms.shape[1]):
            for j in range(3):
                along_a[j] -= factor[i] * unit[j, i]
                along_b[j] -= factor[i] * unit[j, i]
    turned[:] = inputs
    for k in range(n_inputs):
        if k >= n_inputs - n_values and not effects.on_table[k - (n_inputs - n_values)]:
            continue
        turned[k] += STEP_OF_INPUT * 1j
        table_action(effects, turned, centre, arms, d_factor, scratch.d_result)
        turned[k] = inputs[k]
        a, b = scratch.d_result[0].imag, scratch.d_result[1].imag
        gx, gy, gt = scratch.d_result[2].imag, scratch.d_result[3].imag, scratch.d_result[4].imag
        if effects.loads:
            for i in range(arms.shape[1]):
                gx -= d_factor[i].imag * force[0, i]
                gy -= d_factor[i].imag * force[1, i]
                gt -= d_factor[i].imag * force[2, i]
        gx -= a * along_a[0] + b * along_b[0]
        gy -= a * along_a[1] + b * along_b[1]
        gt -= a * along_a[2] + b * along_b[2]
        scale = dt / STEP_OF_INPUT
        column = 3 + k if k < N_FIXED_INPUTS else 5 + k
        seeds[0, column], seeds[1, column], seeds[2, column] = scale * gx, scale * gy, scale * gt
