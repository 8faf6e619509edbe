"""The protocol of the paper's robot experiment: two training pushes, five test pushes, only the end poses of a push known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident.types import PoseTrack, PushRecord
from push_ident_sim.recordings.truth import load_truth
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import (
    COLOURS,
    dots,
    label_below,
    log_millimetres,
    markdown_table,
    mean_in_millimetres,
    millimetres,
    new_figure,
    save,
)
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import MODELS, error_row, fit_errors, grouped, pooled

__all__ = ["STUDY"]

_N_TRAIN = 2
_N_TEST = 5


def _run(case: Case, settings: CaseSettings) -> Json:
    train, test, thing = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    first = _N_TRAIN * int(case.variant.removeprefix("pair-"))
    return fit_errors([_ends(record) for record in train[first : first + _N_TRAIN]], test[:_N_TEST], thing, DEFAULT_SOLVER, settings)[1]


def _ends(record: PushRecord) -> PushRecord:
    """The same push with one frame before and one after it."""
    poses, ends = record.poses, [0, -1]
    return replace(record, poses=PoseTrack(poses.time[ends], poses.pose[ends], poses.covariance[ends]))


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {
        "all": {model: error_row(results, model) for model in MODELS},
        "objects": {
            name: {model: error_row(own, model) for model in MODELS} | {"errors_m": pooled(own, "identified")}
            for name, own in grouped(results, "object_name").items()
        },
    }


def _tables(summary: Json) -> str:
    rows = {**summary["objects"], "all": summary["all"]}
    return markdown_table(
        ["mean cell error on held-out pushes [mm]", *MODELS, "identified: median", "90 %", "largest", "pushes"],
        [
            [
                name,
                *(mean_in_millimetres(own[m]) for m in MODELS),
                *(millimetres(own["identified"][key]) for key in ("median_m", "q90_m", "max_m")),
                str(own["identified"]["pushes"]),
            ]
            for name, own in rows.items()
        ],
    )


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (ax,) = new_figure(1, width=6.4)
    for i, (_, own) in enumerate(summary["objects"].items()):
        dots(ax, i, own["errors_m"], COLOURS["gauss_newton"], width=0.4, label="identified" if i == 0 else None)
        for model in ("scalar", "uniform", "truth"):
            level = 1e3 * own[model]["mean_m"]
            ax.plot([i - 0.35, i + 0.35], [level, level], color=COLOURS[model], linewidth=2, label=model if i == 0 else None)
    ax.set_xticks(range(len(summary["objects"])), list(summary["objects"]))
    log_millimetres(ax, "cell error on held-out pushes [mm]")
    label_below(ax, 4)
    save(figure, folder / "real-protocol.png")
    return {"real-protocol.png": "Two training pushes of which only the end poses are known; every dot one test push, bars the means."}


STUDY = Experiment(
    name="real-protocol",
    place=40,
    title="The protocol of the robot experiment",
    question=(
        "Two training pushes with one noisy pose before and one after each, and none in between; five test pushes. The pushes are "
        "simulated here, not made by a robot. Each ground truth gives four disjoint pairs of training pushes. Test ends are the means "
        "of the frames at rest."
    ),
    variants=tuple(f"pair-{i}" for i in range(4)),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
)
