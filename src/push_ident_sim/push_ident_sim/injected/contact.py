"""Effects between pusher and object, as the numbers that both engines need."""

from __future__ import annotations

from push_ident_sim.injected.equations import contact_quantity, pusher_friction
from push_ident_sim.injected.values import InjectedEffects

__all__ = ["bearing_torque", "friction_of_pusher", "outline_growth", "restitution"]


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
