"""Friction changes from push to push."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import MAPS, Body, Effect, EffectParameter, Law, Mechanism, OnTable, Rival, equation


@equation
def _plane(p: Any, body: Body, memory: Any) -> Any:
    nothing = 0.0 * body.mass
    return 1.0 + p[0] * body.order + nothing, nothing, nothing


EFFECT = Effect(
    name="wear",
    what="Friction changes with every push, as surfaces are polished or collect dirt.",
    equation="f (1 + w n), n: number of pushes before",
    parameters=(EffectParameter("w", "", "change of friction per push", scale=0.02, typical=0.02, low=-0.2, high=0.2),),
    acts=OnTable(plane=_plane),
    law=Law.APPROXIMATE,
    signature="Drift of the motion from push to push.",
    rivals=(Rival(MAPS, "the first push repeated at the end, or pushes in random order"),),
    check="Repeat the first push last.",
    source="First-order drift; Yu, Bauza, Fazeli & Rodriguez, More than a million ways to be pushed, 2016.",
    follows_order=True,
    law_of=Mechanism.FRICTION_BY_ORDER,
)
