"""Effects at the contact, at the table and on the path of the tool, as both engines need them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.physics.effect import OnPusherPath
from push_ident.types import Float64Array
from push_ident_sim.injected.effects import InjectedEffects
from push_ident_sim.injected.equations import acts_by_equation, contact_quantity, driven_position, pusher_friction
from push_ident_sim.objects import SimObject


def friction_of_pusher(effects: InjectedEffects, nominal: float) -> float:
    """Friction coefficient of the pusher on the object where it is `nominal` without effects."""
    return pusher_friction(effects, max(0.0, nominal + effects["pusher_friction"][0]))


def outline_growth(effects: InjectedEffects) -> float:
    """By how much the surface lies outside the outline [m]."""
    return effects["outline_error"][0] + contact_quantity(effects, "offset")


def restitution(effects: InjectedEffects) -> float:
    """Coefficient of restitution of object and pusher."""
    return effects["restitution"][0] + contact_quantity(effects, "restitution")


def bearing_torque(effects: InjectedEffects) -> float:
    """Friction torque of the finger about its own axis [N m], if it turns at all."""
    (ease,) = effects["rolling_finger"]
    return 0.02 * (1.0 - ease)


def mean_friction(sim_object: SimObject) -> float:
    """Friction coefficient of the whole object, each cell under its own weight."""
    return float(sim_object.friction @ sim_object.mass / sim_object.mass.sum())


def push_height(effects: InjectedEffects, sim_object: SimObject) -> float:
    """Height above the table at which `thing` is pushed [m].

    The effect states the lever, friction coefficient times height, as in the core: poses do not determine the two separately.
    """
    (lever,) = effects["push_height"]
    return lever / mean_friction(sim_object) if lever else 0.0


def tether_anchor(effects: InjectedEffects, first_centre: Float64Array) -> Float64Array:
    """Place on the table where the spring of a tether is relaxed [m], shape (2,).

    That is `first_centre` [m], shape (2,), where the object's centre of mass was put down, unless the effect states a pull. Raises
    InputError for a pull without stiffness, which has no such place.
    """
    stiffness, *pull = effects["tether"]
    if not pull:
        return first_centre
    if stiffness == 0.0:
        raise InputError("The tether has a pull and no stiffness; give it a stiffness > 0, or use table_tilt for a constant force.")
    return np.array(pull) / stiffness


_ACTING = ("pusher_lag", "pusher_speed_scale", "tool_offset", "tool_drift", "pusher_wobble")


class ToolErrors:
    """The true place of the tool, step by step; positions (x, y) in `table` [m]."""

    def __init__(self, effects: InjectedEffects, time_step: float) -> None:
        """`time_step` [s] between two calls of `true_position`."""
        (lag,), (self._scale,) = effects["pusher_lag"], effects["pusher_speed_scale"]
        self._offset, self._drift = np.array(effects["tool_offset"]), np.array(effects["tool_drift"])
        self.pushes_done = 0
        self._radius, frequency = effects["pusher_wobble"]
        self._turn = 2.0 * np.pi * frequency * time_step
        self._lag_share = 1.0 - np.exp(-time_step / lag) if lag > 0 else 1.0
        self._n_steps = 0
        self._effects, self._time_step = effects, time_step
        self._by_equation = acts_by_equation(effects, OnPusherPath)
        self.start(np.zeros(2))

    @staticmethod
    def needed(effects: InjectedEffects) -> bool:
        """Whether any effect acts on the tool's place."""
        return any(name in effects for name in _ACTING) or acts_by_equation(effects, OnPusherPath)

    def start(self, reported: ArrayLike) -> None:
        """A motion begins where the arm reports `reported`."""
        self._start = np.array(reported, dtype=np.float64)
        self._lagged = self._start.copy()
        self._reported_path = [self._start.copy()]

    def true_position(self, reported: Float64Array) -> Float64Array:
        """Where the tool is at the end of a time step at whose end the arm reports `reported`."""
        self._n_steps += 1
        if self._by_equation:
            self._reported_path.append(np.array(reported))
            reported = driven_position(self._effects, self._time_step, np.array(self._reported_path), self.pushes_done)
        ahead = reported + self._scale * (reported - self._start)
        self._lagged = self._lagged + self._lag_share * (ahead - self._lagged)
        angle = self._turn * self._n_steps
        return np.asarray(
            self._lagged + self._offset + self.pushes_done * self._drift + self._radius * np.array([np.cos(angle), np.sin(angle)])
        )
