"""Effects at the contact and at the table, as the numbers that both engines need."""

from __future__ import annotations

import numpy as np

from push_ident.errors import InputError
from push_ident.types import Float64Array
from push_ident_sim.injected.effects import InjectedEffects
from push_ident_sim.injected.equations import contact_quantity, pusher_friction
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

    Args:
        effects: of the world.
        first_centre: the object's centre of mass where it was put down [m], shape (2,); the place where the effect states none.

    Raises:
        InputError: a pull without stiffness, which has no such place.
    """
    stiffness, *pull = effects["tether"]
    if not pull:
        return first_centre
    if stiffness == 0.0:
        raise InputError("The tether has a pull and no stiffness; give it a stiffness > 0, or use table_tilt for a constant force.")
    return np.array(pull) / stiffness
