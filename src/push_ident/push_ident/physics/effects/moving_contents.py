"""Contents shift against the motion, and the load with them."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import (
    Body,
    Effect,
    EffectParameter,
    Law,
    Load,
    Memory,
    OnTable,
    Rival,
    Subsystem,
    analytic_exp,
    equation,
    unit_direction,
)  # fmt: skip


@equation
def _shift(p: Any, body: Body, load: Load, memory: Any) -> Any:
    return memory[0], memory[1]


@equation
def _remember(p: Any, body: Body, dt: float, memory: Any, after: Any) -> None:
    dx, dy = unit_direction(body.cos * body.vx + body.sin * body.vy, body.cos * body.vy - body.sin * body.vx)
    share = 1.0 - analytic_exp(-dt / p[1])
    after[0] = memory[0] + share * (-p[0] * dx - memory[0])
    after[1] = memory[1] + share * (-p[0] * dy - memory[1])


EFFECT = Effect(
    name="moving_contents",
    what="Loose or liquid contents shift against the motion, and the load with them.",
    equation="N_i ~ 1 + (r_i - c)' S^-1 q, tau dq/dt = -shift v - q, q in the object, v the direction of the centre of mass",
    parameters=(
        EffectParameter("shift", "m", "final distance of the load behind the motion", scale=5e-3, typical=5e-3, low=0.0, high=0.05),
        EffectParameter("tau", "s", "time constant of the shift", scale=0.1, typical=0.1, nominal=0.1, low=0.01, high=2.0, shape=True),
    ),
    acts=OnTable(shift=_shift),
    law=Law.APPROXIMATE,
    memory=Memory(2, _remember),
    signature="The first 0.2 s of each push; the centre of friction lags behind the motion.",
    rivals=(
        Rival("push_height", "repeat a push after a wait, and reversed: the load leads at once"),
        Rival("position_dependent_friction", "the same push repeated after a wait, and reversed"),
    ),
    check="Shake the object and listen; wait ten seconds and repeat a push.",
    source="First-order model of sloshing; q moves the centre of friction c; c and the covariance S weigh cells by their limits.",
    refit_with=("push_height", "position_dependent_friction"),
    within=Subsystem.OBJECT,
)
