"""What active effects do between the table and the cells during one step, and its derivative (compiled).

Inputs are one array, real or complex, so that a complex step can turn any of them:

    0-5   state: centre of mass x, y, yaw and their velocities, table axes
    6     mass
    7-8   centre of mass, object frame
    9-    memory of the effects, then their values, then the sums over the cells of f (1, rx, ry, rx rx, rx ry, ry ry), f their friction
          limits and r from the nominal centre of mass, object axes; behind them a few that are not used

As far as inputs act on a step, they are columns of its block too (`sensitivity.py`): the first nine of them from its state on, the
rest behind those of the body; the sums only where an effect shifts the load.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from push_ident.physics.effect import (
    MAX_LOAD_NUMBERS,
    STEP_OF_INPUT,
    Body,
    Cell,
    ComplexArray,
    Effect,
    Equation,
    Load,
    OnTable,
    equation,
)  # fmt: skip
from push_ident.physics.effects import EFFECTS
from push_ident.physics.kernel import kernel
from push_ident.physics.support import cell_friction
from push_ident.types import BoolArray, Float64Array

__all__ = [
    "N_FIXED_INPUTS", "N_SUMS", "ActiveEffects", "Places", "TableScratch", "fill_inputs", "new_table_scratch", "strain", "sum_limits",
    "table_action", "table_sensitivity", "update_memory",
]  # fmt: skip

N_FIXED_INPUTS = 9
N_SUMS = 6
"""How many sums of the friction limits are inputs."""
_MASS = 6
_CENTRE = 7
_ALL = -1  # as the number of the input that is turned: none is, and everything is evaluated
_PADDING = MAX_LOAD_NUMBERS  # inputs behind the last, so that as many can be read from any place


class Places(NamedTuple):
    """Where each effect of `EFFECTS` finds its numbers among the inputs."""

    values: NDArray[np.int64]
    """Index of its first value, -1 where it is not active, shape (n_effects,)."""
    memory: NDArray[np.int64]
    """Index of the first number of its memory; 0 where it has none."""


class ActiveEffects(NamedTuple):
    """The effects that act in a rollout, in the arrays that the kernels take."""

    values: Float64Array
    """Of all parameters of the active effects, shape (n_values,)."""
    on_table: BoolArray
    """Which values belong to effects that act on the table, shape (n_values,)."""
    pulled: BoolArray
    """Which of them are those of a pull, which is linear in them, shape (n_values,)."""
    places: Places
    n_memory: int
    loading: NDArray[np.int64]
    """Places in `EFFECTS` of those that change the friction limits of the cells."""
    is_plane: BoolArray
    """Of each of `EFFECTS`, whether it does so by a factor that is linear over the object, shape (n_effects,)."""
    loads: bool
    """Whether one does so at all; what is absent is not even asked, as asking takes its time."""
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
    """How many pushes went before this one."""


class TableScratch(NamedTuple):
    """Space for the effects on the table."""

    inputs: Float64Array
    turned: ComplexArray
    """The inputs, one of them turned by the complex step."""
    unit: Float64Array
    """The inputs with all values zero but one, which is 1."""
    factor: Float64Array
    """Of the friction limit of each cell, shape (n_cells,)."""
    factors: Float64Array
    """The same of each effect alone, where it acts, shape (n_effects, n_cells)."""
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


# All effects of a kind, folded into one function each: a loop over functions would hide them from the compiler. Into the equation of a
# load, which every cell evaluates, values and memory go as numbers: arrays would cost more than the equation.


@equation
def _four(inputs: Any, at: int) -> Any:
    return inputs[at], inputs[at + 1], inputs[at + 2], inputs[at + 3]


@equation
def _cell_of(body: Body, rx: Any, ry: Any) -> Cell:
    x, y = body.cos * rx - body.sin * ry, body.sin * rx + body.cos * ry
    return Cell(body.x + x, body.y + y, body.vx - body.omega * y, body.vy + body.omega * x, rx, ry)


@equation
def _no_plane(places: Places, inputs: Any, turned: int, body: Body, load: Load, dx: Any, dy: Any, planes: Any) -> None:
    planes[:] = 0.0


@equation
def _no_load(places: Places, inputs: Any, turned: int, body: Body, arms: Float64Array, dx: Any, dy: Any, factors: Any) -> None:
    pass


@equation
def _no_skew(places: Places, inputs: Any, body: Body) -> Any:
    return body.mass * 0.0, body.mass * 0.0


@equation
def _no_pull(places: Places, inputs: Any, body: Body) -> Any:
    return body.mass * 0.0, body.mass * 0.0, body.mass * 0.0


@equation
def _no_memory(places: Places, inputs: Any, body: Body, dt: float, after: Any) -> None:
    after[:] = 0.0


@equation
def _is_turned(places: Places, turned: int, place: int, n_values: int, n_memory: int) -> bool:
    """Whether a turned input (-1: all of them) changes what this effect does to the cells: values and memory of another one do not."""
    own, past = places.values[place], places.memory[place]
    return turned < N_FIXED_INPUTS or own <= turned < own + n_values or past <= turned < past + n_memory


def _with_plane(others: Equation, effect: Effect, plane: Equation, place: int) -> Equation:
    n_values, n_memory = len(effect.parameters), effect.memory.size if effect.memory else 0

    @equation
    def planes_of(places: Places, inputs: Any, turned: int, body: Body, load: Load, dx: Any, dy: Any, planes: Any) -> None:
        others(places, inputs, turned, body, load, dx, dy, planes)
        own = places.values[place]
        if own >= 0 and _is_turned(places, turned, place, n_values, n_memory):
            even, x, y = plane(inputs[own:], body, load, inputs[places.memory[place] :])
            planes[place, 0], planes[place, 1], planes[place, 2] = even - x * dx - y * dy, x, y

    return planes_of


def _alike(plane: Equation) -> Equation:
    """A plane that does not depend on where the limits lie."""

    @equation
    def planes_of(p: Any, body: Body, load: Load, memory: Any) -> Any:
        return plane(p, body, memory)

    return planes_of


def _tilted(shift: Equation) -> Equation:
    """The plane that moves the centre of the limits by a shift."""

    @equation
    def planes_of(p: Any, body: Body, load: Load, memory: Any) -> Any:
        qx, qy = shift(p, body, load, memory)
        determinant = load.xx * load.yy - load.xy * load.xy
        x, y = (load.yy * qx - load.xy * qy) / determinant, (load.xx * qy - load.xy * qx) / determinant
        return 1.0 - x * load.x - y * load.y, x, y

    return planes_of


def _with_load(others: Equation, effect: Effect, load: Equation, place: int) -> Equation:
    n_values, n_memory = len(effect.parameters), effect.memory.size if effect.memory else 0

    @equation
    def loads(places: Places, inputs: Any, turned: int, body: Body, arms: Float64Array, dx: Any, dy: Any, factors: Any) -> None:
        others(places, inputs, turned, body, arms, dx, dy, factors)
        own = places.values[place]
        if own < 0:
            return
        if not _is_turned(places, turned, place, n_values, n_memory):
            factors[place] = 0.0
            return
        p, memory = _four(inputs, own), _four(inputs, places.memory[place])
        for i in range(arms.shape[1]):
            factors[place, i] = load(p, body, _cell_of(body, arms[0, i] - dx, arms[1, i] - dy), memory)

    return loads


def _with_skew(others: Equation, skew: Equation, place: int) -> Equation:
    @equation
    def skews(places: Places, inputs: Any, body: Body) -> Any:
        a, b = others(places, inputs, body)
        if places.values[place] >= 0:
            more_a, more_b = skew(inputs[places.values[place] :], body)
            a, b = a + more_a, b + more_b
        return a, b

    return skews


def _with_pull(others: Equation, pull: Equation, place: int) -> Equation:
    @equation
    def pulls(places: Places, inputs: Any, body: Body) -> Any:
        fx, fy, torque = others(places, inputs, body)
        if places.values[place] >= 0:
            more_x, more_y, more_torque = pull(inputs[places.values[place] :], body)
            fx, fy, torque = fx + more_x, fy + more_y, torque + more_torque
        return fx, fy, torque

    return pulls


def _with_memory(others: Equation, remember: Equation, place: int) -> Equation:
    @equation
    def memories(places: Places, inputs: Any, body: Body, dt: float, after: Any) -> None:
        others(places, inputs, body, dt, after)
        if places.values[place] >= 0:
            at = places.memory[place]
            remember(inputs[places.values[place] :], body, dt, inputs[at:], after[at - N_FIXED_INPUTS :])

    return memories


_planes, _loads, _skews, _pulls, _memories = _no_plane, _no_load, _no_skew, _no_pull, _no_memory
for _place, _effect in enumerate(EFFECTS.values()):
    if isinstance(_effect.acts, OnTable):
        if _effect.acts.load is not None:
            _loads = _with_load(_loads, _effect, _effect.acts.load, _place)
        if _effect.acts.plane is not None:
            _planes = _with_plane(_planes, _effect, _alike(_effect.acts.plane), _place)
        if _effect.acts.shift is not None:
            _planes = _with_plane(_planes, _effect, _tilted(_effect.acts.shift), _place)
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
    first = N_FIXED_INPUTS + memory.shape[0]
    inputs[first : first + values.shape[0]] = values


@equation
def _body_of(effects: ActiveEffects, inputs: Any, centre: Float64Array) -> Any:
    """The object as equations see it, and by how much its centre of mass is off the nominal one."""
    yaw = inputs[2].real
    turn = inputs[2] - yaw
    cos, sin = math.cos(yaw) - math.sin(yaw) * turn, math.sin(yaw) + math.cos(yaw) * turn
    dx, dy = inputs[_CENTRE] - centre[0], inputs[_CENTRE + 1] - centre[1]
    x, y, squared = effects.spread
    spread = squared - 2.0 * (x * dx + y * dy) + dx * dx + dy * dy
    return Body(inputs[0], inputs[1], cos, sin, inputs[3], inputs[4], inputs[5], inputs[_MASS], spread, effects.order), dx, dy


@equation
def _load_of(effects: ActiveEffects, inputs: Any, dx: Any, dy: Any) -> Load:
    """Where the friction limits lie; (dx, dy) is by how much the centre of mass is off the nominal one."""
    at = N_FIXED_INPUTS + effects.n_memory + effects.values.shape[0]
    total = inputs[at] if effects.shifts else inputs[_MASS]  # no effect looks at it then
    x, y = inputs[at + 1] / total, inputs[at + 2] / total
    own = effects.cell_size * effects.cell_size / 12.0
    return Load(
        x - dx, y - dy, inputs[at + 3] / total - x * x + own, inputs[at + 4] / total - x * y, inputs[at + 5] / total - y * y + own
    )  # fmt: skip


@kernel
def sum_limits(effects: ActiveEffects, arms: Float64Array, limit: Float64Array, inputs: Any) -> None:
    """Enter the sums of the friction limits of a push in the inputs; the arguments are those of `table_sensitivity`."""
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
            _planes(effects.places, inputs, _ALL, body, _load_of(effects, inputs, dx, dy), dx, dy, planes)
        if effects.uneven:
            _loads(effects.places, inputs, _ALL, body, arms, dx, dy, factors)
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
        result[0], result[1] = _skews(effects.places, inputs, body)
    if effects.pulls:
        fx, fy, torque = _pulls(effects.places, inputs, body)
        result[2], result[3], result[4] = body.cos * fx + body.sin * fy, body.cos * fy - body.sin * fx, torque


@equation
def strain(effects: ActiveEffects, arms: Float64Array, limit: Float64Array, scratch: TableScratch) -> float:
    """Share of the friction of an object at rest that the pull of `table_action` needs, by a bound that is too large by at most two or so.

    The other arguments are those of `table_sensitivity`.
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
    body, _, _ = _body_of(effects, inputs, centre)
    _memories(effects.places, inputs, body, dt, after)


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


@equation
def _weigh_forces(effects: ActiveEffects, arms: Float64Array, scratch: TableScratch) -> None:
    """Friction of each cell per factor of each effect that loads it, all others as they are; of planes, its moments are enough."""
    factors, force = scratch.factors, scratch.force
    for place in effects.loading:
        weighted, moments = scratch.weighted[place], scratch.moments[place]
        for i in range(arms.shape[1]):
            rest = 1.0
            for other in effects.loading:
                rest *= factors[other, i] if other != place else 1.0
            if rest * factors[place, i] < 0.0:
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

    The other arguments are those of `table_action`, which was called before.
    """
    inputs, turned, factor, force = scratch.inputs, scratch.turned, scratch.factor, scratch.force
    n_values = effects.values.shape[0]
    n_inputs = N_FIXED_INPUTS + effects.n_memory + n_values
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
    if effects.loads:
        _weigh_forces(effects, arms, scratch)
    unit_inputs = scratch.unit
    unit_inputs[:] = inputs
    unit_inputs[n_inputs - n_values : n_inputs] = 0.0
    body, _, _ = _body_of(effects, inputs, centre)
    turned[:] = inputs
    for k in range(n_inputs + N_SUMS if effects.shifts else n_inputs):
        column = 3 + k if k < N_FIXED_INPUTS else 5 + k
        is_sum = k >= n_inputs
        if k >= n_inputs - n_values and not is_sum:
            if not effects.on_table[k - (n_inputs - n_values)]:
                continue
            if effects.pulled[k - (n_inputs - n_values)]:
                unit_inputs[k] = 1.0
                fx, fy, torque = _pulls(effects.places, unit_inputs, body)
                unit_inputs[k] = 0.0
                seeds[0, column] = dt * (body.cos * fx + body.sin * fy)
                seeds[1, column] = dt * (body.cos * fy - body.sin * fx)
                seeds[2, column] = dt * torque
                continue
        turned[k] += STEP_OF_INPUT * 1j
        turned_body, dx, dy = _body_of(effects, turned, centre)
        a = b = gx = gy = gt = 0.0
        if effects.skews and not is_sum:
            skew_a, skew_b = _skews(effects.places, turned, turned_body)
            a, b = skew_a.imag, skew_b.imag
        if effects.pulls and not is_sum:
            pull_x, pull_y, pull_torque = _pulls(effects.places, turned, turned_body)
            gx = (turned_body.cos * pull_x + turned_body.sin * pull_y).imag
            gy = (turned_body.cos * pull_y - turned_body.sin * pull_x).imag
            gt = pull_torque.imag
        if effects.loads:
            if effects.planes:
                load = _load_of(effects, turned, dx, dy)
                _planes(effects.places, turned, _ALL if is_sum else k, turned_body, load, dx, dy, scratch.d_planes)
            if effects.uneven and not is_sum:
                _loads(effects.places, turned, k, turned_body, arms, dx, dy, scratch.d_factors)
            for place in effects.loading:
                if effects.is_plane[place]:
                    d_plane, moments = scratch.d_planes[place], scratch.moments[place]
                    for j in range(3):
                        gx -= d_plane[j].imag * moments[0, j]
                        gy -= d_plane[j].imag * moments[1, j]
                        gt -= d_plane[j].imag * moments[2, j]
                elif not is_sum:
                    d_factor, weighted = scratch.d_factors[place], scratch.weighted[place]
                    for i in range(arms.shape[1]):
                        gx -= d_factor[i].imag * weighted[0, i]
                        gy -= d_factor[i].imag * weighted[1, i]
                        gt -= d_factor[i].imag * weighted[2, i]
        turned[k] = inputs[k]
        gx -= a * along_a[0] + b * along_b[0]
        gy -= a * along_a[1] + b * along_b[1]
        gt -= a * along_a[2] + b * along_b[2]
        scale = dt / STEP_OF_INPUT
        seeds[0, column], seeds[1, column], seeds[2, column] = scale * gx, scale * gy, scale * gt
