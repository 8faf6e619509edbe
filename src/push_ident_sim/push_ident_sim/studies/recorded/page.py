"""Tables and the picture of recordings of others, made from a summary."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from push_ident.physics.effects import EFFECTS
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, markdown_table, millimetres, new_figure, save

__all__ = ["draw", "tables"]


def tables(summary: Json) -> str:
    """Markdown of a summary."""
    rows = [(name, variant, row) for name, variants in summary["sets"].items() for variant, row in variants.items()]
    found = [
        [
            f"{name}, {variant}",
            f"{row['draws']} × {row['pushes'][1]} of {row['pushes'][2]}",
            _range(row["speed_mps"], 1e3),
            _counts(row["verdicts"]),
            _named(row) or "–",
            "–" if row["gap"] is None else " → ".join(millimetres(row["gap"][key]) for key in ("before_m", "after_m")),
            "–" if row["gap"] is None else millimetres(row["gap"]["noise_m"]),
            _friction(row, summary["known"][name]),
            f"{row['seconds']:.0f}",
        ]
        for name, variant, row in rows
    ]
    heads = ["set", "pushes", "speed [mm/s]", "verdict", "named", "held-out error [mm]", "of it noise [mm]", "friction", "time [s]"]
    laws = [
        [f"{name}, {variant}", *(_law(row["laws"][law], row["draws"]) for law in summary["laws"])]
        for name, variant, row in rows
        if row["gap"] is not None
    ]
    parts = [markdown_table(heads, found)]
    if laws:
        words = (
            "Each law: in how many draws it was named (or left open), its mean probability, the smallest size that would have been seen."
        )
        parts += [words, markdown_table(["set", *(f"{law} [{EFFECTS[law].parameters[0].unit or '1'}]" for law in summary["laws"])], laws)]
    known = [[name, *(_known(own, law) for law in summary["laws"]), own.get("source", "")] for name, own in summary["known"].items() if own]
    if known:
        parts += ["What the authors measured:", markdown_table(["set", *summary["laws"], "source"], known)]
    refused = [f"- {name}, {variant}: {gate}" for name, variant, row in rows for gate in dict.fromkeys(row["failed_gates"])]
    if refused:
        parts.append("Why sets were not diagnosed:\n\n" + "\n".join(refused))
    return "\n\n".join(parts)


def _range(values: list[float], factor: float) -> str:
    low, high = (f"{factor * value:.0f}" for value in values)
    return low if low == high else f"{low}-{high}"


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {n}" if len(counts) > 1 or n > 1 else name for name, n in sorted(counts.items(), key=lambda item: -item[1]))


def _named(row: Json) -> str:
    """Names with their counts and sizes; the size is the mean of each parameter over the draws."""
    texts = []
    for name, n in sorted(row["named"].items(), key=lambda item: -item[1]):
        shown = [p for p in EFFECTS[name].parameters if not p.shape]
        sizes = [np.mean([size["parameters"][p.name] for size in row["sizes"][name]]) for p in shown]
        units = [f" {p.unit}" if p.unit else "" for p in shown]
        size = ", ".join(f"{value:.2g}{unit}" for value, unit in zip(sizes, units, strict=True))
        texts.append(f"{name} {f'{n}×, ' if row['draws'] > 1 else ''}{size}")
    return "; ".join(texts)


def _friction(row: Json, known: Mapping[str, Any]) -> str:
    if row["friction"] is None:
        return "–"
    mean, low, high = row["friction"]
    found = f"{mean:.3f}" + (f" ({low:.3f}-{high:.3f})" if row["draws"] > 1 else "")
    return found + (f", measured {known['friction']:.3f}" if "friction" in known else "")


def _law(law: Json, draws: int) -> str:
    named = f"{law['named']} of {draws}" + (f" (open {law['open']})" if law["open"] else "")
    probability = "–" if law["probability"] is None else f"{law['probability']:.2f}"
    smallest = "–" if law["smallest"] is None else f"{law['smallest']:.2g}"
    return f"{named}; {probability}; {smallest}"


def _known(known: Mapping[str, Any], law: str) -> str:
    return str(known.get("effects", {}).get(law, "–"))


def draw(summary: Json, folder: Path) -> dict[str, str]:
    """Write the probabilities of the laws, and of other causes, in each set."""
    rows = [(f"{name}, {variant}", row["probabilities"]) for name, own in summary["sets"].items() for variant, row in own.items()]
    rows = [(name, own) for name, own in rows if own]
    if not rows:
        return {}
    laws = summary["laws"]
    columns = ["nothing", *laws, "other effects", "something_else"]
    values = np.array([[_probability(own, column, laws) for column in columns] for _, own in rows])
    figure, (ax,) = new_figure(1, width=7.6, height=0.3 * len(rows) + 2.2)
    ax.imshow(values, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        ax.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=8, color="white" if value > 0.5 else COLOURS["truth"])
    ax.set_xticks(range(len(columns)), [column.replace("_", "\n") for column in columns], fontsize=8)
    ax.set_yticks(range(len(rows)), [name for name, _ in rows], fontsize=8)
    save(figure, folder / "recorded.png")
    return {"recorded.png": "Mean probability of each cause over the draws. Several causes can act, so that rows need not add up to 1."}


def _probability(own: Mapping[str, float], column: str, laws: list[str]) -> float:
    if column == "other effects":
        # At least one of them: causes are treated as independent, which is an upper bound.
        others = [p for name, p in own.items() if name not in (*laws, "nothing", "something_else")]
        return float(1.0 - np.prod([1.0 - min(p, 1.0) for p in others]))
    return float(own.get(column, 0.0))
