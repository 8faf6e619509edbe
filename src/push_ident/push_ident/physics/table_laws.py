"""The laws of all effects on the table, one compiled function for each kind: load, plane, skew, pull, memory.

Each function folds in the equations of all effects of its kind: a loop over functions would hide them from the compiler. Into the
equation of a load, which every cell evaluates, values and memory go as numbers: arrays would cost more than the equation.
"""

from __future__ import annotations

from typing import Any

from push_ident.physics.active_effects import N_FIXED_INPUTS, Places
from push_ident.physics.effect import Body, Cell, Effect, Equation, Load, OnTable, equation
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array

__all__ = ["all_loads", "all_memories", "all_planes", "all_pulls", "all_skews"]


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


all_planes = _no_plane
all_loads = _no_load
all_skews = _no_skew
all_pulls = _no_pull
all_memories = _no_memory
for _place, _effect in enumerate(EFFECTS.values()):
    if isinstance(_effect.acts, OnTable):
        if _effect.acts.load is not None:
            all_loads = _with_load(all_loads, _effect, _effect.acts.load, _place)
        if _effect.acts.plane is not None:
            all_planes = _with_plane(all_planes, _effect, _alike(_effect.acts.plane), _place)
        if _effect.acts.shift is not None:
            all_planes = _with_plane(all_planes, _effect, _tilted(_effect.acts.shift), _place)
        if _effect.acts.skew is not None:
            all_skews = _with_skew(all_skews, _effect.acts.skew, _place)
        if _effect.acts.pull is not None:
            all_pulls = _with_pull(all_pulls, _effect.acts.pull, _place)
    if _effect.memory is not None:
        all_memories = _with_memory(all_memories, _effect.memory.remember, _place)
