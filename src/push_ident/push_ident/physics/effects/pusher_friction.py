"""The pusher is rougher or smoother than assumed."""

from __future__ import annotations

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, ExportAs, Law, OnPusherFriction, Rival


def _changed(values: ComplexArray, coefficient: ComplexArray) -> ComplexArray:
    changed = coefficient + values[0]
    # A friction coefficient is never negative.
    return changed if changed[0].real > 0.0 else 0.0 * changed


EFFECT = Effect(
    name="pusher_friction",
    what="The pusher's friction coefficient is not the nominal one.",
    equation="max(0, mu_p + excess)",
    parameters=(EffectParameter("excess", "", "above the coefficient of the model", scale=0.15, typical=0.15, low=-2.0, high=2.0),),
    acts=OnPusherFriction(_changed),
    law=Law.APPROXIMATE,
    signature="Slip along the face: oblique and off-centre pushes.",
    rivals=(Rival("push_height", "pushes mirrored at +-20 degrees"),),
    check="Verify that the tip of the pusher does not rotate; cover it with a tape of known friction.",
    source="Coulomb's law at the contact (the paper's mu_p). A rotating tip has less friction. A fit of the coefficient absorbs it.",
    export=ExportAs.PUSHER_FRICTION,
)
