"""The camera is rotated about the table's normal."""

from __future__ import annotations

import numpy as np

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnPoses, Rival


def _reported(values: ComplexArray, pose: ComplexArray) -> ComplexArray:
    angle = values[0]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, yaw = pose.T
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, yaw + angle])


EFFECT = Effect(
    name="camera_rotation",
    what="All reported poses are rotated about the origin of the table frame.",
    equation="reported = (R(angle) (x, y), yaw + angle)",
    parameters=(EffectParameter("angle", "rad", "counter-clockwise", scale=0.01, typical=0.01, camera_std=2.5e-3, low=-0.3, high=0.3),),
    acts=OnPoses(_reported),
    law=Law.EXACT,
    signature="The direction of reported motion deviates from that of the pusher by the same angle at every heading.",
    rivals=(Rival("table_anisotropy", "pushes all over the table"), Rival("position_dependent_friction", "pushes all over the table")),
    check="Measure two marks of known positions with the camera.",
    source="Error of the camera's extrinsic calibration.",
)
