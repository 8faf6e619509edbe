"""Tables of the blind check, made from its summary."""

from __future__ import annotations

from typing import Final

from push_ident_sim.studies.blind.summary import MOST_PUSHES
from push_ident_sim.studies.common.study import Json
from push_ident_sim.studies.common.tables import markdown_table, number

__all__ = ["answer", "tables"]

_ROWS: Final = {
    "false_alarms": ("false alarms on nulls", "<= 5 %"),
    "top1_detectable": ("first name right, detectable sizes", ">= 90 %"),
    "top1_surely": ("first name right, clearly detectable sizes", ">= 90 %"),
    "wrong_names": ("named with confidence and wrong, all sizes", "<= 3 %"),
    "in_set": ("truth in the confusion set", ">= 95 %"),
    "set_size": ("size of the confusion set", "<= 1.3"),
    "ties_resolved": ("ties resolved rightly by <= 2 requested pushes", ">= 90 %"),
    "ties_beyond_pushes": ("ties that no push resolves", ""),
    "silent_undetectable": ("undetectable sizes: no gap", ""),
    "pairs_both": ("two effects: both named", ">= 75 %"),
    "pairs_one": ("two effects: one named", ">= 95 %"),
    "unknown_flagged": ("outside the catalogue, visible: reported as unknown", ">= 80 %"),
    "unknown_misnamed": ("outside the catalogue: named with confidence", "<= 10 %"),
    "stated_surely": ("causes stated with a probability of at least 90 %: right", ""),
    "shrink": ("S, median", ">= 0.85"),
    "size_intervals": ("90 % intervals of sizes that contain the truth", "85-95 %"),
    "seconds": ("processor seconds a case, median", ""),
}
"""Figure: its words and its target."""


def _figure(figure: Json) -> str:
    if "share" in figure and figure["share"] is not None:
        return f"{round(figure['share'] * figure['n'])}/{figure['n']} ({100 * figure['low']:.0f}-{100 * figure['high']:.0f}%)"
    return number(figure.get("value"), "{:.2f}")


def tables(summary: Json) -> str:
    """Markdown of a summary."""
    parts = []
    if sealed := summary.get("sealed"):
        hashes = ", ".join(f"{what} `{sealed[f'{what}_sha256'][:12]}`" for what in ("truth", "policy", "code"))
        parts.append(f"Set: {sealed['phase']}, {sealed['n_cases']} cases; SHA-256 {hashes}. Intervals hold at 90 %.")
    if by_variant := summary.get("figures"):
        rows = [[text, aim, *(_figure(group[key]) for group in by_variant.values())] for key, (text, aim) in _ROWS.items()]
        parts.append(markdown_table(["figure", "target", *by_variant], rows))
        rows = [
            [f"{row['from']:.2f} to {min(row['to'], 1.0):.2f}", number(row["stated"], "{:.2f}"), _figure(row["right"])]
            for row in summary["by_probability"]
        ]
        parts.append(markdown_table(["stated probability of a cause", "mean", "right"], rows))
        parts.append(f"Not named rightly (truth: answer): {_confusions(summary['confusion'])}.")
    if same := summary.get("same_cases"):
        rights = " and ".join(f"{_figure(row['top1'])} ({name})" for name, row in same.items())
        parts.append(f"First name right in the same cases, sizes that 14 pushes detect: {rights}.")
    if engines := summary.get("engines"):
        errors = "; ".join(f"{name} {1e3 * row['median_m']:.2f} ({1e3 * row['q90_m']:.2f})" for name, row in engines.items())
        parts.append(f"Cell error between engines without effects, median (90 %) [mm]: {errors}.")
    return "\n\n".join(parts)


def _confusions(confusion: Json) -> str:
    """What was answered instead of the truth, such as `pose_latency: pusher_lag 3`."""
    right = {"nothing": ("nothing", "not_trustworthy"), "outside": ("unknown", "not_trustworthy")}
    wrong = {
        truth: ", ".join(f"{answer} {n}" for answer, n in answers.items() if answer not in right.get(truth, (truth,)))
        for truth, answers in confusion.items()
    }
    return "; ".join(f"{truth}: {answers}" for truth, answers in wrong.items() if answers) or "none"


def answer(summary: Json) -> str:
    """The answer in a sentence."""
    by_variant = summary["figures"]
    figures = by_variant.get(MOST_PUSHES) or next(iter(by_variant.values()))
    first, alarms, wrong = (figures[key] for key in ("top1_detectable", "false_alarms", "wrong_names"))
    hits = {key: round((row["share"] or 0.0) * row["n"]) for key, row in (("first", first), ("alarms", alarms), ("wrong", wrong))}
    return (
        f"Of detectable single effects {hits['first']} of {first['n']} are named first; {hits['alarms']} false alarms in {alarms['n']} "
        f"null cases; {hits['wrong']} of {wrong['n']} named wrongly with confidence."
    )
