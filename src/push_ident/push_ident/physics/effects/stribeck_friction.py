"""Friction is higher at low speed."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import Body, Cell, Effect, EffectParameter, Law, Mechanism, OnTable, Rival, analytic_exp, equation


@equation
def _load(p: Any, body: Body, cell: Cell, memory: Any) -> Any:
    return 1.0 + p[0] * analytic_exp(-(cell.vx * cell.vx + cell.vy * cell.vy) / (p[1] * p[1]))


EFFECT = Effect(
    name="stribeck_friction",
    what="Friction is higher at low speed.",
    equation="f (1 + s exp(-(v / v_s)^2))",
    parameters=(
        EffectParameter("s", "", "relative increase of friction at rest", scale=0.2, typical=0.2, low=-0.5, high=2.0),
        EffectParameter("v_s", "m/s", "speed at which it fades", scale=0.01, typical=0.01, nominal=0.02, low=0.002, high=0.2, shape=True),
    ),
    acts=OnTable(load=_load),
    law=Law.APPROXIMATE,
    signature="Only below about 30 mm/s, at stops and starts. Hardly visible at usual speeds.",
    rivals=(Rival("speed_dependent_friction", "pushes below 30 mm/s"),),
    check="Repeat a push at 10 mm/s.",
    source="Bo & Pavelescu, The friction-speed relation and its influence on the critical velocity of stick-slip motion, Wear 82, 1982.",
    law_of=Mechanism.FRICTION_BY_SPEED,
)
