"""A cable pulls the object."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import Body, Effect, EffectParameter, Law, Mechanism, OnTable, Rival, equation


@equation
def _pull(p: Any, body: Body) -> Any:
    return p[1] - p[0] * body.x, p[2] - p[0] * body.y, 0.0 * body.mass


EFFECT = Effect(
    name="tether",
    what="A cable or spring pulls the object towards a place on the table.",
    equation="force - k (x - x0) at the centre of mass; parameters k and k x0",
    parameters=(
        EffectParameter("stiffness", "N/m", "stiffness k of the cable", scale=2.0, typical=2.0, low=0.0, high=100.0),
        EffectParameter("pull_x", "N", "force on an object at the origin of the table along x: k times x of x0", scale=0.2, typical=0.1),
        EffectParameter("pull_y", "N", "the same along y", scale=0.2, typical=0.1),
    ),
    acts=OnTable(pull=_pull),
    law=Law.APPROXIMATE,
    signature="A force that grows with the distance from one place of the table.",
    rivals=(
        Rival("table_tilt", "long pushes from several places: it is the special case of zero stiffness"),
        Rival("push_height", "long pushes from several places"),
    ),
    check="Disconnect every cable and hose of the object and push again.",
    source="Linear spring without slack. With the products k x0 it is linear in its parameters, and absent at zero.",
    refit_with=("table_tilt",),
    law_of=Mechanism.FORCE_ON_OBJECT,
)
