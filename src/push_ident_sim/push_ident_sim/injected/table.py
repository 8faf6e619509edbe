"""Effects between table and object, as the numbers that both engines need."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError
from push_ident_sim.injected.values import InjectedEffects
from push_ident_sim.objects import SimObject

__all__ = ["mean_friction", "push_height", "tether_anchor"]

FloatArray = NDArray[np.float64]


def mean_friction(sim_object: SimObject) -> float:
    """Friction coefficient of the whole object, each cell under its own weight."""
    return float(sim_object.friction @ sim_object.mass / sim_object.mass.sum())


def push_height(effects: InjectedEffects, sim_object: SimObject) -> float:
    """Height above the table at which `thing` is pushed [m].

    The effect states the lever, friction coefficient times height, as in the core: poses do not determine the two separately.
    """
    (lever,) = effects["push_height"]
    return lever / mean_friction(sim_object) if lever else 0.0


def tether_anchor(effects: InjectedEffects, first_centre: FloatArray) -> FloatArray:
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
