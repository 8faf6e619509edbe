"""The table is not level."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import Body, Effect, EffectParameter, ExportAs, Law, Mechanism, OnTable, Rival, equation
from push_ident.physics.support import GRAVITY


@equation
def _pull(p: Any, body: Body) -> Any:
    weight = body.mass * GRAVITY
    return weight * p[0], weight * p[1], 0.0 * weight


EFFECT = Effect(
    name="table_tilt",
    what="The table slopes down along (x, y).",
    equation="force + m g (x, y) at the centre of mass",
    parameters=(
        EffectParameter("x", "rad", "slope downwards along the table's x axis", scale=0.02, typical=0.01),
        EffectParameter("y", "rad", "slope downwards along the table's y axis", scale=0.02, typical=0.01),
    ),
    acts=OnTable(pull=_pull),
    law=Law.APPROXIMATE,
    signature="A force of constant direction in the table, at any heading: period 360 degrees.",
    rivals=(
        Rival("position_dependent_friction", "pushes at opposite headings"),
        Rival("table_anisotropy", "pushes at opposite headings"),
        Rival("tether", "long pushes from several places"),
    ),
    check="Put a spirit level on the table.",
    source="Weight on an inclined plane, to first order in the slope. Motion identifies slope / friction, not a common factor.",
    special_case_of=("tether",),
    refit_with=("tether",),
    export=ExportAs.GRAVITY,
    law_of=Mechanism.FORCE_ON_OBJECT,
)
