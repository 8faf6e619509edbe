"""Error on held-out pushes against simulations and against time, for all six methods (Song & Boularias 2020, Fig. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from push_ident.identification.solvers import SOLVERS
from push_ident_sim.recordings.truth import load_truth
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import (
    COLOURS,
    label_below,
    log_millimetres,
    markdown_table,
    mean_in_millimetres,
    millimetres,
    new_figure,
    save,
)
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import curve_on_grid, error_row, fit_errors, grouped, history_with_end, learning_curve

__all__ = ["STUDY"]

_METHODS = tuple(SOLVERS)
_N_TRAIN = 4
_AXES = {"n_simulations": "simulations of a push", "time_s": "time [s]"}
_MOMENTS = (0.1, 1.0, 10.0, 30.0)
"""Seconds at which the table gives the error."""
_PAPER_ERROR = 0.015
"""Error of the paper within 30 s [m]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    train, test, thing = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    result, values = fit_errors(train[:_N_TRAIN], test, thing, case.variant, settings)
    return values | {"curve": learning_curve(history_with_end(result), result.uniform, test)}


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_method = grouped(results, "variant")
    ends = {axis: max(r.values["curve"][axis][-1] for r in results) for axis in _AXES}
    grids = {
        "n_simulations": np.unique(np.geomspace(1, max(ends["n_simulations"], 2), 60).round()),
        "time_s": np.geomspace(1e-3, max(ends["time_s"], 1.0), 60),
    }
    return {
        "methods": {
            method: {
                "cases": len(own),
                "final": error_row(own),
                "at_s": {str(moment): _at(own, moment) for moment in _MOMENTS},
                "below_paper": sum(r.values["curve"]["error_m"][-1] < _PAPER_ERROR for r in own),
                "median_time_s": round(float(np.median([r.values["time_s"] for r in own])), 3),
                "median_simulations": float(np.median([r.values["n_simulations"] for r in own])),
                "curves": {axis: _band(own, axis, grid) for axis, grid in grids.items()},
            }
            for method, own in by_method.items()
        },
        "uniform": error_row(results, "uniform"),
        "truth": error_row(results, "truth"),
    }


def _at(results: Sequence[CaseResult], moment: float) -> float:
    return round(float(np.mean([curve_on_grid(r.values["curve"], "time_s", np.array([moment])) for r in results])), 6)


def _band(results: Sequence[CaseResult], axis: str, grid: np.ndarray[Any, np.dtype[np.float64]]) -> Json:
    curves = np.array([curve_on_grid(r.values["curve"], axis, grid) for r in results])
    low, high = np.quantile(curves, [0.1, 0.9], axis=0)
    return {
        axis: [float(f"{v:.4g}") for v in grid],
        **{f"{name}_m": np.round(v, 6).tolist() for name, v in (("mean", curves.mean(axis=0)), ("q10", low), ("q90", high))},
    }


def _tables(summary: Json) -> str:
    moments = [f"after {float(m):g} s" for m in next(iter(summary["methods"].values()))["at_s"]]
    rows = [
        [
            method,
            *(millimetres(v) for v in own["at_s"].values()),
            mean_in_millimetres(own["final"]),
            f"{own['median_time_s']:.2f}",
            f"{own['median_simulations']:.0f}",
            f"{own['below_paper']} of {own['cases']}",
        ]
        for method, own in summary["methods"].items()
    ]
    head = [
        "mean cell error on held-out pushes [mm]",
        *moments,
        "at the end",
        "median solve [s]",
        "median simulations",
        "ended below 15 mm",
    ]
    uniform, truth = (millimetres(summary[name]["mean_m"]) for name in ("uniform", "truth"))
    return markdown_table(head, rows) + f"\n\nEqual cells with nominal values: {uniform} mm. The true maps: {truth} mm."


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, panels = new_figure(2, width=6.0, height=4.6)
    for ax, (axis, label) in zip(panels, _AXES.items(), strict=True):
        for method, own in summary["methods"].items():
            curve = own["curves"][axis]
            ax.step(curve[axis], 1e3 * np.array(curve["mean_m"]), where="post", color=COLOURS[method], label=method, linewidth=1.8)
            ax.fill_between(
                curve[axis],
                1e3 * np.array(curve["q10_m"]),
                1e3 * np.array(curve["q90_m"]),
                step="post",
                color=COLOURS[method],
                alpha=0.12,
                linewidth=0,
            )
        ax.axhline(1e3 * summary["truth"]["mean_m"], color=COLOURS["truth"], linestyle=":", label="true maps")
        ax.axhline(1e3 * _PAPER_ERROR, color=COLOURS["scalar"], linestyle="--", linewidth=1, label="paper, after 30 s")
        ax.set_xscale("log")
        ax.set_xlabel(label)
        log_millimetres(ax, "mean cell error on held-out pushes [mm]", low=0.3, high=60.0)
        label_below(ax, 3)
    save(figure, folder / "convergence.png")
    return {"convergence.png": "Mean over all objects and ground truths; bands from the 10 % to the 90 % quantile of the cases."}


STUDY = Experiment(
    name="convergence",
    place=10,
    title="Convergence of the six methods",
    question=(
        "How fast does the error on 12 held-out pushes fall while a method works on 4 training pushes? All methods have the same "
        "budget. At each moment the model with the best fit of the training pushes so far is tested. A simulation with its derivative "
        "counts as one."
    ),
    variants=_METHODS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
)
