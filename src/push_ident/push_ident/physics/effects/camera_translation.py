"""The camera is displaced."""

from __future__ import annotations

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnPoses, Rival


def _reported(values: ComplexArray, pose: ComplexArray) -> ComplexArray:
    reported = pose.copy()
    reported[:, :2] += values
    return reported


EFFECT = Effect(
    name="camera_translation",
    what="All reported poses are displaced, in directions fixed in the table.",
    equation="reported = pose + (x, y)",
    parameters=(
        EffectParameter("x", "m", "displacement along the table's x axis", scale=2e-3, typical=2e-3, camera_std=5e-4, low=-0.05, high=0.05),
        EffectParameter("y", "m", "displacement along the table's y axis", scale=2e-3, typical=2e-3, camera_std=5e-4, low=-0.05, high=0.05),
    ),
    acts=OnPoses(_reported),
    law=Law.EXACT,
    signature="A contact offset that is fixed in the table. The first pose is displaced as well.",
    rivals=(Rival("tool_offset", "no push: only a measurement of a known mark"),),
    check="Measure a mark of known position with the camera.",
    source="Error of the camera's extrinsic calibration.",
    exact_twins=("tool_offset",),
)
