"""How surely objects are pushed out over the edge of the table without falling, by what is known of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.planning.planner import PlanStatus
from push_ident_sim.objects import make_object
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.pushed import IDENTIFIED, KINDS, PushedObject
from push_ident_sim.studies.common.reaching import causes_in_words, failures, mean_of, share, share_in_words
from push_ident_sim.studies.edge.run import EDGE, EDGE_GOAL, PUSHES, overhang, random_start

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["STUDY"]

_PICTURES = 10


def _run(case: Case, settings: CaseSettings) -> Json:
    thing = make_object(case.object_name, case.model)
    rng = np.random.default_rng([case.model, 3])
    starts = [random_start(thing.outline, rng) for _ in range(settings.goals)]
    # The same noise for all kinds of model, as far as they push alike.
    pushed = PushedObject(thing, case.variant, np.random.default_rng([case.model, 4]), rigid=True, pushes=PUSHES)
    outcomes = []
    try:
        for start in starts:
            pushed.pose = start
            outcomes.append(overhang(pushed).values())
    finally:
        pushed.close()
    return {"starts": outcomes}


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_kind = grouped(results, "variant")
    main = by_kind.get(IDENTIFIED, results)
    return {
        "kinds": {kind: _row(own) for kind, own in by_kind.items()},
        "objects": {
            name: {kind: share(run["reached"] for run in _starts(rows)) for kind, rows in grouped(own, "variant").items()}
            for name, own in grouped(results, "object_name").items()
        },
        "runs": _worst([(r.case, run) for r in main for run in r.values["starts"]]),
        "falls": sum(run["end"] == "FELL" for run in _starts(results)),
    }


def _starts(results: Sequence[CaseResult]) -> list[Json]:
    return [run for r in results for run in r.values["starts"]]


def _row(results: Sequence[CaseResult]) -> Json:
    runs = _starts(results)
    good = [run for run in runs if run["reached"]]
    return {
        "success": share(run["reached"] for run in runs),
        "falls": sum(run["end"] == "FELL" for run in runs),
        "causes": failures((run["end"] for run in runs), PlanStatus.ARRIVED.name),
        "pushes": mean_of([run["pushes"] for run in good]),
        "time_s": mean_of([run["time_s"] for run in good]),
        "first_plan_s": mean_of([run["first_plan_s"] for run in runs if run["pushes"]]),
        "error_m": mean_of([run["error_m"] for run in good], 5),
        "least_margin_m": min((run["margin_m"] for run in runs if run["margin_m"] is not None), default=None),
    }


def _worst(runs: list[tuple[Case, Json]]) -> list[Json]:
    """Runs for pictures: failures first, then those of most pushes, then others."""
    order = sorted(runs, key=lambda item: (item[1]["reached"], -item[1]["pushes"]))
    half = _PICTURES // 2
    chosen = order[:half] + order[half :: max(1, (len(order) - half) // half)][:half]
    return [{"object": case.object_name, "model": case.model, "end": run["end"], "poses": run["poses"]} for case, run in chosen]


def _tables(summary: Json) -> str:
    head = ["", "success (95 % interval)", "falls", "pushes", "time", "first plan", "error", "least margin", "failures"]
    rows = [
        [
            kind,
            share_in_words(row["success"]),
            str(row["falls"]),
            _number(row["pushes"], "{:.2f}"),
            _number(row["time_s"], "{:.1f} s"),
            _number(row["first_plan_s"], "{:.1f} s"),
            _number(row["error_m"], "{:.1f} mm", 1e3),
            _number(row["least_margin_m"], "{:.0f} mm", 1e3),
            causes_in_words(row["causes"]),
        ]
        for kind, row in summary["kinds"].items()
    ]
    kinds = list(summary["kinds"])
    by_object = [
        [name, *(f"{own[kind]['successes']} of {own[kind]['n']}" if kind in own else "" for kind in kinds)]
        for name, own in summary["objects"].items()
    ]
    return markdown_table(head, rows) + "\n\n" + markdown_table(["", *kinds], by_object)


def _number(value: float | None, form: str, factor: float = 1.0) -> str:
    return "" if value is None else form.format(factor * value)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, panels = new_figure(5, 2, width=2.4, height=2.6)
    for ax in panels:
        ax.set_axis_off()
    for ax, run in zip(panels, summary["runs"], strict=False):
        _draw_run(ax, run)
    save(figure, folder / "edge.png")
    text = (
        "Ten runs of the identified model: failures and those of most pushes in the upper row, others below. The table is grey; outlines "
        "at the start and after each push, the last one dark, with the true centre of mass."
    )
    return {"edge.png": text}


def _draw_run(ax: Axes, run: Json) -> None:
    thing = make_object(run["object"], run["model"])
    centre = thing.mass @ thing.cells / thing.mass.sum()
    outlines = [transform_points(np.array(pose), thing.outline) for pose in run["poses"]]
    middle = np.mean([outline.mean(axis=0) for outline in outlines], axis=0)[1]
    ax.axvspan(EDGE.offset - 0.45, EDGE.offset, color="0.93")
    for k, outline in enumerate(outlines):
        last = k == len(outlines) - 1
        closed = np.vstack([outline, outline[:1]])
        ax.plot(closed[:, 0], closed[:, 1], color=COLOURS["gauss_newton"] if last else "0.6", linewidth=1.5 if last else 0.8)
    (x, y), *_ = transform_points(np.array(run["poses"][-1]), centre[None])
    ax.plot([x], [y], marker="o", color="black", markersize=3)
    ax.set_xlim(EDGE.offset - 0.45, EDGE.offset + 0.2)
    ax.set_ylim(middle - 0.3, middle + 0.3)
    ax.set_aspect("equal")
    ax.set_title(f"{run['object']} {run['model']}: {len(outlines) - 1} pushes\n{run['end']}", fontsize=7)


STUDY = Experiment(
    name="edge",
    place=66,
    title="Out over the edge of the table",
    question=(
        "Each object starts anywhere near an edge of the table, in any heading, and is pushed or pulled until it overhangs the edge by "
        f"{1e3 * EDGE_GOAL.overhang:.0f} mm in a pose in which it can be grasped, its centre of mass at least "
        f"{1e3 * EDGE_GOAL.held:.0f} mm inside the border of what supports it. Success: the planner says so, the true pose is within "
        f"{1e3 * EDGE_GOAL.position:.0f} mm and {np.degrees(EDGE_GOAL.turn):.0f}° of the pre-grasp pose, and it did not fall. The world is "
        "a rigid body in Bullet that tilts and falls, pushed at half its height; its contacts share the load in another way than the "
        "model, so that even the true map is not exact here. The planner knows poses with the errors of perception, and of the mechanics "
        "nothing (uniform), what three random pushes and those on the table have shown (identified), or everything (truth); greedy knows "
        "as much as identified and looks one push ahead. Time is simulated, with 0.4 s of rest before and after each push; the first plan "
        "is time of the processor, on one thread."
    ),
    variants=KINDS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    counts_goals=True,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
    headline=("falls",),
)
