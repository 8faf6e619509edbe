"""The pusher moves further, or less far, than its reported path."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnPusherPath, Rival


def _move(values: ComplexArray, dt: Any, path: ComplexArray, order: float) -> ComplexArray:
    driven = path.copy()
    driven[:, :2] += values[0] * (path[:, :2] - path[0, :2])
    return driven


EFFECT = Effect(
    name="pusher_speed_scale",
    what="The pusher moves faster than its reported path from the same start.",
    equation="p = p0 + (1 + s) (p_reported - p0)",
    parameters=(EffectParameter("s", "", "relative excess of speed", scale=0.03, typical=0.03, low=-0.3, high=0.3),),
    acts=OnPusherPath(_move),
    law=Law.EXACT,
    signature="Grows in proportion to the pusher's travel.",
    rivals=(
        Rival("pose_latency", "pushes of two lengths at one speed: it ends with the motion"),
        Rival("pusher_lag", "pushes of two lengths at one speed: it ends with the motion"),
    ),
    check="Measure the length of a long move of the tool with a ruler.",
    source="Scale error of a drive or of its clock.",
    refit_with=("pusher_lag", "pose_latency"),
)
