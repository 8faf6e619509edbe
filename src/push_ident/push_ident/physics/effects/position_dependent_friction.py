"""Friction varies with the position on the table."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import Body, Effect, EffectParameter, Law, Mechanism, OnTable, Rival, equation


@equation
def _plane(p: Any, body: Body, memory: Any) -> Any:
    return 1.0 + p[0] * body.x + p[1] * body.y, p[0] * body.cos + p[1] * body.sin, p[1] * body.cos - p[0] * body.sin


EFFECT = Effect(
    name="position_dependent_friction",
    what="Friction increases along one direction of the table.",
    equation="f (1 + g . x), x: position of the cell in the table frame",
    parameters=(
        EffectParameter("x", "1/m", "relative change of friction per length along x", scale=1.0, typical=1.0, low=-5.0, high=5.0),
        EffectParameter("y", "1/m", "relative change of friction per length along y", scale=1.0, typical=1.0, low=-5.0, high=5.0),
    ),
    acts=OnTable(plane=_plane),
    law=Law.APPROXIMATE,
    signature="Depends on the position on the table, not on the heading.",
    rivals=(
        Rival("table_tilt", "the same push at several places: it does not depend on the position"),
        Rival("moving_contents", "the same push at several places"),
    ),
    check="Clean the table and repeat two pushes at distant places.",
    source="Linear part of the variation over a table; Yu, Bauza, Fazeli & Rodriguez, More than a million ways to be pushed, 2016.",
    refit_with=("push_height", "moving_contents"),
    law_of=Mechanism.FRICTION_BY_PLACE,
)
