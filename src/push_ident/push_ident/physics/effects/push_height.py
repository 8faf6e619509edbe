"""The pusher pushes above the table, which loads the leading cells more."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import Body, Effect, EffectParameter, OnTable, equation, unit_direction

__all__ = ["EFFECT"]


@equation
def _plane(p: Any, body: Body, memory: Any) -> Any:
    # Direction of the body's motion, object axes.
    dx, dy = unit_direction(body.cos * body.vx + body.sin * body.vy, body.cos * body.vy - body.sin * body.vx)
    along = body.sxx * dx * dx + 2.0 * body.sxy * dx * dy + body.syy * dy * dy
    # At rest, where there is no direction, nothing is left of it.
    rest = 0.5 * (body.sxx + body.syy) * (1.0 - dx * dx - dy * dy)
    slope = p[0] / (along + rest)
    return 1.0 + 0.0 * slope, slope * dx, slope * dy


EFFECT = Effect(
    name="push_height",
    what="Pushed above its base, an object bears more on the cells that lead.",
    equation="N_i ~ 1 + lever (r_i . v) / <(r . v)^2>, v the unit direction of the centre of mass",
    parameters=(EffectParameter("lever", "m", "friction coefficient times height", scale=5e-3, typical=5e-3, low=0.0, high=0.05),),
    acts=OnTable(plane=_plane),
    signature="The centre of friction runs ahead of the motion, by the lever; never behind it.",
    rivals="table_tilt, moving_contents, the maps: pushes on opposite faces; two heights of the tool.",
    source="Balance of moments of a rigid object on an even bed of springs; <> is over the area, as poses do not tell the load.",
)
