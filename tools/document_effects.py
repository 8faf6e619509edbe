"""Write docs/effects.md from the catalogue: `.venv/bin/python tools/document_effects.py`; `--check` only compares."""

from __future__ import annotations

import math
import sys
from pathlib import Path

from push_ident.physics.effect import (
    Effect,
    EffectParameter,
    Law,
    OnContact,
    OnPoses,
    OnPusherFriction,
    OnPusherPath,
    OnTable,
    OnTimes,
)
from push_ident.physics.effects import EFFECTS

TARGET = Path(__file__).resolve().parent.parent / "docs" / "effects.md"
PLACES = {
    OnTable: "between table and cells; evaluated at the start of a step and held during it",
    OnContact: "between pusher and outline",
    OnPusherPath: "on the pusher's path",
    OnPusherFriction: "on the pusher's friction coefficient",
    OnTimes: "on the times of measured poses",
    OnPoses: "on measured poses",
}
LAWS = {
    Law.EXACT: "Exact law: it holds as it stands, if the effect is there",
    Law.APPROXIMATE: "Approximate law: its error grows with the size of the effect",
}
HEAD = """# Effects

Written by `tools/document_effects.py` from `physics/effects/`, one file an effect.

What the base model leaves out. Give them to `simulate(..., effects={"table_tilt": {"x": 0.01}})`; at their nominal values they change
nothing, and derivatives with respect to their values are exact. `scale` is the standard deviation of the prior, `typical` a size that
is met in practice; both are judgements, not measurements. Units are SI, axes those of the table frame unless said. A *shape* only
shapes what the other parameters switch on: a test for the effect's absence holds it.
"""


def range_of(parameter: EffectParameter) -> str:
    low, high = parameter.low, parameter.high
    return "" if math.isinf(low) and math.isinf(high) else f"{low:g} … {high:g}"


def section_of(effect: Effect) -> str:
    lines = [f"## {effect.name}", "", effect.what, "", f"    {effect.equation}", ""]
    lines += ["| parameter | unit | nominal | range | scale | typical | what |", "|---|---|---|---|---|---|---|"]
    for p in effect.parameters:
        name = f"`{p.name}`" + (" (shape)" if p.shape else "")
        lines.append(f"| {name} | {p.unit} | {p.nominal:g} | {range_of(p)} | {p.scale:g} | {p.typical:g} | {p.what} |")
    if effect.is_unknown_cause:
        lines.insert(2, "Not a cause: it measures what no cause explains, and is never named.\n")
    notes = [f"Acts {PLACES[type(effect.acts)]}", LAWS[effect.law], f"Signature: {effect.signature}"]
    notes += [f"Rival: {rival.name}, separated by {rival.separated_by}" for rival in effect.rivals]
    if effect.exact_twins:
        notes.append(f"No push distinguishes it from {' and '.join(effect.exact_twins)}")
    if effect.special_case_of:
        notes.append(f"A special case of {' and '.join(effect.special_case_of)}")
    if effect.check:
        notes.append(f"Check without a push: {effect.check}")
    if effect.export:
        notes.append(f"Exported models carry it as {effect.export.value}, where the format allows it")
    if effect.is_camera_error:
        sizes = ", ".join(f"{p.name} {p.camera_std:g} {p.unit}".rstrip() for p in effect.parameters if p.camera_std is not None)
        notes.append(f"Part of the base model where a camera traced the outline, with the standard deviation {sizes}")
    notes.append(f"Source: {effect.source}")
    if effect.needs_inertia:
        notes.append("Not in quasi-static pushes")
    return "\n".join([*lines, "", *(f"- {note.rstrip('.')}." for note in notes), ""])


def document() -> str:
    return "\n".join([HEAD, *(section_of(effect) for effect in EFFECTS.values())])


def main() -> None:
    if "--check" in sys.argv:
        sys.exit(0 if TARGET.is_file() and TARGET.read_text(encoding="utf-8") == document() else f"{TARGET} is out of date; run {__file__}")
    TARGET.write_text(document(), encoding="utf-8")


if __name__ == "__main__":
    main()
