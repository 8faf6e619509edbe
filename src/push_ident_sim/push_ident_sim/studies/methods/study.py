"""All six methods with the same budget: error beside time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from push_ident.identification.fitting.budget import Budget
from push_ident.identification.solvers import DEFAULT_SOLVER, SOLVERS
from push_ident.physics.simulation import compile_kernels
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, load_truth
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.benchmark import Benchmark, Piece, Settings
from push_ident_sim.studies.common.drawing import COLOURS, label_below, log_millimetres, markdown_table, millimetres, new_figure, save
from push_ident_sim.studies.common.experiment import CaseSettings
from push_ident_sim.studies.common.measuring import curve_on_grid, fit_errors, learning_curve

__all__ = ["STUDY"]

_N_TRAIN = 4
_OBJECTS = ("hammer", "book")
_SECONDS = 30.0
"""Budget of a method, as in the paper."""
_NEAR = 0.1


def _pieces(settings: Settings) -> list[Piece]:
    objects, methods, seconds, truth = list(_OBJECTS), list(SOLVERS), _SECONDS, TruthSettings()
    if settings.quick:
        objects, methods, seconds, truth = objects[:1], ["gauss_newton", "fast_gradient"], 0.5, TruthSettings(n_train=_N_TRAIN, n_test=2)
    case = CaseSettings(settings.truth_folder, Budget(max_seconds=seconds), truth, CameraNoise())
    return [Piece(f"{name}, {method}", _race, (name, settings.seed, method, case)) for method in methods for name in objects]


def _race(name: str, seed: int, method: str, settings: CaseSettings) -> Json:
    compile_kernels()
    train, test, thing = load_truth(settings.truth_folder, name, seed, settings.truth, settings.noise)
    result, values = fit_errors(train[:_N_TRAIN], test, thing, method, settings)
    errors = {model: float(np.mean([e for e in own if e is not None])) for model, own in values.pop("errors_m").items()}
    # The solve ends with a model of its own: `gauss_newton` gives the mean of its posterior.
    curve = learning_curve(result.history, result.uniform, test)
    for key, end in (("time_s", result.time_s), ("n_simulations", result.n_simulations), ("error_m", errors["identified"])):
        curve[key].append(end)
    best = min(curve["error_m"])
    near = next(i for i, error in enumerate(curve["error_m"]) if error <= (1 + _NEAR) * best)
    return {
        "object": name,
        "method": method,
        "cells": len(thing),
        "test_pushes": len(test),
        "budget_s": settings.budget.max_seconds,
        **values,
        **{f"{model}_m": error for model, error in errors.items()},
        "curve": curve,
        "best_m": best,
        "near_best_s": curve["time_s"][near],
        "near_best_simulations": curve["n_simulations"][near],
    }


def _summarise(results: Sequence[Json]) -> Json:
    return {"races": sorted(results, key=lambda race: str(race["object"]))}


def _tables(summary: Json) -> str:
    races = summary["races"]
    head = ["object, method", f"within {100 * _NEAR:.0f} % of its best [s]", "simulations until then", "whole solve [s]", "simulations"]
    head += ["ended", "best [mm]", "at the end [mm]"]
    rows = [
        [
            f"{race['object']}, {race['method']}",
            f"{race['near_best_s']:.2f}",
            f"{race['near_best_simulations']}",
            f"{race['time_s']:.2f}",
            f"{race['n_simulations']}",
            race["status"].replace("_", " "),
            millimetres(race["best_m"]),
            millimetres(race["identified_m"]),
        ]
        for race in races
    ]
    others = [
        [f"{race['object']}, {race['cells']} cells", *(millimetres(race[f"{model}_m"]) for model in ("uniform", "scalar", "truth"))]
        for race in races
        if race["method"] == DEFAULT_SOLVER
    ]
    return "\n\n".join(
        [
            f"{_N_TRAIN} training pushes, at most {races[0]['budget_s']:g} s; mean cell error, {races[0]['test_pushes']} held-out pushes:",
            markdown_table(head, rows),
            markdown_table(["on the same pushes", "nominal values [mm]", "fitted scalars [mm]", "true maps [mm]"], others),
        ]
    )


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    objects = sorted({race["object"] for race in summary["races"]})
    figure, panels = new_figure(len(objects), width=5.6, height=4.6)
    grid = np.geomspace(1e-3, max(race["curve"]["time_s"][-1] for race in summary["races"]), 300)
    for ax, name in zip(panels, objects, strict=True):
        own = [race for race in summary["races"] if race["object"] == name]
        for race in own:
            colour, near = COLOURS[race["method"]], np.array([max(race["near_best_s"], grid[0])])
            error = 1e3 * curve_on_grid(race["curve"], "time_s", grid)
            ax.step(grid, error, where="post", color=colour, label=race["method"], linewidth=1.8)
            ax.plot(near, 1e3 * curve_on_grid(race["curve"], "time_s", near), "o", color=colour, markersize=5)
        ax.axhline(1e3 * own[0]["truth_m"], color=COLOURS["truth"], linestyle=":", label="true maps")
        ax.set_xscale("log")
        ax.set_xlabel("time of the solve [s]")
        log_millimetres(ax, "mean cell error on held-out pushes [mm]", low=0.3, high=60.0)
        ax.set_title(f"{name}, {own[0]['cells']} cells", fontsize=10)
        label_below(ax, 3)
    save(figure, folder / "methods.png")
    return {"methods.png": f"Error against time; a dot where a method first comes within {100 * _NEAR:.0f} % of its best."}


STUDY = Benchmark(
    name="methods",
    place=50,
    title="The six methods",
    question=(
        "Two objects in PyBullet, observed as above. Times are those of the solve, by the wall clock, two solves side by side, each "
        "with one thread. The error is tested at up to 30 of the better points during the solve and at the end; better means a better "
        "fit of the training pushes, which need not predict others better. One ground truth an object: [Experiments](experiments.md) "
        "has averages over many."
    ),
    pieces=_pieces,
    summarise=_summarise,
    targets=lambda summary: [],
    tables=_tables,
    draw=_draw,
    jobs=2,
)
