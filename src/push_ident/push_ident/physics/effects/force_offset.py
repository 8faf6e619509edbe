"""The force sensor reads a force where there is none."""

from __future__ import annotations

from push_ident.physics.effect import MAPS, ComplexArray, Effect, EffectParameter, Law, OnForces, Rival


def _feel(values: ComplexArray, force: ComplexArray) -> ComplexArray:
    return force + values


EFFECT = Effect(
    name="force_offset",
    what="Measured forces are displaced by a constant force, in directions fixed in the table.",
    equation="F_reported = F + (x, y)",
    parameters=(
        EffectParameter("x", "N", "offset along the table's x axis", scale=1.0, typical=1.0, low=-100.0, high=100.0, sensor_std=0.1),
        EffectParameter("y", "N", "offset along the table's y axis", scale=1.0, typical=1.0, low=-100.0, high=100.0, sensor_std=0.1),
    ),
    acts=OnForces(_feel),
    law=Law.EXACT,
    signature="A force before the pusher touches, and after it left.",
    rivals=(Rival(MAPS, "samples of the sensor before contact"),),
    check="Read the sensor while the tool touches nothing, and tare it.",
    source="Stale tare, drift of temperature, weight of the tool, cables.",
)
