"""The pusher pushes above the table, which loads the leading cells more."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import STILL, Body, Effect, EffectParameter, OnTable, analytic_sqrt, equation

__all__ = ["EFFECT"]


@equation
def _plane(p: Any, body: Body, memory: Any) -> Any:
    # The table's friction on the whole object, over what it is while that does not turn: cells that go round cancel one another. For a
    # velocity field v + omega x r its mean direction is nearly that of v, shorter by the share of the turning.
    turning = body.omega * body.omega * (body.sxx + body.syy)
    speed = analytic_sqrt(body.vx * body.vx + body.vy * body.vy + turning + STILL * STILL)
    x, y = p[0] * (body.cos * body.vx + body.sin * body.vy) / speed, p[0] * (body.cos * body.vy - body.sin * body.vx) / speed
    # The even tilt of the load that moves its centre by (x, y).
    determinant = body.sxx * body.syy - body.sxy * body.sxy
    return 1.0 + 0.0 * x, (body.syy * x - body.sxy * y) / determinant, (body.sxx * y - body.sxy * x) / determinant


EFFECT = Effect(
    name="push_height",
    what="Pushed above its base, an object bears more on the cells that lead.",
    equation="N_i ~ 1 + r_i' <r r'>^-1 q, q = lever v / sqrt(v^2 + omega^2 <r^2>), v the velocity of the centre of mass",
    parameters=(EffectParameter("lever", "m", "friction coefficient times height", scale=5e-3, typical=5e-3, low=0.0, high=0.05),),
    acts=OnTable(plane=_plane),
    signature="The centre of friction runs ahead of the motion, by the lever; never behind it, and less where the object turns.",
    rivals="table_tilt, moving_contents, the maps: pushes on opposite faces; two heights of the tool.",
    source="Balance of moments of a rigid object on an even bed of springs; <> is over the area, as poses do not tell the load.",
)
