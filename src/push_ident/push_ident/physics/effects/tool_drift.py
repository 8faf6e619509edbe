"""The tool, or the camera, moves from push to push."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, Mechanism, OnPusherPath, Rival


def _move(values: ComplexArray, dt: Any, path: ComplexArray, order: float) -> ComplexArray:
    driven = path.copy()
    driven[:, :2] += order * values
    return driven


EFFECT = Effect(
    name="tool_drift",
    what="With every push the tool is further from where it is reported in the frame of the camera: the tool, or the camera, drifts.",
    equation="p = p_reported + n (x, y), n: number of pushes before",
    parameters=(
        EffectParameter("x", "m", "displacement per push along the table's x axis", scale=2e-4, typical=2e-4, low=-5e-3, high=5e-3),
        EffectParameter("y", "m", "displacement per push along the table's y axis", scale=2e-4, typical=2e-4, low=-5e-3, high=5e-3),
    ),
    acts=OnPusherPath(_move),
    law=Law.APPROXIMATE,
    signature="A contact offset that is fixed in the table and grows from push to push.",
    rivals=(Rival("wear", "pushes from opposite sides: it moves contacts, not friction"),),
    check="Before and after the pushes, touch a mark with the tool and measure it with the camera: the one that changed drifts.",
    source="First-order drift of the calibration of hand and eye: a tool that works loose, a mount that warms up or sags.",
    follows_order=True,
    law_of=Mechanism.TOOL_MOVED,
)
