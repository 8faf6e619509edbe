"""Object and pusher separate after an impact."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import Body, Effect, EffectParameter, Law, Memory, OnContact, Rival, equation


@equation
def _remember(p: Any, body: Body, dt: float, memory: Any, after: Any) -> None:
    after[0], after[1], after[2] = body.vx, body.vy, body.omega


EFFECT = Effect(
    name="restitution",
    what="Object and pusher separate after an impact.",
    equation="n (v_object - v_pusher) after = e times their speed of approach (Newton's law), in the step after the gap closed",
    parameters=(EffectParameter("e", "", "coefficient of restitution", scale=0.2, typical=0.3, low=0.0, high=1.0),),
    acts=OnContact("restitution"),
    law=Law.APPROXIMATE,
    memory=Memory(3, _remember),
    needs_inertia=True,
    signature="First frames after the first touch; increases with the speed of impact. Hardly visible at 0.25 m/s and below.",
    rivals=(Rival("pusher_lag", "fast impacts at a high frame rate"), Rival("pose_latency", "fast impacts at a high frame rate")),
    check="Film an impact at a high frame rate.",
    source="Newton's law of impact, as in the paper's model of contact (there with e = 0).",
    is_abrupt=True,
)
