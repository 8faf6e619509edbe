"""The friction of the object's base depends on the direction of motion in the object."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import MAPS, Body, Effect, EffectParameter, ExportAs, Law, Mechanism, OnTable, Rival, Subsystem, equation


@equation
def _skew(p: Any, body: Body) -> Any:
    # Adding zero times the mass gives the result the number type of the derivative.
    return p[0] + 0.0 * body.mass, p[1] + 0.0 * body.mass


EFFECT = Effect(
    name="base_anisotropy",
    what="Friction depends on the direction of motion in the object, as on a ribbed base.",
    equation="force on a cell -f (I + E) v / |v|, E = [[a, b], [b, -a]] in object axes",
    parameters=(
        EffectParameter("a", "", "more friction along the object's x, less along its y", scale=0.1, typical=0.1, low=-0.9, high=0.9),
        EffectParameter("b", "", "more friction along its diagonal x = y, less across it", scale=0.1, typical=0.1, low=-0.9, high=0.9),
    ),
    acts=OnTable(skew=_skew),
    law=Law.APPROXIMATE,
    signature="A sideways force and a turn that depend on the heading in the object, with a period of 180 degrees.",
    rivals=(Rival(MAPS, "pushes on new faces"), Rival("table_anisotropy", "pushes at one heading in the table, on several faces")),
    check="Inspect the underside of the object for a grain or ribs.",
    source="Linear part of orthotropic friction; Goyal, Ruina & Papadopoulos, Planar sliding with dry friction, Wear 143, 1991.",
    export=ExportAs.CELL_ANISOTROPY,
    within=Subsystem.OBJECT,
    law_of=Mechanism.FRICTION_BY_HEADING_IN_OBJECT,
)
