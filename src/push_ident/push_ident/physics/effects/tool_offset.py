"""The tool tip is displaced from the position that the arm reports."""

from __future__ import annotations

from typing import Any

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnPusherPath, Rival


def _move(values: ComplexArray, dt: Any, path: ComplexArray, order: float) -> ComplexArray:
    driven = path.copy()
    driven[:, :2] += values
    return driven


EFFECT = Effect(
    name="tool_offset",
    what="The tool is displaced from its reported position, in directions fixed in the table.",
    equation="p = p_reported + (x, y)",
    parameters=(
        EffectParameter("x", "m", "displacement along the table's x axis", scale=2e-3, typical=2e-3, low=-0.05, high=0.05),
        EffectParameter("y", "m", "displacement along the table's y axis", scale=2e-3, typical=2e-3, low=-0.05, high=0.05),
    ),
    acts=OnPusherPath(_move),
    law=Law.EXACT,
    signature="A contact offset that is fixed in the table.",
    rivals=(Rival("camera_translation", "no push: only a measurement of a known mark"),),
    check="Touch a mark of known position with the tool.",
    source="Error of the tool calibration (hand to tip) at one orientation of the tool.",
    exact_twins=("camera_translation",),
)
