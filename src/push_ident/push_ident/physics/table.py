"""The effects between table and cells during one step, and their derivative by the complex step (compiled).

Their inputs are those of `active_effects.py`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from push_ident.physics.active_effects import N_FIXED_INPUTS, N_SUMS, ActiveEffects, Input
from push_ident.physics.effect import MAX_LOAD_NUMBERS, STEP_OF_INPUT, Body, ComplexArray, Load, equation
from push_ident.physics.effects import EFFECTS
from push_ident.physics.kernel import kernel
from push_ident.physics.modes import StepGeometry
from push_ident.physics.support import cell_friction
from push_ident.physics.table_laws import all_loads, all_memories, all_planes, all_pulls, all_skews
from push_ident.types import Float64Array

_EVERY_INPUT = -1
"""As the index of the input with the complex step: no input has it, and everything is evaluated."""
_PADDING = MAX_LOAD_NUMBERS  # inputs behind the last, so that as many can be read from any index


class TableScratch(NamedTuple):
    """Space for the effects on the table."""

    inputs: Float64Array
    stepped: ComplexArray
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
        stepped=np.zeros(n_inputs, dtype=np.complex128),
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
    inputs[Input.MASS] = mass
    inputs[Input.CENTRE : Input.CENTRE + 2] = centre
    inputs[N_FIXED_INPUTS : N_FIXED_INPUTS + memory.shape[0]] = memory
    first = N_FIXED_INPUTS + memory.shape[0]
    inputs[first : first + values.shape[0]] = values


@equation
def _body_of(effects: ActiveEffects, inputs: Any, centre: Float64Array) -> Any:
    """The object as an argument of equations, and the displacement of its centre of mass from the nominal one."""
    yaw = inputs[2].real
    turn = inputs[2] - yaw
    cos, sin = math.cos(yaw) - math.sin(yaw) * turn, math.sin(yaw) + math.cos(yaw) * turn
    dx, dy = inputs[Input.CENTRE] - centre[0], inputs[Input.CENTRE + 1] - centre[1]
    x, y, squared = effects.spread
    spread = squared - 2.0 * (x * dx + y * dy) + dx * dx + dy * dy
    return Body(inputs[0], inputs[1], cos, sin, inputs[3], inputs[4], inputs[5], inputs[Input.MASS], spread, effects.order), dx, dy


@equation
def _load_of(effects: ActiveEffects, inputs: Any, dx: Any, dy: Any) -> Load:
    """Position of the friction limits; (dx, dy) is the displacement of the centre of mass from the nominal one."""
    at = N_FIXED_INPUTS + effects.n_memory + effects.values.shape[0]
    total = inputs[at] if effects.shifts else inputs[Input.MASS]  # no effect uses it then
    x, y = inputs[at + 1] / total, inputs[at + 2] / total
    cell_variance = effects.cell_size * effects.cell_size / 12.0
    xx, yy = inputs[at + 3] / total - x * x + cell_variance, inputs[at + 5] / total - y * y + cell_variance
    return Load(x - dx, y - dy, xx, inputs[at + 4] / total - x * y, yy)


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
    body, dx, dy = _body_of(effects, inputs, centre)
    if effects.loads:
        if effects.planes:
            all_planes(effects.indices, inputs, _EVERY_INPUT, body, _load_of(effects, inputs, dx, dy), dx, dy, planes)
        if effects.uneven:
            all_loads(effects.indices, inputs, _EVERY_INPUT, body, arms, dx, dy, factors)
        factor[:] = 1.0
        for number in effects.loading:
            if effects.is_plane[number]:
                for i in range(arms.shape[1]):
                    factors[number, i] = planes[number, 0] + planes[number, 1] * arms[0, i] + planes[number, 2] * arms[1, i]
            for i in range(arms.shape[1]):
                factor[i] *= factors[number, i]
        for i in range(arms.shape[1]):
            factor[i] = max(factor[i], 0.0)
    if effects.skews:
        result[0], result[1] = all_skews(effects.indices, inputs, body)
    if effects.pulls:
        fx, fy, torque = all_pulls(effects.indices, inputs, body)
        result[2], result[3], result[4] = body.cos * fx + body.sin * fy, body.cos * fy - body.sin * fx, torque


@equation
def friction_demand(effects: ActiveEffects, arms: Float64Array, limit: Float64Array, scratch: TableScratch) -> float:
    """Upper bound of the share of an object's friction that keeps it at rest against the pull of `table_action`, too large by a factor of
    at most about two; `limit` is the friction limit of each cell without effects [N], shape (n_cells,).
    """
    pull = scratch.result[2:]
    force = torque = 0.0
    for i in range(arms.shape[1]):
        limit_of_cell = limit[i] * (scratch.factor[i] if effects.loads else 1.0)
        force += limit_of_cell
        torque += limit_of_cell * math.sqrt(arms[0, i] * arms[0, i] + arms[1, i] * arms[1, i])
    return 2.0 * (math.hypot(pull[0], pull[1]) / force + abs(pull[2]) / torque)


@equation
def _remember(effects: ActiveEffects, inputs: Any, centre: Float64Array, dt: float, after: Any) -> None:
    body, _, _ = _body_of(effects, inputs, centre)
    all_memories(effects.indices, inputs, body, dt, after)


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
    inputs, stepped, after = scratch.inputs, scratch.stepped, scratch.d_memory
    if derive:
        stepped[:] = inputs
        for column in range(by_inputs.shape[1]):
            stepped[column] += STEP_OF_INPUT * 1j
            _remember(effects, stepped, centre, dt, after)
            stepped[column] = inputs[column]
            for i in range(memory.shape[0]):
                by_inputs[i, column] = after[i].imag / STEP_OF_INPUT
    _remember(effects, inputs, centre, dt, memory)


@equation
def _weigh_forces(effects: ActiveEffects, arms: Float64Array, scratch: TableScratch) -> None:
    """Friction of each cell per factor of each effect that loads it, at the factors of all others; for planes, its moments suffice."""
    factors, force = scratch.factors, scratch.force
    for number in effects.loading:
        weighted, moments = scratch.weighted[number], scratch.moments[number]
        for i in range(arms.shape[1]):
            rest = 1.0
            for other in effects.loading:
                rest *= factors[other, i] if other != number else 1.0
            if rest * factors[number, i] < 0.0:
                rest = 0.0
            for j in range(3):
                weighted[j, i] = rest * force[j, i]
        for j in range(3):
            even = x = y = 0.0
            for i in range(arms.shape[1]):
                even += weighted[j, i]
                x += weighted[j, i] * arms[0, i]
                y += weighted[j, i] * arms[1, i]
            moments[j, 0], moments[j, 1], moments[j, 2] = even, x, y


@kernel
def table_sensitivity(
    effects: ActiveEffects,
    twist: Float64Array,
    geometry: StepGeometry,
    limit: Float64Array,
    skew: Float64Array,
    eps: float,
    scratch: TableScratch,
    seeds: Float64Array,
) -> None:
    """Derivative of the impulse on the object that the effects change, by all inputs, at the twist after the step.

    Kept whole: its parts share all arrays of the scratch, and it runs once a step.

    Args:
        effects: the active effects.
        twist: after the step, object axes, shape (3,).
        geometry: the object.
        limit: friction limit of each cell without effects [N], shape (n_cells,).
        skew: (a, b) in this step, shape (2,).
        eps: smoothing speed [m/s].
        scratch: as `table_action` left it.
        seeds: filled in the columns of a step's block that belong to inputs [N s, N s, N m s], shape (3, n_columns).
    """
    centre, arms, dt = geometry.centre, geometry.arms, geometry.dt
    inputs, stepped, factor, force = scratch.inputs, scratch.stepped, scratch.factor, scratch.force
    n_values = effects.values.shape[0]
    n_inputs = N_FIXED_INPUTS + effects.n_memory + n_values
    along_a, along_b = np.zeros(3), np.zeros(3)
    cell_friction(twist, arms, limit, skew, eps, force)
    if effects.skews:
        unit = np.zeros((3, arms.shape[1]))
        for which in range(2):
            # Contribution of E = [[1, 0], [0, -1]] or [[0, 1], [1, 0]].
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
    if effects.loads:
        _weigh_forces(effects, arms, scratch)
    unit_inputs = scratch.unit
    unit_inputs[:] = inputs
    unit_inputs[n_inputs - n_values : n_inputs] = 0.0
    body, _, _ = _body_of(effects, inputs, centre)
    stepped[:] = inputs
    for k in range(n_inputs + N_SUMS if effects.shifts else n_inputs):
        column = 3 + k if k < N_FIXED_INPUTS else 5 + k
        is_sum = k >= n_inputs
        if k >= n_inputs - n_values and not is_sum:
            if not effects.on_table[k - (n_inputs - n_values)]:
                continue
            if effects.pulled[k - (n_inputs - n_values)]:
                unit_inputs[k] = 1.0
                fx, fy, torque = all_pulls(effects.indices, unit_inputs, body)
                unit_inputs[k] = 0.0
                seeds[0, column] = dt * (body.cos * fx + body.sin * fy)
                seeds[1, column] = dt * (body.cos * fy - body.sin * fx)
                seeds[2, column] = dt * torque
                continue
        stepped[k] += STEP_OF_INPUT * 1j
        stepped_body, dx, dy = _body_of(effects, stepped, centre)
        a = b = gx = gy = gt = 0.0
        if effects.skews and not is_sum:
            skew_a, skew_b = all_skews(effects.indices, stepped, stepped_body)
            a, b = skew_a.imag, skew_b.imag
        if effects.pulls and not is_sum:
            pull_x, pull_y, pull_torque = all_pulls(effects.indices, stepped, stepped_body)
            gx = (stepped_body.cos * pull_x + stepped_body.sin * pull_y).imag
            gy = (stepped_body.cos * pull_y - stepped_body.sin * pull_x).imag
            gt = pull_torque.imag
        if effects.loads:
            if effects.planes:
                load = _load_of(effects, stepped, dx, dy)
                all_planes(effects.indices, stepped, _EVERY_INPUT if is_sum else k, stepped_body, load, dx, dy, scratch.d_planes)
            if effects.uneven and not is_sum:
                all_loads(effects.indices, stepped, k, stepped_body, arms, dx, dy, scratch.d_factors)
            for number in effects.loading:
                if effects.is_plane[number]:
                    d_plane, moments = scratch.d_planes[number], scratch.moments[number]
                    for j in range(3):
                        gx -= d_plane[j].imag * moments[0, j]
                        gy -= d_plane[j].imag * moments[1, j]
                        gt -= d_plane[j].imag * moments[2, j]
                elif not is_sum:
                    d_factor, weighted = scratch.d_factors[number], scratch.weighted[number]
                    for i in range(arms.shape[1]):
                        gx -= d_factor[i].imag * weighted[0, i]
                        gy -= d_factor[i].imag * weighted[1, i]
                        gt -= d_factor[i].imag * weighted[2, i]
        stepped[k] = inputs[k]
        gx -= a * along_a[0] + b * along_b[0]
        gy -= a * along_a[1] + b * along_b[1]
        gt -= a * along_a[2] + b * along_b[2]
        scale = dt / STEP_OF_INPUT
        seeds[0, column], seeds[1, column], seeds[2, column] = scale * gx, scale * gy, scale * gt
