"""The pusher pushes above the table, which loads the leading cells more."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import (
    MAPS,
    STILL,
    Body,
    Effect,
    EffectParameter,
    Law,
    Load,
    OnTable,
    Rival,
    Subsystem,
    analytic_sqrt,
    equation,
)


@equation
def _shift(p: Any, body: Body, load: Load, memory: Any) -> Any:
    # Total friction of the table relative to that of pure translation. Rotation reduces it, as the friction of opposite cells cancels. For
    # a velocity field v + omega x r the mean direction of motion is approximately v / sqrt(v^2 + omega^2 <r^2>).
    squared = load.xx + load.yy + load.x * load.x + load.y * load.y
    speed = analytic_sqrt(body.vx * body.vx + body.vy * body.vy + body.omega * body.omega * squared + STILL * STILL)
    return p[0] * (body.cos * body.vx + body.sin * body.vy) / speed, p[0] * (body.cos * body.vy - body.sin * body.vx) / speed


EFFECT = Effect(
    name="push_height",
    what="A push above the base shifts load to the leading cells.",
    equation="N_i ~ 1 + (r_i - c)' S^-1 q, q = lever v / sqrt(v^2 + omega^2 <r^2>), v: velocity of the centre of mass",
    parameters=(EffectParameter("lever", "m", "friction coefficient times height", scale=5e-3, typical=5e-3, low=0.0, high=0.05),),
    acts=OnTable(shift=_shift),
    law=Law.APPROXIMATE,
    signature="The centre of friction leads the motion by the lever, never trails it, and leads less where the object rotates.",
    rivals=(
        Rival("table_tilt", "pushes on opposite faces"),
        Rival("moving_contents", "pushes on opposite faces"),
        Rival(MAPS, "pushes at two heights of the tool"),
    ),
    check="Repeat a push with the tool 20 mm lower.",
    source="Balance of moments: q moves the centre of friction c; c, the covariance S and <> weigh cells by their friction limits.",
    refit_with=("moving_contents", "position_dependent_friction"),
    within=Subsystem.CONTACT,
)
