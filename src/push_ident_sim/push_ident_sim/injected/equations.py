"""Effects for which the engines have no law of their own, brought about by their equations in the core's catalogue.

Both engines and the sensors use this. An effect in a file of its own can so be injected with nothing else touched; what it cannot do is
check the core, as both then evaluate the same equation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from push_ident.physics.effect import (
    Body,
    Cell,
    Effect,
    Load,
    OnContact,
    OnForces,
    OnForceTimes,
    OnPoses,
    OnPusherFriction,
    OnPusherPath,
    OnTable,
    OnTimes,
)
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array
from push_ident_sim.injected.effects import INJECTED, InjectedEffects
from push_ident_sim.objects import SimObject


def _injected(effects: InjectedEffects, kind: type) -> Iterator[tuple[Effect, Float64Array]]:
    """Effects that act in one way and have no law of their own in the engines, with their values."""
    for name, values in effects.values:
        if not INJECTED[name].has_own_law and isinstance(EFFECTS[name].acts, kind):
            yield EFFECTS[name], np.array(values)


def acts_by_equation(effects: InjectedEffects, kind: type) -> bool:
    """Whether an effect without a law of its own acts in one way, such as `OnTable`."""
    return any(True for _ in _injected(effects, kind))


# --- pusher


def contact_quantity(effects: InjectedEffects, quantity: str) -> float:
    """Sum of what such effects add to a quantity of the contact, `offset` [m] or `restitution`."""
    acting = _injected(effects, OnContact)
    return float(sum(values[0] for effect, values in acting if isinstance(effect.acts, OnContact) and effect.acts.quantity == quantity))


def pusher_friction(effects: InjectedEffects, coefficient: float) -> float:
    """Friction coefficient of the pusher under such effects."""
    for effect, values in _injected(effects, OnPusherFriction):
        assert isinstance(effect.acts, OnPusherFriction)
        coefficient = float(effect.acts.change(values.astype(np.complex128), np.array([coefficient], dtype=np.complex128))[0].real)
    return coefficient


def driven_position(effects: InjectedEffects, time_step: float, reported: Float64Array, order: int) -> Float64Array:
    """Where the tool is at the end of a path (x, y) [m], shape (2,), that the arm `reported` [m], shape (n, 2), every `time_step` [s],
    after `order` pushes."""
    path = np.zeros((len(reported), 3), dtype=np.complex128)
    path[:, :2] = reported
    for effect, values in _injected(effects, OnPusherPath):
        assert isinstance(effect.acts, OnPusherPath)
        path = effect.acts.move(values.astype(np.complex128), time_step, path, float(order))
    return np.asarray(path[-1, :2].real)


# --- sensors


def _changed(effects: InjectedEffects, kind: type, method: str, given: Float64Array) -> Float64Array:
    """What effects of one kind make of numbers by a method of theirs."""
    for effect, values in _injected(effects, kind):
        change = getattr(effect.acts, method)
        given = np.ascontiguousarray(change(values.astype(np.complex128), given.astype(np.complex128)).real)
    return given


def reported_poses(effects: InjectedEffects, pose: Float64Array) -> Float64Array:
    """What is reported of true poses (x, y, yaw), shape (n, 3), under such effects."""
    return _changed(effects, OnPoses, "report", pose)


def reported_forces(effects: InjectedEffects, force: Float64Array) -> Float64Array:
    """What is reported of true forces [N], shape (n, 2), table frame, under such effects."""
    return _changed(effects, OnForces, "report", force)


def times_of_poses(effects: InjectedEffects, time: Float64Array) -> Float64Array:
    """When the poses were measured that are reported for `time` [s], shape (n,), under such effects."""
    return _changed(effects, OnTimes, "move", time)


def times_of_forces(effects: InjectedEffects, time: Float64Array) -> Float64Array:
    """When the forces were measured that are reported for `time` [s], shape (n,), under such effects."""
    return _changed(effects, OnForceTimes, "move", time)


# --- table


@dataclass(frozen=True, slots=True)
class TableChange:
    """What such effects do between table and object during one time step."""

    factor: Float64Array
    """Of the friction limit of each cell, shape (n_cells,)."""
    skew: Float64Array
    """(a, b) of E = [[a, b], [b, -a]] in friction -f (I + E) v/|v|, object axes, shape (2,)."""
    wrench: Float64Array
    """(fx, fy) [N], axes of the table, and torque about the centre of mass [N m], shape (3,)."""


class TableEquations:
    """Such effects between table and one object, time step by time step; they hold during a step, as in the core."""

    def __init__(self, sim_object: SimObject, effects: InjectedEffects) -> None:
        self._acting = list(_injected(effects, OnTable))
        self._mass = float(sim_object.mass.sum())
        self._arms = sim_object.cells - sim_object.mass @ sim_object.cells / self._mass
        self._spread = float(np.mean(np.sum(self._arms**2, axis=1)) + sim_object.cell_size**2 / 6.0)
        self.start()

    def __bool__(self) -> bool:
        """Whether there is any."""
        return bool(self._acting)

    def start(self) -> None:
        """A push begins: no effect remembers the one before."""
        self._memory = [np.zeros(0 if effect.memory is None else effect.memory.size) for effect, _ in self._acting]

    def advance(self, pose: Float64Array, velocity: Float64Array, limit: Float64Array, time_step: float, pushes_done: int) -> TableChange:
        """The next time step.

        Args:
            pose: (x, y) of the centre of mass and yaw.
            velocity: of them [m/s, m/s, rad/s].
            limit: friction force of each cell when it slides, without these effects [N], shape (n_cells,).
            time_step: [s].
            pushes_done: before this one.
        """
        cos, sin = float(np.cos(pose[2])), float(np.sin(pose[2]))
        x, y, vx, vy, omega = (float(v) for v in (*pose[:2], *velocity))
        body = Body(x, y, cos, sin, vx, vy, omega, self._mass, self._spread, float(pushes_done))
        factor, skew, wrench = np.ones(len(limit)), np.zeros(2), np.zeros(3)
        for i, (effect, values) in enumerate(self._acting):
            acts, memory = effect.acts, self._memory[i]
            assert isinstance(acts, OnTable)
            factor *= self._factor(acts, values, body, memory, limit)
            if acts.skew is not None:
                skew += acts.skew(values, body)
            if acts.pull is not None:
                wrench += acts.pull(values, body)
            if effect.memory is not None:
                self._memory[i] = np.zeros(effect.memory.size)
                effect.memory.remember(values, body, time_step, memory, self._memory[i])
        return TableChange(np.maximum(factor, 0.0), skew, wrench)

    def _factor(self, acts: OnTable, values: Float64Array, body: Body, memory: Float64Array, limit: Float64Array) -> Float64Array:
        """Factor of the friction limit of each cell, shape (n_cells,)."""
        factor = np.ones(len(limit))
        if acts.load is not None:
            factor *= [acts.load(values, body, cell, memory) for cell in self._cells(body)]
        if acts.plane is not None:
            even, x, y = acts.plane(values, body, memory)
            factor *= even + self._arms @ np.array([x, y])
        if acts.shift is not None:
            centre = limit @ self._arms / limit.sum()
            away = self._arms - centre
            covariance = (limit[:, None] * away).T @ away / limit.sum()
            load = Load(float(centre[0]), float(centre[1]), float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1]))
            factor *= 1.0 + away @ np.linalg.solve(covariance, np.array(acts.shift(values, body, load, memory)))
        return factor

    def _cells(self, body: Body) -> Iterator[Cell]:
        for rx, ry in self._arms.tolist():
            x, y = body.cos * rx - body.sin * ry, body.sin * rx + body.cos * ry
            yield Cell(body.x + x, body.y + y, body.vx - body.omega * y, body.vy + body.omega * x, rx, ry)
