"""The object is slightly larger or smaller than its outline."""

from __future__ import annotations

from push_ident.physics.effect import Effect, EffectParameter, Law, Mechanism, OnContact, Rival

EFFECT = Effect(
    name="outline_error",
    what="The surface that the pusher touches lies outside (> 0) or inside (< 0) the outline, or the pusher's radius is larger or smaller "
    "by as much, which is the same to the pushes.",
    equation="gap - offset; contact point + offset n",
    parameters=(
        EffectParameter(
            "offset", "m", "of the surface along the outward normal", scale=2e-3, typical=1e-3, camera_std=4e-4, low=-0.01, high=0.01
        ),
    ),
    acts=OnContact("offset"),
    law=Law.EXACT,
    signature="Constant along the contact normal, from the first touch on.",
    rivals=(
        Rival("pusher_lag", "several speeds: it grows with speed"),
        Rival("pose_latency", "several speeds: it grows with speed"),
        Rival("tool_offset", "several faces: it is fixed in the table"),
    ),
    check="Measure both with a calliper: the object, and the diameter of the pusher; pushes cannot tell one error from the other.",
    source="Offset curve of the outline; equivalent to an error of the pusher's radius.",
    law_of=Mechanism.OUTLINE,
)
