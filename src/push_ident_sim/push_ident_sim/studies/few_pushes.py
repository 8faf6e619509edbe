"""How far 1, 2, 4 and 8 pushes go; and the protocol of the paper's robot experiment: two pushes, of which only the ends are known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident_sim.recordings.truth import load_truth
from push_ident_sim.studies.common.measuring import MODELS, ends_of, error_row, fit_errors, grouped, micrometres
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, mean_millimetres, millimetres

_PUSHES: Final = {"1-push": 1, "2-pushes": 2, "4-pushes": 4, "8-pushes": 8, "2-ends": 2}
_ENDS: Final = "2-ends"
"""Of the two pushes, one pose before and one after each is known."""


def _run(case: Case, settings: CaseSettings) -> Json:
    train, test, sim_object = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    train = [ends_of(record) for record in train] if case.variant == _ENDS else train
    n = _PUSHES[case.variant]
    draws = [fit_errors(train[k : k + n], test, sim_object, DEFAULT_SOLVER, settings)[1] for k in range(0, len(train) - n + 1, n)]
    return {
        "errors_m": {model: [error for draw in draws for error in draw["errors_m"][model]] for model in MODELS},
        "draw_means_m": micrometres([np.mean([error for error in draw["errors_m"]["identified"] if error is not None]) for draw in draws]),
        "times_s": [draw["time_s"] for draw in draws],
    }


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {"pushes": {variant: _objects(cases) for variant, cases in grouped(results, "variant").items()}}


def _objects(results: Sequence[CaseResult]) -> Json:
    groups = grouped(results, "object_name") | {"all": list(results)}
    return {
        name: {model: error_row(cases, model) for model in MODELS}
        | {
            "worst_m": max(mean for case in cases for mean in case.values["draw_means_m"]),
            "median_s": float(np.median([seconds for case in cases for seconds in case.values["times_s"]])),
        }
        for name, cases in groups.items()
    }


def _tables(summary: Json) -> str:
    head = ["pushes", *MODELS, "identified: median", "90 %", "largest", "worst draw", "pushes predicted", "median solve [s]"]
    rows = []
    for variant, objects in summary["pushes"].items():
        row = objects["all"]
        numbers = [millimetres(row["identified"][key]) for key in ("median_m", "q90_m", "max_m")]
        means = [mean_millimetres(row[model]) for model in MODELS]
        rows.append([variant, *means, *numbers, millimetres(row["worst_m"]), str(row["identified"]["pushes"]), f"{row['median_s']:.2f}"])
    names = [name for name in next(iter(summary["pushes"].values())) if name != "all"]
    by_object = [
        [variant, *(mean_millimetres(objects[name]["identified"]) for name in names)] for variant, objects in summary["pushes"].items()
    ]
    return f"{markdown_table(head, rows)}\n\n{markdown_table(['identified', *names], by_object)}"


def _answer(summary: Json) -> str:
    pushes, last = summary["pushes"], next(reversed(summary["pushes"].values()))["all"]
    means = ", ".join(f"{variant} {millimetres(objects['all']['identified']['mean_m'])}" for variant, objects in pushes.items())
    equal, truth = (millimetres(last[model]["mean_m"]) for model in ("uniform", "truth"))
    return f"Held-out pushes are predicted to [mm]: {means} (equal cells: {equal}; true maps: {truth})."


STUDY = Experiment(
    name="few-pushes",
    title="How far do a few pushes go?",
    question=(
        "Mean cell error [mm] on 12 held-out pushes after 1, 2, 4 and 8 training pushes, over disjoint draws of the 8 training pushes of "
        f"each ground truth. {_ENDS}: the protocol of the paper's robot experiment, simulated: two training pushes with one noisy pose "
        "before and one after each. scalar: equal cells with fitted values; uniform: with nominal ones; worst draw: the largest mean over "
        "the held-out pushes of a draw."
    ),
    variants=tuple(_PUSHES),
    needs_truth=True,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
)
