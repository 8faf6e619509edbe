"""Error on held-out pushes against simulations and against time, for all six methods (Song & Boularias 2020, Fig. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.result import Checkpoint
from push_ident.identification.solvers import DEFAULT_SOLVER, SOLVERS
from push_ident.types import Float64Array, ObjectModel, PushRecord
from push_ident_sim.recordings.truth import load_truth
from push_ident_sim.studies.common.measuring import N_TRAIN, error_row, fit_errors, grouped, micrometres
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import (
    COLOURS,
    label_below,
    log_millimetres,
    markdown_table,
    mean_millimetres,
    millimetres,
    new_figure,
    save,
)

_AXES: Final = {"n_simulations": "simulations of a push", "time_s": "time [s]"}
_MOMENTS: Final = (0.1, 1.0, 10.0, 30.0)
"""At which the table gives the error [s]."""
_PAPER_ERROR: Final = 0.015
"""Error of the paper within 30 s [m]."""
_GRID: Final = 60
"""Points of the mean curves."""


def _run(case: Case, settings: CaseSettings) -> Json:
    train, test, sim_object = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    result, values = fit_errors(train[:N_TRAIN], test, sim_object, case.variant, settings)
    # The end of a solve may be more than its last model: `gauss_newton` averages over several fits.
    end = Checkpoint(result.n_simulations, result.time_s, result.cost, result.model)
    return values | {"curve": _learning_curve([*result.history, end], result.uniform, test)}


def _learning_curve(history: Sequence[Checkpoint], uniform: ObjectModel, test: Sequence[PushRecord]) -> Json:
    """Mean error on `test` of the best model so far against simulations and seconds; it begins with equal cells of nominal values."""
    chosen = np.unique(np.geomspace(1, len(history), 30).round().astype(int)) - 1  # points of a learning curve, at most
    points = [history[i] for i in chosen]
    return {
        "n_simulations": [0, *(p.n_simulations for p in points)],
        "time_s": [0.0, *(round(p.time_s, 5) for p in points)],
        "error_m": micrometres([np.nanmean(held_out_errors(model, test)) for model in (uniform, *(p.model for p in points))]),
    }


def error_at(curve: Json, axis: str, grid: Float64Array) -> Float64Array:
    """Error of the last point of a learning curve at or before each value of `grid` of `axis`."""
    last = np.searchsorted(np.asarray(curve[axis]), grid, side="right") - 1
    return np.asarray(curve["error_m"], dtype=np.float64)[last]


def _summarise(results: Sequence[CaseResult]) -> Json:
    ends = {axis: max(r.values["curve"][axis][-1] for r in results) for axis in _AXES}
    grids = {
        "n_simulations": np.unique(np.geomspace(1, max(ends["n_simulations"], 2), _GRID).round()),
        "time_s": np.geomspace(1e-3, max(ends["time_s"], 1.0), _GRID),
    }
    return {
        "methods": {
            method: {
                "cases": len(cases),
                "final": error_row(cases),
                "at_s": {
                    str(moment): round(float(np.mean([error_at(r.values["curve"], "time_s", np.array([moment])) for r in cases])), 6)
                    for moment in _MOMENTS
                },
                "below_paper": sum(r.values["curve"]["error_m"][-1] < _PAPER_ERROR for r in cases),
                "median_time_s": round(float(np.median([r.values["time_s"] for r in cases])), 3),
                "median_simulations": float(np.median([r.values["n_simulations"] for r in cases])),
                "curves": {axis: _mean_curve(cases, axis, grid) for axis, grid in grids.items()},
            }
            for method, cases in grouped(results, "variant").items()
        },
        "uniform": error_row(results, "uniform"),
        "truth": error_row(results, "truth"),
    }


def _mean_curve(results: Sequence[CaseResult], axis: str, grid: Float64Array) -> Json:
    curves = np.array([error_at(r.values["curve"], axis, grid) for r in results])
    return {axis: [float(f"{v:.4g}") for v in grid], "mean_m": np.round(curves.mean(axis=0), 6).tolist()}


def _tables(summary: Json) -> str:
    rows = [
        [
            method,
            *(millimetres(row["at_s"][str(moment)]) for moment in _MOMENTS),
            mean_millimetres(row["final"]),
            f"{row['median_time_s']:.2f}",
            f"{row['median_simulations']:.0f}",
            f"{row['below_paper']} of {row['cases']}",
        ]
        for method, row in summary["methods"].items()
    ]
    head = ["mean cell error on held-out pushes [mm]", *(f"after {moment:g} s" for moment in _MOMENTS), "at the end"]
    head += ["median solve [s]", "median simulations", "ended below 15 mm"]
    uniform, truth = (millimetres(summary[name]["mean_m"]) for name in ("uniform", "truth"))
    return markdown_table(head, rows) + f"\n\nEqual cells with nominal values: {uniform} mm. The true maps: {truth} mm."


def _answer(summary: Json) -> str:
    row = summary["methods"].get(DEFAULT_SOLVER) or next(iter(summary["methods"].values()))
    return (
        f"`{DEFAULT_SOLVER}`: {millimetres(row['final']['mean_m'])} mm after {row['median_time_s']:.2f} s "
        f"(equal cells: {millimetres(summary['uniform']['mean_m'])} mm)."
    )


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, panels = new_figure(2, width=5.0, height=3.8)
    for ax, (axis, label) in zip(panels, _AXES.items(), strict=True):
        for method, row in summary["methods"].items():
            curve = row["curves"][axis]
            ax.step(curve[axis], 1e3 * np.array(curve["mean_m"]), where="post", color=COLOURS[method], label=method, linewidth=1.8)
        ax.axhline(1e3 * summary["truth"]["mean_m"], color="black", linestyle=":", label="true maps")
        ax.axhline(1e3 * _PAPER_ERROR, color="#9a9a9a", linestyle="--", linewidth=1, label="paper, after 30 s")
        ax.set_xscale("log")
        ax.set_xlabel(label)
        log_millimetres(ax, "mean cell error on held-out pushes [mm]", low=0.3, high=60.0)
        label_below(ax, 3)
    save(figure, folder / "convergence.svg")
    return {"convergence.svg": "Mean over all objects and ground truths."}


STUDY = Experiment(
    name="convergence",
    title="Which of the six methods converges fastest, and how far?",
    question=(
        "The paper's Fig. 3: error on 12 held-out pushes while a method works on 4 training pushes, for at most 30 s of the "
        "processor, as in the paper. At each moment the model with the best fit so far is tested. A simulation with its "
        "derivative counts as one."
    ),
    variants=tuple(SOLVERS),
    needs_truth=True,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    draw=_draw,
)
