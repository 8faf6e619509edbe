"""Poses are older than their stamps."""

from __future__ import annotations

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnTimes, Rival


def _delayed(values: ComplexArray, time: ComplexArray) -> ComplexArray:
    return time - values[0]


EFFECT = Effect(
    name="pose_latency",
    what="Each pose was measured earlier than its time stamp.",
    equation="reported(t) = pose(t - delta)",
    parameters=(EffectParameter("delta", "s", "age of a pose at its stamp", scale=0.1, typical=0.02, low=-0.3, high=0.3),),
    acts=OnTimes(_delayed),
    law=Law.EXACT,
    signature="Speed of the object times delta; zero at rest.",
    rivals=(
        Rival("pusher_lag", "frames after the stop, where it fades"),
        Rival("pusher_speed_scale", "frames at rest after the push, where it stays"),
    ),
    check="Tap the object with the tool and compare the stamps of the tool and of the first moved pose.",
    source="Delay of exposure, transport and tracking that the stamps do not account for.",
    refit_with=("pusher_lag", "pusher_speed_scale"),
)
