"""The friction of the table depends on the direction of motion in the table."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import Body, Effect, EffectParameter, Law, Mechanism, OnTable, Rival, equation


@equation
def _skew(p: Any, body: Body) -> Any:
    # The components of a symmetric traceless matrix rotate at twice the angle of the axes.
    cos2, sin2 = body.cos * body.cos - body.sin * body.sin, 2.0 * body.sin * body.cos
    return cos2 * p[0] + sin2 * p[1], cos2 * p[1] - sin2 * p[0]


EFFECT = Effect(
    name="table_anisotropy",
    what="Friction depends on the direction of motion in the table, as on brushed metal or grained wood.",
    equation="force on a cell -f (I + E) v / |v|, E = [[a, b], [b, -a]] in table axes",
    parameters=(
        EffectParameter("a", "", "more friction along x, less along y", scale=0.1, typical=0.1, low=-0.9, high=0.9),
        EffectParameter("b", "", "more friction along the diagonal x = y, less across it", scale=0.1, typical=0.1, low=-0.9, high=0.9),
    ),
    acts=OnTable(skew=_skew),
    law=Law.APPROXIMATE,
    signature="A sideways force and a turn that depend on the heading in the table, with a period of 180 degrees.",
    rivals=(
        Rival("table_tilt", "the same contact at object yaws of 0, 90 and 180 degrees: its period is 360 degrees"),
        Rival("position_dependent_friction", "the same contact at object yaws of 0, 90 and 180 degrees"),
    ),
    check="Turn the object by 90 degrees and repeat a push; or lay a sheet of glass on the table.",
    source="Linear part of orthotropic friction; Goyal, Ruina & Papadopoulos, Planar sliding with dry friction, Wear 143, 1991.",
    law_of=Mechanism.FRICTION_BY_HEADING,
)
