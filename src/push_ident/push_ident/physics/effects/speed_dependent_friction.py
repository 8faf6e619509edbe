"""Friction increases or decreases with the logarithm of the speed."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import (
    MAPS,
    Body,
    Cell,
    Effect,
    EffectParameter,
    Law,
    Mechanism,
    OnTable,
    Rival,
    analytic_log,
    analytic_sqrt,
    equation,
)


@equation
def _load(p: Any, body: Body, cell: Cell, memory: Any) -> Any:
    reference = 0.1  # speed at which friction equals that of the map [m/s]
    slowest = 0.01  # speed below which friction hardly depends on the speed [m/s]
    rounding = 1e-4  # smooths the speed at rest [m/s]
    speed = analytic_sqrt(cell.vx * cell.vx + cell.vy * cell.vy + rounding * rounding)
    return 1.0 + p[0] * analytic_log((speed + slowest) * (1.0 / (reference + slowest)))


EFFECT = Effect(
    name="speed_dependent_friction",
    what="Friction changes with the logarithm of the speed of each cell.",
    equation="f (1 + b ln((v + 0.01) / (0.1 + 0.01))), v in m/s",
    parameters=(EffectParameter("b", "", "change of friction per factor e of speed", scale=0.1, typical=0.1, low=-0.5, high=0.5),),
    acts=OnTable(load=_load),
    law=Law.APPROXIMATE,
    signature="Distance of coasting; fast rotations compared with slow ones. A film of oil has a similar effect.",
    rivals=(Rival(MAPS, "the same push at 0.04, 0.12 and 0.3 m/s"), Rival("push_height", "the same push at 0.04, 0.12 and 0.3 m/s")),
    check="Verify that there is no film of oil; repeat a push at a quarter of its speed.",
    source="Logarithmic law of rate-dependent friction; Ruina, Slip instability and state variable friction laws, 1983, without state.",
    law_of=Mechanism.FRICTION_BY_SPEED,
)
