"""The page of the effects, from `physics/effects/`, one file for each: `.venv/bin/python tools/document_effects.py`."""

from __future__ import annotations

import math

from push_ident.physics.effect import (
    Effect,
    EffectParameter,
    OnContact,
    OnForces,
    OnForceTimes,
    OnPoses,
    OnPusherFriction,
    OnPusherPath,
    OnTable,
    OnTimes,
)
from push_ident.physics.effects import EFFECTS

PLACES = {
    OnTable: "between table and cells; evaluated at the start of a step and held during it",
    OnContact: "between pusher and outline",
    OnPusherPath: "on the pusher's path",
    OnPusherFriction: "on the pusher's friction coefficient",
    OnTimes: "on the times of measured poses",
    OnPoses: "on measured poses",
    OnForces: "on measured forces of the pusher; poses do not show it",
    OnForceTimes: "on the times of measured forces; poses do not show it",
}
HEAD = """# Effects

This page is generated from `physics/effects/`, one file for each effect.

An effect is a physical or measurement law that the base model leaves out. Give effects to `simulate(..., effects={"table_tilt": {"x":
0.01}})`. Effects at their nominal values have no influence. Derivatives with respect to the values are exact. `scale` is the standard
deviation of the prior, `typical` a typical size in practice; both are judgements, not measurements. Units are SI, and axes are those of
the table frame unless stated otherwise. A *shape* parameter only modifies the influence of the other parameters; a test for the effect's
absence holds it fixed.
"""


def range_of(parameter: EffectParameter) -> str:
    low, high = parameter.low, parameter.high
    return "" if math.isinf(low) and math.isinf(high) else f"{low:g} … {high:g}"


def notes_of(effect: Effect) -> list[str]:
    """What the fields of an effect state besides its equation and its parameters."""
    exact = effect.law.name == "EXACT"
    notes = [
        f"Acts {PLACES[type(effect.acts)]}",
        f"Law: {'exact where the effect is present' if exact else 'approximate, as laws of friction and loads are'}",
        f"Signature: {effect.signature}",
    ]
    if effect.rivals:
        notes.append("Rivals: " + "; ".join(f"{rival.name} ({rival.separated_by.rstrip('.')})" for rival in effect.rivals))
    if effect.exact_twins:
        notes.append(f"No push distinguishes it from {', '.join(effect.exact_twins)}")
    if effect.special_case_of:
        notes.append(f"Special case of {', '.join(effect.special_case_of)}")
    if effect.check:
        notes.append(f"Check without a push: {effect.check}")
    if effect.export is not None:
        notes.append(f"Exported descriptions carry it as {effect.export.name.lower().replace('_', ' ')}, where the format has it")
    if effect.needs_inertia:
        notes.append("Absent in quasi-static pushes")
    return [*notes, f"Source: {effect.source}"]


def section_of(effect: Effect) -> str:
    lines = [f"## {effect.name}", "", effect.what, ""]
    lines += [
        f"    {effect.equation}",
        "",
        "| parameter | unit | nominal | range | scale | typical | meaning |",
        "|---|---|---|---|---|---|---|",
    ]
    for p in effect.parameters:
        name = f"`{p.name}`" + (" (shape)" if p.shape else "")
        lines.append(f"| {name} | {p.unit} | {p.nominal:g} | {range_of(p)} | {p.scale:g} | {p.typical:g} | {p.what} |")
    return "\n".join([*lines, "", *(f"- {note.rstrip('.')}." for note in notes_of(effect)), ""])


def document() -> str:
    """The page in Markdown."""
    return "\n".join([HEAD, *(section_of(effect) for effect in EFFECTS.values())])


if __name__ == "__main__":
    print(document())
