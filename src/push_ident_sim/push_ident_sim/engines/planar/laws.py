"""The numbers of every law that the planar engine knows, and effects that only it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from push_ident.errors import InputError
from push_ident_sim.injected import Effects

__all__ = ["OUTSIDE", "Laws", "Outside", "laws_of"]


@dataclass(frozen=True, slots=True)
class Outside:
    """An effect for which a diagnosis has no name, known to this engine alone."""

    name: str
    unit: str
    typical: float
    largest: float
    what: str


OUTSIDE: dict[str, Outside] = {
    effect.name: effect
    for effect in (
        Outside("magnet", "N", 0.4, 4.0, "a magnet under the table draws the centre of mass to one spot, at most by this at 40 mm from it"),
        Outside("greasy_spot", "1", 0.5, 0.95, "friction is lower by this share in a spot of 60 mm in the middle of the table"),
        Outside(
            "heating_friction", "1", 0.4, 0.9, "friction of a cell falls by this share while it slides, within 20 mm; the next push is cold"
        ),
        Outside("gust", "N", 0.4, 4.0, "a pull along y that swings at 1.5 Hz, another phase each push"),
    )
}
"""By name; all sizes are >= 0."""


class Laws(NamedTuple):
    """What holds during one push; lengths [m], forces [N], times [s], angles [rad]. Zero where an effect is absent."""

    # Contact of pusher and object
    pusher_radius: float
    outline_offset: float
    """By which the surface lies outside the outline."""
    pusher_friction: float
    contact_stiffness: float
    """[N/m]"""
    damping_ratio: float
    """Of the contact along its normal: 1 does not bounce."""
    contact_travel: float
    """By which the tangential bristle bends before it slides."""
    finger_radius: float
    """0 where the finger does not turn."""
    bearing_torque: float
    """[N m]"""
    # Table
    gravity: float
    """Across the table [m/s^2]."""
    travel: float
    """By which a bristle under a cell bends before it slides."""
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
    effects: Effects,
    outside: Mapping[str, float],
    *,
    pusher_radius: float,
    pusher_friction: float,
    gravity: float,
    n_cells: int,
    pushes_done: int,
    anchor: tuple[float, float],
) -> Laws:
    """The laws of one push.

    Args:
        effects: of the catalogue; those on the tool's path and on what is seen are not of this place.
        outside: sizes of effects of `OUTSIDE`.
        pusher_radius: [m].
        pusher_friction: without effects.
        gravity: [m/s^2].
        n_cells: of the object.
        pushes_done: before this one.
        anchor: of a tether [m].
    """
    for name, size in outside.items():
        if name not in OUTSIDE:
            raise InputError(f"Effect {name!r} is not known to the planar engine, expected some of {', '.join(OUTSIDE)}.")
        if not 0.0 <= size <= OUTSIDE[name].largest:
            raise InputError(f"Effect {name} is {size:g} {OUTSIDE[name].unit}, expected 0 to {OUTSIDE[name].largest:g}.")
    tilt = np.sin(effects["table_tilt"])
    (bounce,), (skin,) = effects["restitution"], effects["compliant_table"]
    log_bounce = np.log(max(bounce, 1e-6))
    stribeck, stribeck_speed = effects["stribeck_friction"]
    contents, contents_time = effects["moving_contents"]
    rolls = "rolling_finger" in effects
    return Laws(
        pusher_radius=pusher_radius,
        outline_offset=effects["outline_error"][0],
        pusher_friction=max(0.0, pusher_friction + effects["pusher_friction"][0]),
        contact_stiffness=2e5,
        damping_ratio=float(-log_bounce / np.hypot(np.pi, log_bounce)) if bounce > 0.0 else 1.0,
        contact_travel=2e-5,
        finger_radius=pusher_radius if rolls else 0.0,
        bearing_torque=0.02 * (1.0 - effects["rolling_finger"][0]) if rolls else 0.0,
        gravity=float(gravity * np.sqrt(1.0 - tilt @ tilt)),
        travel=skin if skin > 0.0 else 2e-5,
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
        film=effects["viscous_film"][0] / n_cells,
        greasy=outside.get("greasy_spot", 0.0),
        heating=outside.get("heating_friction", 0.0),
        height=effects["push_height"][0],
        contents=contents,
        contents_time=contents_time,
        tether=effects["tether"][0],
        anchor_x=anchor[0],
        anchor_y=anchor[1],
        magnet=outside.get("magnet", 0.0),
        gust=outside.get("gust", 0.0),
        gust_phase=2.0 * np.pi * ((0.618034 * pushes_done) % 1.0),
    )
