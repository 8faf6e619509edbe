"""How the error on held-out pushes falls with the number of training pushes (Song & Boularias 2020, Fig. 4 b)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

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
from push_ident_sim.studies.common.measuring import curve_on_grid, error_row, fit_errors, grouped, history_with_end, learning_curve, pooled

__all__ = ["STUDY"]

_WITH_FORCES = "with_forces"
"""The same pushes for `gauss_newton`, with the forces of a sensor."""
_METHODS = ("gauss_newton", _WITH_FORCES, "fast_gradient")
_NUMBERS = (1, 2, 4, 8)
_FORCE_STD = 0.05
"""Noise of each axis at 120 Hz [N]: a few times that of a wrist sensor at rest."""
_COMPARED = (*_METHODS, "scalar", "uniform", "truth")


def _run(case: Case, settings: CaseSettings) -> Json:
    method, number = case.variant.rsplit("-", 1)
    noise = settings.noise
    if method == _WITH_FORCES:
        method, noise = "gauss_newton", replace(noise, force_std=_FORCE_STD)
    train, test, thing = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, noise)
    result, values = fit_errors(train[: int(number)], test, thing, method, settings)
    return values | {"curve": learning_curve(history_with_end(result), result.uniform, test)}


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {"numbers": {str(n): _of_number(n, results) for n in _NUMBERS if any(r.case.variant.endswith(f"-{n}") for r in results)}}


def _of_number(number: int, results: Sequence[CaseResult]) -> Json:
    by_method = {m: [r for r in results if r.case.variant == f"{m}-{number}"] for m in _METHODS}
    by_method = {method: own for method, own in by_method.items() if own}
    # Equal cells and true maps are the same in the cases of all methods.
    shared = next(iter(by_method.values()))
    groups = {m: (own, "identified") for m, own in by_method.items()} | {m: (shared, m) for m in ("scalar", "uniform", "truth")}
    return {
        "all": {name: error_row(own, model) for name, (own, model) in groups.items()},
        "objects": {
            thing: {name: error_row([r for r in own if r.case.object_name == thing], model) for name, (own, model) in groups.items()}
            for thing in grouped(shared, "object_name")
        },
        "errors_m": {name: pooled(own, model) for name, (own, model) in groups.items()},
        "solve": {m: _solve(own) for m, own in by_method.items()},
    }


def _solve(results: Sequence[CaseResult]) -> Json:
    """Time and simulations of the solves, and the mean error against the simulations spent on each push."""
    number = int(results[0].case.variant.rsplit("-", 1)[1])
    most = max(r.values["curve"]["n_simulations"][-1] for r in results) / number
    grid = np.unique(np.geomspace(1, max(most, 2.0), 25).round())
    curves = [curve_on_grid(r.values["curve"], "n_simulations", grid * number) for r in results]
    statuses = [r.values["status"] for r in results]
    return {
        "median_time_s": round(float(np.median([r.values["time_s"] for r in results])), 3),
        "max_time_s": round(float(np.max([r.values["time_s"] for r in results])), 3),
        "median_simulations": float(np.median([r.values["n_simulations"] for r in results])),
        "statuses": {status: statuses.count(status) for status in sorted(set(statuses))},
        "steps": grid.tolist(),
        "steps_error_m": np.round(np.mean(curves, axis=0), 6).tolist(),
    }


def _tables(summary: Json) -> str:
    numbers = summary["numbers"]
    head = ["mean cell error on held-out pushes [mm]", *(f"{n} push{'es' if n != '1' else ''}" for n in numbers)]
    names = [name for name in _COMPARED if all(name in own["all"] for own in numbers.values())]
    overall = [[name, *(mean_in_millimetres(own["all"][name]) for own in numbers.values())] for name in names]
    objects = list(next(iter(numbers.values()))["objects"])
    first = names[0]
    by_object = [[thing, *(mean_in_millimetres(own["objects"][thing][first]) for own in numbers.values())] for thing in objects]
    spread = [
        [
            f"{name}, {n} push{'es' if n != '1' else ''}",
            *_spread(own["all"][name]),
            f"{own['solve'][name]['median_time_s']:.2f}",
            _statuses(own["solve"][name]),
        ]
        for name in names
        if name in _METHODS
        for n, own in numbers.items()
    ]
    return "\n\n".join(
        [
            markdown_table(head, overall),
            f"By object, `{first}`:",
            markdown_table(head, by_object),
            "Over single pushes, all included:",
            markdown_table(["", "median [mm]", "90 % [mm]", "largest [mm]", "median solve [s]", "how the solves ended"], spread),
        ]
    )


def _spread(row: Json) -> list[str]:
    return [millimetres(row[key]) for key in ("median_m", "q90_m", "max_m")]


def _statuses(solve: Json) -> str:
    return ", ".join(f"{count} {status.replace('_', ' ')}" for status, count in solve["statuses"].items())


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    numbers = summary["numbers"]
    figure, (errors, steps) = new_figure(2, width=6.4, height=4.6)
    for i, (n, own) in enumerate(numbers.items()):
        names = [name for name in _COMPARED if name in own["errors_m"]]
        for j, name in enumerate(names):
            place = i + 0.16 * (j - (len(names) - 1) / 2)
            dots(errors, place, own["errors_m"][name], COLOURS[name], width=0.13, label=name if i == 0 else None)
        for style, method in zip(("-", ":", "--"), _METHODS, strict=True):
            if method in own["solve"]:
                solve = own["solve"][method]
                shade = 0.25 + 0.75 * (i + 1) / len(numbers)
                steps.step(
                    solve["steps"],
                    1e3 * np.array(solve["steps_error_m"]),
                    style,
                    where="post",
                    color=COLOURS[method],
                    alpha=shade,
                    label=f"{method}, {n}",
                )
    errors.set_xticks(range(len(numbers)), list(numbers))
    errors.set_xlabel("training pushes")
    log_millimetres(errors, "cell error on held-out pushes [mm]")
    label_below(errors, 5)
    errors.set_title("every dot one push, bars the means", fontsize=10)
    steps.set_xscale("log")
    steps.set_xlabel("simulations of each training push")
    log_millimetres(steps, "mean cell error on held-out pushes [mm]", low=0.5, high=50.0)
    label_below(steps, 4)
    steps.set_title("while the solver works", fontsize=10)
    save(figure, folder / "training.png")
    return {"training.png": "Error on held-out pushes by the number of training pushes, and against the simulations of the solvers."}


STUDY = Experiment(
    name="training",
    place=30,
    title="More training pushes",
    question=(
        "How well does the identified model predict held-out pushes after 1, 2, 4 and 8 training pushes? The first pushes of each "
        "ground truth are the training pushes; the 12 test pushes are always the same. For comparison: `gauss_newton` with the forces "
        "of a sensor with 0.05 N of noise as well (`with_forces`), equal cells with the scalars fitted to the same pushes (`scalar`), "
        "equal cells with nominal values (`uniform`), and the true maps (`truth`). The error of the true maps comes from the noise of "
        "the poses and the difference of the two engines."
    ),
    variants=tuple(f"{method}-{n}" for method in _METHODS for n in _NUMBERS),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
)
