"""How closely objects are pushed along paths, in how many contacts, by what is known of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from push_ident.planning.path_planner import PathPlanner, PathStatus
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.plate import plate_in_bullet
from push_ident_sim.studies.common.pushed import GREEDY, IDENTIFIED, KINDS, PushedObject
from push_ident_sim.studies.common.random_objects import random_object
from push_ident_sim.studies.common.reaching import causes_in_words, failures, mean_of, share, share_in_words
from push_ident_sim.studies.paths.run import PATHS, SPEED, follow, is_followed, named_path

__all__ = ["STUDY"]


def _run(case: Case, settings: CaseSettings) -> Json:
    thing = plate_in_bullet(random_object(np.random.default_rng(case.model)))
    pushed = PushedObject(thing, case.variant, np.random.default_rng([case.model, 5]))
    planner = PathPlanner(pushed.truth.shape, pushed.settings, SPEED, greedy=case.variant == GREEDY)
    try:
        return {"paths": [follow(pushed, planner, name).values() for name in PATHS]}
    finally:
        pushed.close()


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_kind = grouped(results, "variant")
    main = by_kind.get(IDENTIFIED, results)
    return {
        "kinds": {kind: {name: _row(own, name) for name in PATHS} for kind, own in by_kind.items()},
        "runs": {name: _worst(main, name) for name in PATHS},
    }


def _of(results: Sequence[CaseResult], name: str) -> list[Json]:
    return [run for r in results for run in r.values["paths"] if run["name"] == name]


def _row(results: Sequence[CaseResult], name: str) -> Json:
    runs = _of(results, name)
    return {
        "followed": share(is_followed(run) for run in runs),
        "causes": failures((run["end"] for run in runs), PathStatus.ARRIVED.name),
        # Over paths of one length: the root of the mean square.
        "rms_m": _root_mean_square([run["rms_m"] for run in runs]),
        "rms_rad": _root_mean_square([run["rms_rad"] for run in runs]),
        "largest_m": max((run["largest_m"] for run in runs if run["largest_m"] is not None), default=None),
        "contacts": mean_of([run["contacts"] for run in runs]),
        "time_s": mean_of([run["time_s"] for run in runs]),
        "planning_s": mean_of([run["planning_s"] for run in runs]),
    }


def _root_mean_square(values: Sequence[float | None]) -> float | None:
    mean = mean_of([None if value is None else value**2 for value in values], 12)
    return None if mean is None else round(float(np.sqrt(mean)), 5)


def _worst(results: Sequence[CaseResult], name: str) -> Json:
    """The run that was followed least closely, for the picture."""
    runs = [(r.case.model, run) for r in results for run in r.values["paths"] if run["name"] == name]
    model, run = max(runs, key=lambda item: (not is_followed(item[1]), item[1]["rms_m"] or 0.0))
    return {"model": model, "end": run["end"], "rms_m": run["rms_m"], "poses": run["poses"]}


def _tables(summary: Json) -> str:
    head = ["", "path", "followed to its end (95 % interval)", "RMS", "largest", "contacts", "time", "a plan", "failures"]
    rows = [
        [
            kind,
            name,
            share_in_words(row["followed"]),
            "" if row["rms_m"] is None else f"{1e3 * row['rms_m']:.1f} mm, {np.degrees(row['rms_rad']):.1f}°",
            "" if row["largest_m"] is None else f"{1e3 * row['largest_m']:.0f} mm",
            f"{row['contacts']:.1f}",
            f"{row['time_s']:.0f} s",
            f"{row['planning_s']:.2f} s",
            causes_in_words(row["causes"]),
        ]
        for kind, own in summary["kinds"].items()
        for name, row in own.items()
    ]
    return markdown_table(head, rows)


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
        "Objects of random shape and uneven maps are pushed in Bullet along a line of 25 cm with one heading, a circle of 8 cm radius and "
        "an eight of two such circles, with the heading along the path. A path is followed by a chain of straight pushes: pushes do not "
        f"curve, and are not corrected while the tool moves. The tool moves at {1e3 * SPEED:.0f} mm/s and lifts off between pushes; after "
        "each, the pose is observed with the errors of perception. RMS is that of the true pose from the nearest point of the path, over "
        "the length that was followed. What is known is nothing (uniform), what three random pushes and those along the paths have shown "
        "(identified), or everything (truth); greedy knows as much as identified and chases a point 30 mm ahead. At most 60 contacts a "
        "path. Time is simulated, with 0.4 s of rest before and after each push; planning is time of the processor, on one thread, the "
        "mean of all plans."
    ),
    objects=("uneven",),
    variants=KINDS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
)
