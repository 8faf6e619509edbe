"""How closely objects are pushed along paths, in how many contacts, by what is known of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from push_ident.planning.path_planner import PathPlanner, PathStatus
from push_ident.planning.path_steps import PathSteps
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.plate import plate_in_bullet
from push_ident_sim.studies.common.pushed import GREEDY, IDENTIFIED, TRUTH, UNIFORM, PushedObject
from push_ident_sim.studies.common.random_objects import random_object
from push_ident_sim.studies.common.reaching import causes_in_words, failures, mean_of, share, share_in_words
from push_ident_sim.studies.paths.run import PATHS, SPEED, follow, is_followed, named_path
from push_ident_sim.studies.paths.steered import HALF_WIDTH, follow_steered

__all__ = ["STUDY"]

_STRAIGHT = "straight"
"""By straight pushes that are not corrected; knows as much as identified."""
_SPEEDS = (0.02, 0.05, 0.1, 0.2)
"""Along the path [m/s]."""
_AT_ALL_SPEEDS = ("ahead", "circle")
"""Paths that who has identified the object follows at each speed; all else is at `SPEED`."""


def _run(case: Case, settings: CaseSettings) -> Json:
    thing = plate_in_bullet(random_object(np.random.default_rng(case.model)))
    kind = IDENTIFIED if case.variant == _STRAIGHT else case.variant
    pushed = PushedObject(thing, kind, np.random.default_rng([case.model, 5]))
    try:
        if case.variant in (_STRAIGHT, GREEDY):
            straight = PathPlanner(pushed.truth.shape, pushed.settings, SPEED, greedy=case.variant == GREEDY)
            return {"paths": [follow(pushed, straight, name).values() for name in PATHS]}
        planner = PathSteps(pushed.truth.shape, pushed.settings, HALF_WIDTH)
        speeds = {name: _SPEEDS if case.variant == IDENTIFIED and name in _AT_ALL_SPEEDS else (SPEED,) for name in PATHS}
        return {"paths": [follow_steered(pushed, planner, name, speed).values() for name in PATHS for speed in speeds[name]]}
    finally:
        pushed.close()


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_kind = grouped(results, "variant")
    main = by_kind.get(IDENTIFIED, results)
    return {
        "kinds": {kind: {name: _row(_of(own, name, SPEED)) for name in PATHS} for kind, own in by_kind.items()},
        "speeds": {str(speed): {name: _row(_of(main, name, speed)) for name in _AT_ALL_SPEEDS} for speed in _SPEEDS},
        "runs": {name: _worst(main, name) for name in PATHS},
    }


def _of(results: Sequence[CaseResult], name: str, speed: float) -> list[Json]:
    return [run for r in results for run in r.values["paths"] if run["name"] == name and run["speed"] == speed]


def _row(runs: Sequence[Json]) -> Json:
    return {
        "followed": share(is_followed(run) for run in runs),
        "in_one_contact": share(is_followed(run) and run["contacts"] == 1 for run in runs),
        "causes": failures((run["end"] for run in runs), PathStatus.ARRIVED.name),
        # Over paths of one length: the root of the mean square.
        "rms_m": _root_mean_square([run["rms_m"] for run in runs]),
        "rms_rad": _root_mean_square([run["rms_rad"] for run in runs]),
        "largest_m": max((run["largest_m"] for run in runs if run["largest_m"] is not None), default=None),
        "contacts": mean_of([run["contacts"] for run in runs]),
        "time_s": mean_of([run["time_s"] for run in runs]),
        "planning_s": mean_of([run["planning_s"] for run in runs]),
        "correction_median_s": mean_of([run["correction_median_s"] for run in runs], 4),
        "correction_p99_s": max((run["correction_p99_s"] for run in runs if run["correction_p99_s"] is not None), default=None),
        "correction_processor_s": mean_of([run["correction_processor_s"] for run in runs], 4),
    }


def _root_mean_square(values: Sequence[float | None]) -> float | None:
    mean = mean_of([None if value is None else value**2 for value in values], 12)
    return None if mean is None else round(float(np.sqrt(mean)), 5)


def _worst(results: Sequence[CaseResult], name: str) -> Json:
    """The run that was followed least closely, for the picture."""
    runs = [(r.case.model, run) for r in results for run in r.values["paths"] if run["name"] == name]
    model, run = max(runs, key=lambda item: (not is_followed(item[1]), item[1]["rms_m"] or 0.0))
    return {"model": model, "end": run["end"], "rms_m": run["rms_m"], "poses": run["poses"]}


_HEAD = [
    "path",
    "followed to its end (95 % interval)",
    "in one contact",
    "RMS",
    "largest",
    "contacts",
    "time",
    "a plan",
    "a correction",
    "failures",
]


def _cells(name: str, row: Json) -> list[str]:
    median, worst = row["correction_median_s"], row["correction_p99_s"]
    return [
        name,
        share_in_words(row["followed"]),
        f"{row['in_one_contact']['successes']} of {row['in_one_contact']['n']}",
        "" if row["rms_m"] is None else f"{1e3 * row['rms_m']:.1f} mm, {np.degrees(row['rms_rad']):.1f}°",
        "" if row["largest_m"] is None else f"{1e3 * row['largest_m']:.0f} mm",
        f"{row['contacts']:.1f}",
        f"{row['time_s']:.0f} s",
        f"{row['planning_s']:.2f} s",
        "" if median is None else f"{1e3 * median:.0f} / {1e3 * worst:.0f} ms",
        causes_in_words(row["causes"]),
    ]


def _tables(summary: Json) -> str:
    by_kind = [[kind, *_cells(name, row)] for kind, own in summary["kinds"].items() for name, row in own.items()]
    tables = markdown_table(["", *_HEAD], by_kind)
    by_speed = [
        [f"{1e3 * float(speed):.0f} mm/s", *_cells(name, row)]
        for speed, own in summary["speeds"].items()
        for name, row in own.items()
        if row["followed"]["n"]
    ]
    return f"{tables}\n\nIdentified, by the speed along the path:\n\n{markdown_table(['', *_HEAD], by_speed)}" if by_speed else tables


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, panels = new_figure(len(PATHS), width=3.2, height=3.2)
    for ax, (name, run) in zip(panels, summary["runs"].items(), strict=True):
        path, poses = named_path(name).poses, np.array(run["poses"]).reshape(-1, 3)
        ax.plot(path[:, 0], path[:, 1], color="0.75", linewidth=4)
        ax.plot(poses[:, 0], poses[:, 1], color=COLOURS["gauss_newton"], linewidth=1)
        ax.set_aspect("equal", "datalim")
        ax.set_title(f"{name}, object {run['model']}: {1e3 * (run['rms_m'] or np.nan):.1f} mm", fontsize=8)
    save(figure, folder / "paths.png")
    return {
        "paths.png": "The path (grey) and the origin of the object on its way, for the object that followed it least closely (identified)."
    }


STUDY = Experiment(
    name="paths",
    place=67,
    title="Along paths",
    question=(
        "Objects of random shape and uneven maps are pushed in Bullet along a line of 25 cm with a heading of 0.5 rad to it, the same line "
        "with the heading along it (ahead), a circle of 8 cm radius and an eight of two such circles, with the heading along the path. "
        "Pushes are planned as a goal of the cell plans them: where a contact can hold the object on the path, the tool is steered, at "
        f"each of 30 frames a second; else a straight push is made. The speed is {1e3 * SPEED:.0f} mm/s along the path, and where the "
        f"object is identified, ahead and on the circle, {', '.join(f'{1e3 * s:.0f}' for s in _SPEEDS)} mm/s. "
        "A correction is decided from one frame and begins with the next one. Frames have the noise of the camera and an error that "
        "lasts as long as the contact. A face can hold the object on a path only where the force that the path needs is within its cone of "
        "friction, on the face; else the contact is changed. RMS is that of the true pose from the nearest point of the path, over "
        "the length that was followed. What is known is nothing (uniform), what three random pushes and short contacts along the paths "
        "have shown (identified), or everything (truth). As much as identified know two that make straight pushes without corrections, "
        f"with the tool at {1e3 * SPEED:.0f} mm/s: straight plans a chain of them, greedy chases a point 30 mm ahead. At most 60 contacts "
        "a path. Time is simulated, with 0.4 s of rest before and after each contact; planning is time of the processor, the "
        "mean of all plans; corrections are timed by the wall clock, median / the worst 99th percentile of a run."
    ),
    objects=("uneven",),
    variants=(UNIFORM, IDENTIFIED, TRUTH, _STRAIGHT, GREEDY),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
)
