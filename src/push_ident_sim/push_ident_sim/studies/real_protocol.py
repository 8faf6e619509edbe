"""The protocol of the paper's robot experiment: two training pushes, five test pushes, only the end poses of a push known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident_sim.recordings.truth import load_truth
from push_ident_sim.studies.common.measuring import MODELS, ends_of, error_row, fit_errors, grouped
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, mean_millimetres, millimetres

_N_TRAIN: Final = 2


def _run(case: Case, settings: CaseSettings) -> Json:
    train, test, sim_object = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    first = _N_TRAIN * int(case.variant.removeprefix("pair-"))
    pair = [ends_of(record) for record in train[first : first + _N_TRAIN]]
    return fit_errors(pair, test[:5], sim_object, DEFAULT_SOLVER, settings)[1]


def _summarise(results: Sequence[CaseResult]) -> Json:
    groups = grouped(results, "object_name") | {"all": list(results)}
    return {"objects": {name: {model: error_row(cases, model) for model in MODELS} for name, cases in groups.items()}}


def _tables(summary: Json) -> str:
    return markdown_table(
        ["mean cell error on held-out pushes [mm]", *MODELS, "identified: median", "90 %", "largest", "pushes"],
        [
            [
                name,
                *(mean_millimetres(row[model]) for model in MODELS),
                *(millimetres(row["identified"][key]) for key in ("median_m", "q90_m", "max_m")),
                str(row["identified"]["pushes"]),
            ]
            for name, row in summary["objects"].items()
        ],
    )


def _answer(summary: Json) -> str:
    identified, uniform, truth = (millimetres(summary["objects"]["all"][model]["mean_m"]) for model in ("identified", "uniform", "truth"))
    return f"Two pushes known by their end poses: {identified} mm (equal cells: {uniform} mm; true maps: {truth} mm)."


STUDY = Experiment(
    name="real-protocol",
    title="How far do two pushes go of which only the ends are known?",
    question=(
        "The protocol of the paper's robot experiment, simulated: two training pushes with one noisy pose before and one after "
        "each, five test pushes, four disjoint pairs a ground truth. scalar: equal cells with fitted values; uniform: with "
        "nominal ones."
    ),
    variants=tuple(f"pair-{i}" for i in range(4)),
    needs_truth=True,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
)
