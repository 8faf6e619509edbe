"""Measured forces are late."""

from __future__ import annotations

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnForceTimes, Rival


def _move(values: ComplexArray, time: ComplexArray) -> ComplexArray:
    return time - values[0]


EFFECT = Effect(
    name="force_delay",
    what="Forces are measured before the time that they are reported for.",
    equation="F_reported(t) = F(t - delta)",
    parameters=(EffectParameter("delta", "s", "age of a reported force", scale=0.02, typical=0.02, low=-0.5, high=0.5, sensor_std=0.02),),
    acts=OnForceTimes(_move),
    law=Law.EXACT,
    signature="Forces rise after the object has begun to move, by the same time in every push.",
    rivals=(Rival("pusher_lag", "nothing that poses show"), Rival("pose_latency", "nothing that poses show")),
    check="Tap the tool and compare the stamps of joint states and forces.",
    source="Filter of the sensor (one of 10 Hz takes 16 ms), clocks, and contacts that give before they push.",
)
