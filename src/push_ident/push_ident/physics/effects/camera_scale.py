"""The camera measures lengths too long or too short."""

from __future__ import annotations

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnPoses, Rival


def _reported(values: ComplexArray, pose: ComplexArray) -> ComplexArray:
    reported = pose.copy()
    reported[:, :2] += values[0] * pose[:, :2]
    return reported


EFFECT = Effect(
    name="camera_scale",
    what="Distances from the origin of the table frame are reported too long.",
    equation="reported = (1 + kappa) (x, y); outline and cells are not scaled",
    parameters=(
        EffectParameter("kappa", "", "relative error of distances", scale=0.02, typical=0.02, camera_std=5e-3, low=-0.2, high=0.2),
    ),
    acts=OnPoses(_reported),
    law=Law.EXACT,
    signature="Grows with the distance from the origin of the table.",
    rivals=(
        Rival("outline_error", "pushes all over the table"),
        Rival("pusher_speed_scale", "pushes all over the table"),
        Rival("position_dependent_friction", "pushes all over the table"),
    ),
    check="Measure two marks of known distance with the camera.",
    source="Error of the focal length or of the height of the camera.",
)
