"""A cable pulls at the object."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import Body, Effect, EffectParameter, Law, OnTable, Rival, equation

__all__ = ["EFFECT"]


@equation
def _pull(p: Any, body: Body) -> Any:
    return p[1] - p[0] * body.x, p[2] - p[0] * body.y, 0.0 * body.mass


EFFECT = Effect(
    name="tether",
    what="A cable or spring pulls the object towards a place on the table.",
    equation="force - k (x - x0) at the centre of mass; given by k and k x0",
    parameters=(
        EffectParameter("stiffness", "N/m", "of the cable, k", scale=2.0, typical=2.0, low=0.0, high=100.0),
        EffectParameter("pull_x", "N", "force on an object in the middle of the table, along x: k times x of x0", scale=0.2, typical=0.1),
        EffectParameter("pull_y", "N", "the same along y", scale=0.2, typical=0.1),
    ),
    acts=OnTable(pull=_pull),
    law=Law.APPROXIMATE,
    signature="Grows with the distance from one place of the table.",
    rivals=(
        Rival("table_tilt", "long pushes from several places: it is the case of no stiffness"),
        Rival("push_height", "long pushes from several places"),
    ),
    check="Disconnect every cable and hose of the object and push again.",
    source="Linear spring without slack. The products k x0 make it linear in its parameters, and null at zero.",
    refit_with=("table_tilt",),
)
