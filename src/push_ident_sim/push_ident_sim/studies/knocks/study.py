"""How soon an object is back on its path after someone has displaced it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from push_ident.planning.path_planner import PathStatus
from push_ident.planning.path_steps import PathSteps
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.plate import plate_in_bullet
from push_ident_sim.studies.common.pushed import IDENTIFIED, TRUTH, UNIFORM, PushedObject
from push_ident_sim.studies.common.random_objects import random_object
from push_ident_sim.studies.common.reaching import causes_in_words, failures, share, share_in_words
from push_ident_sim.studies.paths.run import is_followed
from push_ident_sim.studies.paths.steered import HALF_WIDTH, Knock, follow_steered

__all__ = ["STUDY"]

_PATHS = ("ahead", "circle")
_SPEEDS = (0.05, 0.1, 0.2)
"""Along the path [m/s]."""
_AIM = 3.0
"""Time in which the object should be back [s]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    thing = plate_in_bullet(random_object(np.random.default_rng(case.model)))
    pushed = PushedObject(thing, case.variant, np.random.default_rng([case.model, 6]))
    planner, runs = PathSteps(pushed.truth.shape, pushed.settings, HALF_WIDTH), []
    try:
        for name in _PATHS:
            for speed in _SPEEDS:
                knock = Knock()
                outcome = follow_steered(pushed, planner, name, speed, knock).values()
                back = knock.back - knock.at
                runs.append(outcome | {"back_s": round(back, 3) if np.isfinite(back) else None, "contacts_to_be_back": knock.contacts})
    finally:
        pushed.close()
    return {"paths": runs}


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {
        "kinds": {
            kind: {str(speed): _row([run for r in own for run in r.values["paths"] if run["speed"] == speed]) for speed in _SPEEDS}
            for kind, own in grouped(results, "variant").items()
        }
    }


def _row(runs: Sequence[Json]) -> Json:
    times = [run["back_s"] for run in runs if run["back_s"] is not None]
    return {
        "back_in_time": share(run["back_s"] is not None and run["back_s"] <= _AIM for run in runs),
        "back": share(run["back_s"] is not None for run in runs),
        "in_the_same_contact": sum(run["back_s"] is not None and run["contacts_to_be_back"] == 0 for run in runs),
        "times_s": sorted(times),
        "followed": share(is_followed(run) for run in runs),
        "causes": failures((run["end"] for run in runs), PathStatus.ARRIVED.name),
    }


def _tables(summary: Json) -> str:
    head = [
        "",
        "speed",
        f"back within {_AIM:.0f} s (95 % interval)",
        "back at all",
        "in the same contact",
        "median",
        "longest",
        "failures after it",
    ]
    rows = [
        [
            kind,
            f"{1e3 * float(speed):.0f} mm/s",
            share_in_words(row["back_in_time"]),
            f"{row['back']['successes']} of {row['back']['n']}",
            f"{row['in_the_same_contact']}",
            f"{np.median(row['times_s']):.1f} s" if row["times_s"] else "",
            f"{row['times_s'][-1]:.1f} s" if row["times_s"] else "",
            causes_in_words(row["causes"]),
        ]
        for kind, own in summary["kinds"].items()
        for speed, row in own.items()
    ]
    return markdown_table(head, rows)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (axes,) = new_figure(1, width=6.0, height=4.2)
    for kind, own in summary["kinds"].items():
        n = sum(row["back"]["n"] for row in own.values())
        times = np.sort([t for row in own.values() for t in row["times_s"]])
        colour = COLOURS["gauss_newton" if kind == IDENTIFIED else kind]
        axes.step(np.append(0.0, times), np.arange(len(times) + 1) / max(n, 1), where="post", label=kind, color=colour)
    axes.axvline(_AIM, color="0.7", linewidth=1)
    axes.set_xlabel("time since the knock [s]")
    axes.set_ylabel("back on the path, share")
    label_below(axes, 3)
    save(figure, folder / "knocks.png")
    return {"knocks.png": "Share of the objects that are back on their path, against the time since a knock; the line is the aim."}


STUDY = Experiment(
    name="knocks",
    place=69,
    title="Displaced on the path",
    question=(
        "As along paths, on the line with the heading along it and on the circle. When the object is half-way, it is displaced by 40 mm to "
        "the side of the path and turned by 0.117 rad; a tool that steers it stays where it is. The time until it is back for the first "
        "time, within 5 mm and 4 degrees of the path, is simulated, with 0.4 s of rest before and after each contact."
    ),
    objects=("uneven",),
    variants=(UNIFORM, IDENTIFIED, TRUTH),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
)
