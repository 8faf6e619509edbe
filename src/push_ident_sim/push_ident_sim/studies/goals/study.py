"""How surely, and in how many pushes, objects of uneven maps are brought to a goal, by what is known of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.plate import plate_in_bullet
from push_ident_sim.studies.common.pushed import IDENTIFIED, TRUTH, UNIFORM, PushedObject
from push_ident_sim.studies.common.random_objects import random_object
from push_ident_sim.studies.common.reaching import share
from push_ident_sim.studies.goals.run import LEVELS, random_goal, reach

__all__ = ["STUDY"]

_KINDS = (UNIFORM, IDENTIFIED, TRUTH)
_FIRST = next(iter(LEVELS))
_SURE: Final = (0.85, 0.95)
"""Of a push that is "90 % sure"."""
_NAMES = {"20mm_0.1rad": "20 mm, 0.1 rad", "10mm_5deg": "10 mm, 5°", "5mm_2deg": "5 mm, 2°"}


def _run(case: Case, settings: CaseSettings) -> Json:
    rng = np.random.default_rng([case.model, 1])
    goals = [random_goal(rng) for _ in range(settings.goals)]
    # The same noise for all kinds of model, as far as they push alike.
    thing = plate_in_bullet(random_object(np.random.default_rng(case.model)))
    pushed = PushedObject(thing, case.variant, np.random.default_rng([case.model, 2]))
    try:
        outcomes = [reach(pushed, goal) for goal in goals]
    finally:
        pushed.close()
    return {
        "reached": [outcome.reached for outcome in outcomes],
        "pushes": [outcome.pushes for outcome in outcomes],
        "time_s": [{level: round(time, 2) for level, time in outcome.time.items()} for outcome in outcomes],
        "chances": [[round(chance, 3), there] for outcome in outcomes for chance, there in outcome.chances],
        "ends": [outcome.ends for outcome in outcomes],
        "falls": sum(outcome.fell for outcome in outcomes),
    }


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_kind = grouped(results, "variant")
    main = by_kind.get(IDENTIFIED, results)
    return {
        "success": {kind: {level: _mean(own, "reached", level) for level in LEVELS} for kind, own in by_kind.items()},
        "intervals": {kind: {level: _interval(own, level) for level in LEVELS} for kind, own in by_kind.items()},
        "pushes": {kind: {level: _mean(own, "pushes", level) for level in LEVELS} for kind, own in by_kind.items()},
        "time_s": {kind: {level: _mean(own, "time_s", level) for level in LEVELS} for kind, own in by_kind.items()},
        "goals": {kind: sum(len(r.values["reached"]) for r in own) for kind, own in by_kind.items()},
        "sure": {kind: _sure(own) for kind, own in by_kind.items()},
        "calibration": {kind: _calibration(own) for kind, own in by_kind.items()},
        "pushes_mean": _mean(main, "pushes", _FIRST),
        "time_mean_s": _mean(main, "time_s", _FIRST),
        "falls": sum(r.values["falls"] for r in results),
    }


def _mean(results: Sequence[CaseResult], key: str, level: str) -> float:
    """Over all goals."""
    return round(float(np.mean([goal[level] for r in results for goal in r.values[key]])), 4)


def _interval(results: Sequence[CaseResult], level: str) -> list[float]:
    """In which the true share of goals that are reached lies at 95 %."""
    found = share(goal[level] for r in results for goal in r.values["reached"])
    return [found["low"], found["high"]]


def _sure(results: Sequence[CaseResult]) -> Json:
    """Pushes that were about 90 % sure to end at the goal, and how many did."""
    pairs = [(chance, there) for r in results for chance, there in r.values["chances"]]
    there = [there for chance, there in pairs if _SURE[0] <= chance <= _SURE[1]]
    return {"pushes": len(there), "there": sum(there)}


def _calibration(results: Sequence[CaseResult]) -> list[Json]:
    """Pushes by the chance that was expected of them, in fifths, and how many ended at the goal."""
    pairs = [(chance, there) for r in results for chance, there in r.values["chances"]]
    rows = []
    for k in range(5):
        own = [(chance, there) for chance, there in pairs if min(int(5 * chance), 4) == k]
        if own:
            rows.append({"expected": float(np.mean([c for c, _ in own])), "found": float(np.mean([t for _, t in own])), "pushes": len(own)})
    return rows


def _tables(summary: Json) -> str:
    head = ["", *(f"{name}: reached (95 % interval), pushes, time" for name in _NAMES.values()), "pushes that were 85-95 % sure, and right"]
    rows = []
    for kind, success in summary["success"].items():
        cells = [
            f"{100 * success[level]:.1f} % ({_range(summary, kind, level)} %), "
            f"{summary['pushes'][kind][level]:.2f}, {summary['time_s'][kind][level]:.1f} s"
            for level in LEVELS
        ]
        sure = summary["sure"][kind]
        rows.append([f"{kind}, {summary['goals'][kind]} goals", *cells, f"{sure['there']} of {sure['pushes']}"])
    return "\n\n".join(
        [
            markdown_table(head, rows),
            f"Objects that fell off the table: {summary['falls']}.",
            "Pushes by the chance that was expected of them, in fifths: mean chance, share that ended at the goal, number of pushes.",
            _calibration_table(summary["calibration"]),
        ]
    )


def _range(summary: Json, kind: str, level: str) -> str:
    """The interval of 95 %, in percent."""
    return "{:.0f}-{:.0f}".format(*(100 * bound for bound in summary["intervals"][kind][level]))


def _calibration_table(calibration: Json) -> str:
    head = ["", *(f"{20 * k}-{20 * (k + 1)} %" for k in range(5))]
    rows = []
    for kind, own in calibration.items():
        cells = {min(int(5 * row["expected"]), 4): f"{row['expected']:.0%}, {row['found']:.0%}, {row['pushes']}" for row in own}
        rows.append([kind, *(cells.get(k, "–") for k in range(5))])
    return markdown_table(head, rows)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (axes,) = new_figure(1, width=6.0, height=4.2)
    axes.plot([0, 100], [0, 100], color="0.7", linewidth=1)
    for kind, rows in summary["calibration"].items():
        expected, found = ([100 * row[key] for row in rows] for key in ("expected", "found"))
        axes.plot(expected, found, marker="o", color=COLOURS["gauss_newton" if kind == IDENTIFIED else kind], label=kind)
    axes.set_xlabel("expected chance to end at the goal [%]")
    axes.set_ylabel("pushes that did [%]")
    label_below(axes, 3)
    save(figure, folder / "goals.png")
    return {"goals.png": "Chances that the planner expects of its pushes, and what became of them, in fifths."}


STUDY = Experiment(
    name="goals",
    place=65,
    title="Pushing to goals",
    question=(
        "Objects of random shape and uneven maps (50 to 120 cells) are pushed in Bullet to one random pose after another, in a square of "
        "30 cm and any heading, and are never put back. Each goal is reached at the first tolerance, then held to the next. The planner "
        "knows the outline, poses with the errors of perception, and of the mechanics nothing (uniform), what three random pushes and then "
        "up to seven more have shown (identified), or everything (truth). At most 20 pushes a goal. A goal counts as reached where the "
        "planner says so and the true pose agrees."
    ),
    objects=("uneven",),
    variants=_KINDS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    counts_goals=True,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
    headline=("success", "pushes_mean", "time_mean_s", "falls"),
)
