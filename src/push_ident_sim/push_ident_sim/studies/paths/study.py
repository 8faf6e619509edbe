"""How closely objects are pushed along paths, and how soon they are back after someone has displaced them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from push_ident.planning.path_planner import PathPlanner, PathStatus
from push_ident.planning.path_steps import PathSteps
from push_ident_sim.studies.common.measuring import failures, grouped, mean_of, root_mean_square, share
from push_ident_sim.studies.common.plate import plate_in_bullet
from push_ident_sim.studies.common.pushed import IDENTIFIED, TRUTH, PushedObject
from push_ident_sim.studies.common.random_objects import random_object
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import causes_text, markdown_table, number, share_text
from push_ident_sim.studies.paths.follow import (
    HALF_WIDTH,
    PATHS,
    SPEED,
    Displacement,
    follow_by_straight_pushes,
    follow_steered,
)  # fmt: skip

__all__ = ["STUDY"]

_STRAIGHT, _DISPLACED = "straight", "displaced"
"""By straight pushes that are not corrected; displaced half-way. Both know as much as identified."""
_SPEEDS: Final = (0.05, 0.1, 0.2)
"""Along the path, of displaced objects [m/s]."""
_DISPLACED_ON: Final = ("ahead", "circle")
_AIM: Final = 3.0
"""Time in which a displaced object should be back [s]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    sim_object = plate_in_bullet(random_object(np.random.default_rng(case.model)))
    kind = TRUTH if case.variant == TRUTH else IDENTIFIED
    pushed = PushedObject(sim_object, kind, np.random.default_rng([case.model, 6 if case.variant == _DISPLACED else 5]))
    try:
        if case.variant == _STRAIGHT:
            straight = PathPlanner(pushed.truth.shape, pushed.settings, SPEED)
            return {"paths": [follow_by_straight_pushes(pushed, straight, name).values() for name in PATHS]}
        planner = PathSteps(pushed.truth.shape, pushed.settings, HALF_WIDTH)
        if case.variant == _DISPLACED:
            runs = [follow_steered(pushed, planner, name, v, Displacement()) for name in _DISPLACED_ON for v in _SPEEDS]
        else:
            runs = [follow_steered(pushed, planner, name, SPEED) for name in PATHS]
        return {"paths": [run.values() for run in runs]}
    finally:
        pushed.close()


def _summarise(results: Sequence[CaseResult]) -> Json:
    runs = {kind: [run for r in cases for run in r.values["paths"]] for kind, cases in grouped(results, "variant").items()}
    displaced = runs.pop(_DISPLACED, [])
    return {
        "kinds": {kind: {name: _row([run for run in own if run["name"] == name]) for name in PATHS} for kind, own in runs.items()},
        "displaced": {str(v): _back_row([run for run in displaced if run["speed"] == v]) for v in _SPEEDS} if displaced else {},
    }


def _row(runs: Sequence[Json]) -> Json:
    corrections = [run["corrections_s"] for run in runs if run["corrections_s"]]
    return {
        "followed": share(run["end"] == PathStatus.ARRIVED.name for run in runs),
        "causes": failures((run["end"] for run in runs), PathStatus.ARRIVED.name),
        # Over paths of one length: the root of the mean square.
        "rms_m": root_mean_square((run["rms_m"] for run in runs), 5),
        "rms_rad": root_mean_square((run["rms_rad"] for run in runs), 5),
        "contacts": mean_of(run["contacts"] for run in runs),
        "time_s": mean_of(run["time_s"] for run in runs),
        "correction_median_s": mean_of((median for median, _ in corrections), 4),
        "correction_p99_s": max((late for _, late in corrections), default=None),
    }


def _back_row(runs: Sequence[Json]) -> Json:
    times = sorted(run["back_s"] for run in runs if run["back_s"] is not None)
    return {
        "in_time": share(run["back_s"] is not None and run["back_s"] <= _AIM for run in runs),
        "median_s": round(float(np.median(times)), 3) if times else None,
        "longest_s": times[-1] if times else None,
        "causes": failures((run["end"] for run in runs), PathStatus.ARRIVED.name),
    }


def _tables(summary: Json) -> str:
    kinds = summary["kinds"]
    rows = [[name, *(_path_text(paths[name]) for paths in kinds.values())] for name in PATHS]
    late = [row["correction_p99_s"] for paths in kinds.values() for row in paths.values() if row["correction_p99_s"] is not None]
    tables = [markdown_table(["path: followed to its end; RMS; contacts; time", *kinds], rows)]
    if late:
        tables.append(f"99 % of the corrections of a run were decided within {1e3 * max(late):.0f} ms by the wall clock.")
    if summary["displaced"]:
        rows = [
            [
                f"{1e3 * float(speed):.0f} mm/s",
                share_text(row["in_time"]),
                number(row["median_s"], "{:.1f} s"),
                number(row["longest_s"], "{:.1f} s"),
                causes_text(row["causes"]),
            ]
            for speed, row in summary["displaced"].items()
        ]
        head = ["displaced, speed", f"back within {_AIM:.0f} s (95 % interval)", "median", "longest", "failures after it"]
        tables.append(markdown_table(head, rows))
    return "\n\n".join(tables)


def _path_text(row: Json) -> str:
    """Such as `4/4; 2.5 mm, 1.6°; 9.8; 18 s`, with the ends of runs that failed."""
    rms = number(row["rms_m"], "{:.1f} mm", 1e3) + ", " + number(row["rms_rad"], "{:.1f}°", float(np.degrees(1.0)))
    followed = f"{row['followed']['successes']}/{row['followed']['n']}" + "".join(f", {n} {end}" for end, n in row["causes"].items())
    return "; ".join([followed, rms, number(row["contacts"], "{:.1f}"), number(row["time_s"], "{:.0f} s")])


def _answer(summary: Json) -> str:
    answers = []
    if row := summary["kinds"].get(IDENTIFIED):
        errors = [path["rms_m"] for path in row.values() if path["rms_m"] is not None]
        answers.append(f"Identified: RMS {1e3 * min(errors):.1f} to {1e3 * max(errors):.1f} mm from the path")
    if rows := summary["displaced"].values():
        back, n = (sum(row["in_time"][key] for row in rows) for key in ("successes", "n"))
        answers.append(f"displaced by 40 mm, back within {_AIM:.0f} s in {back} of {n} runs")
    return "; ".join(answers) + "."


STUDY = Experiment(
    name="paths",
    title="How closely are objects pushed along paths?",
    question=(
        "Objects of random shape and uneven maps are pushed in Bullet along a line of 25 cm with a heading of 0.5 rad to it, the "
        "same line with the heading along it (ahead), a circle of 8 cm radius and an eight of two such circles, at "
        f"{1e3 * SPEED:.0f} mm/s. Where a contact can hold the object on the path, the tool is steered at each of 30 frames a "
        "second; else a straight push is made. Frames have the noise of the camera and an error that lasts as long as the "
        "contact. RMS: of the true pose from the nearest point of the path. Knowledge as in `goals`; straight: as identified, by "
        "straight pushes alone; displaced: half-way, by 40 mm to the side and 0.117 rad, and back within 5 mm and 4 degrees."
    ),
    objects=("uneven",),
    variants=(IDENTIFIED, TRUTH, _STRAIGHT, _DISPLACED),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
)
