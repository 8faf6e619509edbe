"""Tables and the confusion matrix of the blind check, made from its summary."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from push_ident.physics.effects import EFFECTS
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import markdown_table, new_figure, save

__all__ = ["draw", "tables"]

_SEALED = {"truth_sha256": "truth", "policy_sha256": "policy", "code_sha256": "code", "thresholds_sha256": "thresholds"}
"""Hashes of a seal; checks of an earlier version sealed the thresholds of the policy only."""
_ROWS = (
    ("false_alarms", "false alarms on nulls", "<= 5 %"),
    ("nulls_not_trusted", "nulls not trusted", ""),
    ("top1_detectable", "first name right, detectable sizes", ">= 90 %"),
    ("top1_surely", "first name right, sizes detectable nine times in ten", ">= 90 %"),
    ("top1_plain", "first name right, noncentrality >= 25", ">= 95 %"),
    ("wrong_names", "named with confidence and wrong, all sizes", "<= 3 %"),
    ("wrong_names_detectable", "the same, detectable sizes", ""),
    ("in_set", "truth in the confusion set", ">= 95 %"),
    ("set_size", "size of the confusion set", "<= 1.3"),
    ("ties_settled", "ties resolved rightly by <= 2 requested pushes", ">= 90 %"),
    ("ties_settled_as_expected", "the same, where one push was predicted to be enough", ">= 90 %"),
    ("ties_beyond_pushes", "ties that no push within its limits resolves", ""),
    ("ties_asked", "requested pushes", "<= 2"),
    ("silent_undetectable", "undetectable sizes: no gap", ""),
    ("wrong_undetectable", "undetectable sizes: wrongly named", ""),
    ("pairs_both", "two effects: both named", ">= 75 %"),
    ("pairs_one", "two effects: one named", ">= 95 %"),
    ("unknown_flagged", "outside the catalogue, visible: reported as unknown", ">= 80 %"),
    ("unknown_misnamed", "outside the catalogue: named with confidence", "<= 10 %"),
    ("said_surely", "causes said with a probability of at least 90 %: right", ""),
    ("said_surely_mean", "mean of these probabilities", "the same"),
    ("outside_invisible", "outside the catalogue: not visible", ""),
    ("shrink", "shrink S, median", ">= 0.85"),
    ("shrink_oracle", "S of the true effect, median", ""),
    ("shrink_of_oracle", "S of S of the true effect, median", ">= 0.95"),
    ("shrink_tuned", "S of tuning existing parameters only", ""),
    ("size_error", "error of the size, median (where engines and model share the law)", ""),
    ("sizes_within_tenth", "sizes within 10 %", ""),
    ("size_intervals", "90 % intervals of sizes that contain the truth", "85-95 %"),
    ("baseline_evidence", "baseline: largest log evidence", ""),
    ("baseline_training_fit", "baseline: best training fit", ""),
    ("baseline_largest_residual", "baseline: largest residual", ""),
    ("baseline_random", "baseline: random", ""),
    ("seconds", "seconds a case, one core, median", ""),
)


_SENSOR_COLUMNS = {
    "false_alarms": "false alarms on nulls",
    "nulls_not_trusted": "nulls not trusted",
    "top1_detectable": "first name right, detectable sizes",
    "wrong_names": "named with confidence and wrong",
    "in_set": "truth in the confusion set",
    "silent_undetectable": "undetectable sizes: no gap",
    "pairs_one": "two effects: one named",
    "unknown_misnamed": "outside the catalogue: named with confidence",
    "of_the_unit": "calibration named",
}
"""Calibration: an error of the pose or scale of the camera, or of the tool, its exact twin; each unit has some, and nobody injected it."""


def _number(figure: Json) -> str:
    value, as_share = figure.get("share"), "share" in figure
    value = value if as_share else figure["value"]
    if value is None:
        return "–"
    scale, unit = (100.0, " %") if as_share else (1.0, "")
    form = "{:.0f}" if as_share else "{:.2f}"
    between = "" if figure["low"] is None else f" ({form.format(scale * figure['low'])}-{form.format(scale * figure['high'])})"
    return f"{form.format(scale * value)}{unit}{between}, n {figure['n']}"


def tables(summary: Json) -> str:
    """Markdown of a summary."""
    parts = []
    if sealed := summary.get("sealed"):
        hashes = ", ".join(f"of the {what} `{sealed[key]}`" for key, what in _SEALED.items() if key in sealed)
        parts.append(f"Set: {sealed['phase']}, {sealed['n_cases']} cases. SHA-256 {hashes}. Intervals hold at 90 %.")
    if found := summary.get("figures"):
        groups = list(found)
        # Summaries of an earlier version lack some figures.
        known = [row for row in _ROWS if all(row[0] in found[group] for group in groups)]
        rows = [[text, target, *(_number(found[group][key]) for group in groups)] for key, text, target in known]
        parts.append(markdown_table(["figure", "target", *groups], rows))
        bins = [
            [f">= {row['from']:g}", *(_number(row[key]) for key in ("top1", "in_set", "wrong", "silent"))]
            for row in summary["by_noncentrality"]
        ]
        parts.append(markdown_table(["noncentrality", "first name right", "truth in the set", "wrong", "silent"], bins))
        if said := summary.get("by_probability"):
            rows = [
                [
                    f"{row['from']:.2f} to {min(row['to'], 1.0):.2f}",
                    "–" if row["said"] is None else f"{row['said']:.2f}",
                    _number(row["right"]),
                ]
                for row in said
            ]
            parts.append(markdown_table(["probability of a cause", "mean", "right"], rows))
        parts += _same_cases(summary.get("same_cases", {}))
        smallest = summary["smallest"]
        rows = [
            [
                name,
                EFFECTS[name].parameters[0].unit or "1",
                *("–" if smallest[p][name] is None else f"{smallest[p][name]:.2g}" for p in smallest),
            ]
            for name in next(iter(smallest.values()), {})
        ]
        parts.append("Smallest detectable size in nulls, median:\n\n" + markdown_table(["effect", "unit", *smallest], rows))
    if sensors := summary.get("sensors"):
        rows = [[name, str(own["n"]), *(_number(own[key]) for key in _SENSOR_COLUMNS)] for name, own in sensors.items()]
        parts.append(markdown_table(["sensor", "cases", *_SENSOR_COLUMNS.values()], rows))
    if engines := summary.get("engines"):
        rows = [
            [name.replace("_", " "), str(own["n"]), *(f"{1e3 * own[key]:.2f}" for key in ("median_m", "q90_m", "largest_m"))]
            for name, own in engines.items()
        ]
        parts.append(
            "Distance between the engines, cell error at the end of a push without effects:\n\n"
            + markdown_table(["engines", "pushes", "median [mm]", "90 % [mm]", "largest [mm]"], rows)
        )
    return "\n\n".join(parts)


def _same_cases(compared: Json) -> list[str]:
    """A table for each number of pushes that was compared with the largest, of the same cases."""
    columns = {
        "top1": "first name right, sizes that 14 pushes detect",
        "one_of_pair": "two effects: one named",
        "false_alarms": "alarms on nulls",
        "wrong": "named with confidence and wrong",
    }
    return [
        markdown_table(
            ["the same cases", *columns.values()], [[name, *(_number(own[key]) for key in columns)] for name, own in rows.items()]
        )
        for rows in compared.values()
    ]


def draw(summary: Json, folder: Path, name: str = "blind") -> dict[str, str]:
    """Write the confusion matrix into a folder, under the name of the study."""
    confusion: dict[str, dict[str, int]] = summary.get("confusion", {})
    if not confusion:
        return {}
    rows = list(confusion)
    answers = {name for own in confusion.values() for name in own}
    columns = [name for name in rows if name in answers] + sorted(answers - set(rows))
    counts = np.array([[confusion[row].get(column, 0) for column in columns] for row in rows])
    figure, (ax,) = new_figure(1, width=0.42 * len(columns) + 3.2, height=0.34 * len(rows) + 2.4)
    ax.imshow(counts / counts.sum(axis=1, keepdims=True), cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for i, j in zip(*np.nonzero(counts), strict=True):
        share = counts[i, j] / counts[i].sum()
        ax.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=8, color="white" if share > 0.5 else "black")
    ax.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize=8)
    ax.set_yticks(range(len(rows)), rows, fontsize=8)
    ax.set_xlabel("first name given")
    ax.set_ylabel("truth")
    save(figure, folder / f"{name}.png")
    return {
        f"{name}.png": "Cases by truth and by the first name given; colours are shares of a row. "
        "Single effects of detectable size, nulls, and effects outside the catalogue."
    }
