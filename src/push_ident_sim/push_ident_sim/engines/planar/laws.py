"""Parameters of the laws of the planar engine, and the effects that only this engine has."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from push_ident.errors import InputError
from push_ident.physics.effect import Mechanism
from push_ident_sim.injected import InjectedEffect, InjectedEffects, InjectedParameter
from push_ident_sim.injected.shared import bearing_torque, friction_of_pusher, outline_growth, push_height, restitution, tether_anchor
from push_ident_sim.objects import SimObject


class _Constants(NamedTuple):
    """Numbers of the planar world that no effect changes."""

    contact_stiffness: float = 2e5
    """[N/m]"""
    contact_travel: float = 2e-5
    """Deflection at which the tangential bristle of a contact slides [m]."""
    travel: float = 2e-5
    """Deflection at which a bristle under a cell slides, unless the table is compliant [m]."""
    bed_time: float = 5e-3
    """In which the bed gives way under a moment [s]."""
    bristle_damping: float = 1.0
    """Of a bristle that does not slide, as a share of critical damping [1]."""
    finger_mass: float = 0.02
    """Of a finger that turns [kg]."""
    magnet: tuple[float, float] = (0.03, -0.04)
    """Position of the magnet on the table [m]."""
    magnet_reach: float = 0.04
    """Distance at which it pulls most [m]."""
    spot_reach: float = 0.06
    """Standard deviation of the greasy spot [m]."""
    cold_travel: float = 0.02
    """Travel in which friction warms up [m]."""
    gust_rate: float = 2.0 * np.pi * 1.5
    """[rad/s]"""
    moving: float = 5e-3
    """Loose contents slide while the object is faster than this [m/s]."""
    min_factor: float = 0.05
    """Share of its friction that a cell keeps [1]."""
    still_rows: int = 30
    """For which the object rests before a push is over."""


CONSTANTS = _Constants()


def _outside(name: str, size: tuple[str, float, float], what: str, mechanism: Mechanism | None = None) -> InjectedEffect:
    """`size`: its unit, typical and highest value."""
    unit, typical, highest = size
    parameter = InjectedParameter("size", unit, typical, 0.0, highest)
    return InjectedEffect(name, "table", (parameter,), what, "a law of the planar engine", mechanism.value if mechanism else "")


OUTSIDE: dict[str, InjectedEffect] = {
    effect.name: effect
    for effect in (
        _outside(
            "magnet",
            ("N", 0.4, 4.0),
            "A magnet under the table draws the centre of mass to one spot, with at most this force, 40 mm from it.",
            Mechanism.FORCE_ON_OBJECT,
        ),
        _outside(
            "greasy_spot",
            ("1", 0.5, 0.95),
            "Friction is lower by this share in a spot of 60 mm in the middle of the table.",
            Mechanism.FRICTION_BY_PLACE,
        ),
        _outside(
            "heating_friction",
            ("1", 0.4, 0.9),
            "Friction of a cell falls by this share within 20 mm of sliding; each push starts cold.",
            Mechanism.FRICTION_SINCE_CONTACT,
        ),
        _outside(
            "friction_linear_in_speed", ("1", 0.3, 2.0), "Friction grows by this share with every 0.1 m/s.", Mechanism.FRICTION_BY_SPEED
        ),
        _outside(
            "friction_step",
            ("1", 0.3, 2.0),
            "Friction is higher by this share on one half of the table, where x > 0.",
            Mechanism.FRICTION_BY_PLACE,
        ),
        _outside("gust", ("N", 0.4, 4.0), "A pull along y that oscillates at 1.5 Hz, with another phase in each push."),
    )
}
"""Effects that only this engine has, by name: laws that the catalogue of the core does not hold, some of them of its mechanisms."""


class Laws(NamedTuple):
    """Parameters that hold during one push; lengths [m], forces [N], times [s], angles [rad]. Zero where an effect is absent."""

    # Contact of pusher and object
    pusher_radius: float
    outline_offset: float
    """Distance of the surface outside the outline."""
    pusher_friction: float
    contact_stiffness: float
    """[N/m]"""
    damping_ratio: float
    """Of the contact along its normal: 1 does not bounce."""
    contact_travel: float
    """Deflection at which the tangential bristle slides."""
    finger_radius: float
    """0 where the finger does not turn."""
    bearing_torque: float
    """[N m]"""
    # Table
    gravity: float
    """Across the table [m/s^2]."""
    travel: float
    """Deflection at which a bristle under a cell slides."""
    tilt_x: float
    tilt_y: float
    table_e1: float
    table_e2: float
    base_e1: float
    base_e2: float
    gradient_x: float
    """[1/m]"""
    gradient_y: float
    log_speed: float
    stribeck: float
    stribeck_speed: float
    """[m/s]"""
    level: float
    """Of all friction, by wear."""
    film: float
    """Damping of a cell [N s/m]."""
    greasy: float
    heating: float
    linear_speed: float
    """By 0.1 m/s."""
    step: float
    # Loads and pulls
    height: float
    """Of the centre of mass, and of the pusher, above the table; 0 where loads do not shift."""
    contents: float
    contents_time: float
    tether: float
    """[N/m]"""
    anchor_x: float
    anchor_y: float
    magnet: float
    gust: float
    gust_phase: float


def laws_of(
    effects: InjectedEffects,
    outside: Mapping[str, float],
    sim_object: SimObject,
    *,
    pusher_radius: float,
    gravity: float,
    pushes_done: int,
    first_centre: tuple[float, float],
) -> Laws:
    """The laws of one push.

    `pusher_radius` [m], `gravity` [m/s^2]; `pushes_done` before this one; `first_centre`: the centre of mass where the object was put down
    first [m]. Effects on the tool's path and on what is reported act elsewhere. Raises InputError for an effect of `outside` that is not
    known, or out of its range.
    """
    _check_outside(outside)
    tilt = np.sin(effects["table_tilt"])
    (skin,) = effects["compliant_table"]
    stribeck, stribeck_speed = effects["stribeck_friction"]
    contents, contents_time = effects["moving_contents"]
    anchor = tether_anchor(effects, np.array(first_centre))
    return Laws(
        **_contact_laws(effects, sim_object, pusher_radius),
        gravity=float(gravity * np.sqrt(1.0 - tilt @ tilt)),
        travel=skin if skin > 0.0 else CONSTANTS.travel,
        tilt_x=float(gravity * tilt[0]),
        tilt_y=float(gravity * tilt[1]),
        table_e1=effects["table_anisotropy"][0],
        table_e2=effects["table_anisotropy"][1],
        base_e1=effects["base_anisotropy"][0],
        base_e2=effects["base_anisotropy"][1],
        gradient_x=effects["position_dependent_friction"][0],
        gradient_y=effects["position_dependent_friction"][1],
        log_speed=effects["speed_dependent_friction"][0],
        stribeck=stribeck,
        stribeck_speed=stribeck_speed,
        level=1.0 + effects["wear"][0] * pushes_done,
        film=effects["viscous_film"][0] / len(sim_object),
        greasy=outside.get("greasy_spot", 0.0),
        heating=outside.get("heating_friction", 0.0),
        linear_speed=outside.get("friction_linear_in_speed", 0.0),
        step=outside.get("friction_step", 0.0),
        height=push_height(effects, sim_object),
        contents=contents,
        contents_time=contents_time,
        tether=effects["tether"][0],
        anchor_x=float(anchor[0]),
        anchor_y=float(anchor[1]),
        magnet=outside.get("magnet", 0.0),
        gust=outside.get("gust", 0.0),
        gust_phase=2.0 * np.pi * ((0.618034 * pushes_done) % 1.0),
    )


def _contact_laws(effects: InjectedEffects, sim_object: SimObject, pusher_radius: float) -> dict[str, float]:
    rolls = "rolling_finger" in effects
    return {
        "pusher_radius": pusher_radius,
        "outline_offset": outline_growth(effects),
        "pusher_friction": friction_of_pusher(effects, sim_object.pusher_friction),
        "contact_stiffness": CONSTANTS.contact_stiffness,
        "damping_ratio": _damping_ratio(restitution(effects)),
        "contact_travel": CONSTANTS.contact_travel,
        "finger_radius": pusher_radius if rolls else 0.0,
        "bearing_torque": bearing_torque(effects) if rolls else 0.0,
    }


def _check_outside(outside: Mapping[str, float]) -> None:
    for name, size in outside.items():
        if name not in OUTSIDE:
            raise InputError(f"Effect {name!r} is not known to the planar engine, expected some of {', '.join(OUTSIDE)}.")
        (parameter,) = OUTSIDE[name].parameters
        if not 0.0 <= size <= parameter.highest:
            raise InputError(f"Effect {name} is {size:g} {parameter.unit}, expected 0 to {parameter.highest:g}.")


def _damping_ratio(bounce: float) -> float:
    """Of a spring and damper that part two bodies with `bounce` times their speed of approach."""
    log_bounce = np.log(max(bounce, 1e-6))
    return float(-log_bounce / np.hypot(np.pi, log_bounce)) if bounce > 0.0 else 1.0
