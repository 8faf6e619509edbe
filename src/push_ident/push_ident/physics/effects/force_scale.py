"""The force sensor reads a multiple of the force."""

from __future__ import annotations

from push_ident.physics.effect import MAPS, ComplexArray, Effect, EffectParameter, Law, OnForces, Rival


def _feel(values: ComplexArray, force: ComplexArray) -> ComplexArray:
    return force * (1.0 + values[0])


EFFECT = Effect(
    name="force_scale",
    what="Measured forces are a multiple of the true ones.",
    equation="F_reported = (1 + k) F",
    parameters=(EffectParameter("k", "", "error of the scale", scale=0.2, typical=0.2, low=-0.9, high=10.0),),
    acts=OnForces(_feel),
    law=Law.EXACT,
    signature="All forces too large, or too small, by one factor.",
    rivals=(Rival(MAPS, "the weight of the object: without it a heavier object, or more friction, does the same"),),
    check="Hang a known weight on the tool.",
    source="Calibration of the sensor, or a wrong unit.",
)
