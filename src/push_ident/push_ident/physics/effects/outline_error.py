"""The object is a little larger, or smaller, than its outline says."""

from __future__ import annotations

from push_ident.physics.effect import Effect, EffectParameter, OnContact

__all__ = ["EFFECT"]

EFFECT = Effect(
    name="outline_error",
    what="The surface that the pusher meets lies outside (> 0) or inside the outline.",
    equation="gap - offset; contact point + offset n",
    parameters=(EffectParameter("offset", "m", "of the surface along the outward normal", scale=2e-3, typical=1e-3, low=-0.01, high=0.01),),
    acts=OnContact("offset"),
    signature="Constant along the contact normal, from the first touch on.",
    rivals="pusher_lag, pose_latency (both grow with speed), tool_offset (fixed in the table): several faces and speeds.",
    source="Offset curve of the outline; equals an error of the pusher's radius.",
)
