"""How surely an object is pushed to many goals in a row, without ever being put back, by what is known of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.planning.planner import PlanStatus
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.plate import plate_in_bullet
from push_ident_sim.studies.common.pushed import IDENTIFIED, KINDS, PushedObject
from push_ident_sim.studies.common.random_objects import random_object
from push_ident_sim.studies.common.reaching import causes_in_words, failures, mean_of, share, share_in_words
from push_ident_sim.studies.goals.run import LEVELS, random_goal, reach

__all__ = ["STUDY"]

_GOALS: Final = 28
_LEVEL: Final = next(iter(LEVELS))


def _run(case: Case, settings: CaseSettings) -> Json:
    rng = np.random.default_rng([case.model, 6])
    goals = [random_goal(rng) for _ in range(_GOALS)]
    thing = plate_in_bullet(random_object(np.random.default_rng(case.model)))
    pushed = PushedObject(thing, case.variant, np.random.default_rng([case.model, 7]))
    try:
        outcomes = [reach(pushed, goal, [_LEVEL]) for goal in goals]
    finally:
        pushed.close()
    return {
        "reached": [outcome.reached[_LEVEL] for outcome in outcomes],
        "pushes": [outcome.pushes[_LEVEL] for outcome in outcomes],
        "time_s": [round(outcome.time[_LEVEL], 2) for outcome in outcomes],
        "ends": [_end(outcome.ends[0], outcome.reached[_LEVEL], outcome.fell) for outcome in outcomes],
    }


def _end(status: str, reached: bool, fell: bool) -> str:
    if reached:
        return PlanStatus.ARRIVED.name
    if fell:
        return "FELL"
    return {PlanStatus.ARRIVED.name: "MISSED", PlanStatus.PUSH.name: "MAX_PUSHES"}.get(status, status)


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_kind = grouped(results, "variant")
    return {
        "kinds": {
            kind: {
                "goals": share(reached for r in own for reached in r.values["reached"]),
                "whole_chains": share(all(r.values["reached"]) for r in own),
                "causes": failures((end for r in own for end in r.values["ends"]), PlanStatus.ARRIVED.name),
                "pushes": mean_of([n for r in own for n in r.values["pushes"]]),
                "time_s": mean_of([t for r in own for t in r.values["time_s"]]),
                "pushes_by_goal": np.mean([r.values["pushes"] for r in own], axis=0).round(3).tolist(),
            }
            for kind, own in by_kind.items()
        },
        "falls": sum(end == "FELL" for r in results for end in r.values["ends"]),
    }


def _tables(summary: Json) -> str:
    head = ["", "goals reached (95 % interval)", f"all {_GOALS} in a row", "pushes a goal", "time a goal", "failures"]
    rows = [
        [
            kind,
            share_in_words(row["goals"]),
            f"{row['whole_chains']['successes']} of {row['whole_chains']['n']}",
            f"{row['pushes']:.2f}",
            f"{row['time_s']:.1f} s",
            causes_in_words(row["causes"]),
        ]
        for kind, row in summary["kinds"].items()
    ]
    return markdown_table(head, rows)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (axes,) = new_figure(1, width=6.0, height=3.2)
    for kind, row in summary["kinds"].items():
        number, total = np.arange(1, _GOALS + 1), np.cumsum(row["pushes_by_goal"])
        axes.plot(number, total, color=COLOURS["gauss_newton" if kind == IDENTIFIED else kind], label=kind)
    axes.set_xlabel("goals")
    axes.set_ylabel("pushes so far, mean of the objects")
    label_below(axes, 4)
    save(figure, folder / "chain.png")
    return {"chain.png": "Pushes made in a row of 28 goals."}


STUDY = Experiment(
    name="chain",
    place=68,
    title="Many goals in a row",
    question=(
        f"Objects of random shape and uneven maps are pushed in Bullet to {_GOALS} random poses in a row, in a square of 30 cm and any "
        "heading, each within 20 mm and 0.1 rad, and are never put back. A goal that is not reached in 20 pushes is given up, and the next "
        "one begins where the object is. Knowledge as in pushing to goals; greedy knows as much as identified and looks one push ahead."
    ),
    objects=("uneven",),
    variants=KINDS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
    headline=("falls",),
)
