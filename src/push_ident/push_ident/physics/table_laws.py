"""The laws of all effects on the table, one compiled function for each kind: load, plane, skew, pull, memory.

Each function folds in the equations of all effects of its kind: a loop over functions would hide them from the compiler. Into the
equation of a load, which every cell evaluates, values and memory go as numbers: arrays would cost more than the equation.
"""

from __future__ import annotations

from typing import Any

from push_ident.physics.active_effects import N_FIXED_INPUTS, InputIndices
from push_ident.physics.effect import Body, Cell, Effect, Equation, Load, OnTable, equation
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array


@equation
def _four(inputs: Any, at: int) -> Any:
    return inputs[at], inputs[at + 1], inputs[at + 2], inputs[at + 3]


@equation
def _cell_of(body: Body, rx: Any, ry: Any) -> Cell:
    x, y = body.cos * rx - body.sin * ry, body.sin * rx + body.cos * ry
    return Cell(body.x + x, body.y + y, body.vx - body.omega * y, body.vy + body.omega * x, rx, ry)


@equation
def _no_plane(indices: InputIndices, inputs: Any, stepped: int, body: Body, load: Load, dx: Any, dy: Any, planes: Any) -> None:
    planes[:] = 0.0


@equation
def _no_load(indices: InputIndices, inputs: Any, stepped: int, body: Body, arms: Float64Array, dx: Any, dy: Any, factors: Any) -> None:
    pass


@equation
def _no_skew(indices: InputIndices, inputs: Any, body: Body) -> Any:
    return body.mass * 0.0, body.mass * 0.0


@equation
def _no_pull(indices: InputIndices, inputs: Any, body: Body) -> Any:
    return body.mass * 0.0, body.mass * 0.0, body.mass * 0.0


@equation
def _no_memory(indices: InputIndices, inputs: Any, body: Body, dt: float, after: Any) -> None:
    after[:] = 0.0


@equation
def _is_affected(indices: InputIndices, stepped: int, number: int, n_values: int, n_memory: int) -> bool:
    """Whether an input with the complex step (-1: all of them) changes this effect on the cells: those of other effects do not."""
    first, first_memory = indices.values[number], indices.memory[number]
    return stepped < N_FIXED_INPUTS or first <= stepped < first + n_values or first_memory <= stepped < first_memory + n_memory


def _with_plane(others: Equation, effect: Effect, plane: Equation, number: int) -> Equation:
    n_values, n_memory = len(effect.parameters), effect.memory.size if effect.memory else 0

    @equation
    def planes_of(indices: InputIndices, inputs: Any, stepped: int, body: Body, load: Load, dx: Any, dy: Any, planes: Any) -> None:
        others(indices, inputs, stepped, body, load, dx, dy, planes)
        first = indices.values[number]
        if first >= 0 and _is_affected(indices, stepped, number, n_values, n_memory):
            even, x, y = plane(inputs[first:], body, load, inputs[indices.memory[number] :])
            planes[number, 0], planes[number, 1], planes[number, 2] = even - x * dx - y * dy, x, y

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


def _with_load(others: Equation, effect: Effect, load: Equation, number: int) -> Equation:
    n_values, n_memory = len(effect.parameters), effect.memory.size if effect.memory else 0

    @equation
    def loads(indices: InputIndices, inputs: Any, stepped: int, body: Body, arms: Float64Array, dx: Any, dy: Any, factors: Any) -> None:
        others(indices, inputs, stepped, body, arms, dx, dy, factors)
        first = indices.values[number]
        if first < 0:
            return
        if not _is_affected(indices, stepped, number, n_values, n_memory):
            factors[number] = 0.0
            return
        p, memory = _four(inputs, first), _four(inputs, indices.memory[number])
        for i in range(arms.shape[1]):
            factors[number, i] = load(p, body, _cell_of(body, arms[0, i] - dx, arms[1, i] - dy), memory)

    return loads


def _with_skew(others: Equation, skew: Equation, number: int) -> Equation:
    @equation
    def skews(indices: InputIndices, inputs: Any, body: Body) -> Any:
        a, b = others(indices, inputs, body)
        if indices.values[number] >= 0:
            more_a, more_b = skew(inputs[indices.values[number] :], body)
            a, b = a + more_a, b + more_b
        return a, b

    return skews


def _with_pull(others: Equation, pull: Equation, number: int) -> Equation:
    @equation
    def pulls(indices: InputIndices, inputs: Any, body: Body) -> Any:
        fx, fy, torque = others(indices, inputs, body)
        if indices.values[number] >= 0:
            more_x, more_y, more_torque = pull(inputs[indices.values[number] :], body)
            fx, fy, torque = fx + more_x, fy + more_y, torque + more_torque
        return fx, fy, torque

    return pulls


def _with_memory(others: Equation, remember: Equation, number: int) -> Equation:
    @equation
    def memories(indices: InputIndices, inputs: Any, body: Body, dt: float, after: Any) -> None:
        others(indices, inputs, body, dt, after)
        if indices.values[number] >= 0:
            at = indices.memory[number]
            remember(inputs[indices.values[number] :], body, dt, inputs[at:], after[at - N_FIXED_INPUTS :])

    return memories


all_planes = _no_plane
all_loads = _no_load
all_skews = _no_skew
all_pulls = _no_pull
all_memories = _no_memory
for _number, _effect in enumerate(EFFECTS.values()):
    if isinstance(_effect.acts, OnTable):
        if _effect.acts.load is not None:
            all_loads = _with_load(all_loads, _effect, _effect.acts.load, _number)
        if _effect.acts.plane is not None:
            all_planes = _with_plane(all_planes, _effect, _alike(_effect.acts.plane), _number)
        if _effect.acts.shift is not None:
            all_planes = _with_plane(all_planes, _effect, _tilted(_effect.acts.shift), _number)
        if _effect.acts.skew is not None:
            all_skews = _with_skew(all_skews, _effect.acts.skew, _number)
        if _effect.acts.pull is not None:
            all_pulls = _with_pull(all_pulls, _effect.acts.pull, _number)
    if _effect.memory is not None:
        all_memories = _with_memory(all_memories, _effect.memory.remember, _number)
