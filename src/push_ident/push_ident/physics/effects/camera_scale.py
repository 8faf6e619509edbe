"""Lengths in the camera are too long, or too short."""

from __future__ import annotations

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnPoses, Rival

__all__ = ["EFFECT"]


def _see(values: ComplexArray, pose: ComplexArray) -> ComplexArray:
    seen = pose.copy()
    seen[:, :2] += values[0] * pose[:, :2]
    return seen


EFFECT = Effect(
    name="camera_scale",
    what="Distances from the origin of the table frame are reported too long.",
    equation="reported = (1 + kappa) (x, y); outline and cells stay as they are given",
    parameters=(
        EffectParameter("kappa", "", "share that distances are too long", scale=0.02, typical=0.02, camera_std=5e-3, low=-0.2, high=0.2),
    ),
    acts=OnPoses(_see),
    law=Law.EXACT,
    signature="Grows with the distance from the origin of the table.",
    rivals=(
        Rival("outline_error", "pushes all over the table"),
        Rival("pusher_speed_scale", "pushes all over the table"),
        Rival("position_dependent_friction", "pushes all over the table"),
    ),
    check="Look at two marks of known distance with the camera.",
    source="Error of focal length or height of the camera.",
)
