"""Whether the stated uncertainty is right: how often the truth lies within the regions that the posterior gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident.identification.unknowns.mechanics import model_at
from push_ident.types import ObjectModel
from push_ident_sim.recordings.truth import load_truth, true_model
from push_ident_sim.studies.common.measuring import N_TRAIN, NOMINAL, fit_errors, gaussian_level, grouped, predicted_end, root_mean_square
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import label_below, markdown_table, millimetres, new_figure, save

_LEVELS: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
_QUANTITIES: Final = {
    "ends": "end poses of held-out pushes",
    "centre": "centre of friction",
    "pusher_friction": "friction of the pusher",
    "cells": "mass times friction of the cells",
}


def _run(case: Case, settings: CaseSettings) -> Json:
    train, test, sim_object = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    exact = replace(settings.noise, position_std=1e-9, yaw_std=1e-9)
    _, clean, _ = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, exact)
    result, values = fit_errors(train[:N_TRAIN], test, sim_object, DEFAULT_SOLVER, settings)
    truth, posterior = true_model(sim_object), result.posterior
    predicted = [predicted_end(posterior, record, true.poses.pose[-1]) for record, true in zip(test, clean, strict=True)]
    ends = [end for end in predicted if end is not None]
    rng = np.random.default_rng([case.model, 2])
    samples = [model_at(part.unknowns, z) for part, z in posterior.drawn(rng.normal(size=(500, posterior.most_unknowns)))]
    pusher = posterior.pusher_friction
    distance = np.log(truth.pusher_friction / pusher.value) * pusher.value / pusher.std
    return values | {
        "not_predicted": len(test) - len(ends),
        "levels": {
            "ends": [level for level, _, _ in ends],
            "centre": [_centre_level(truth, samples)],
            "pusher_friction": [round(float(gaussian_level(distance**2, 1)), 4)],
            "cells": _cell_levels(truth, posterior),
        },
        "expected_m": [expected for _, expected, _ in ends],
        "actual_m": [actual for _, _, actual in ends],
    }


def _centre_level(truth: ObjectModel, samples: Sequence[ObjectModel]) -> float:
    centres = np.array([model.centre_of_friction for model in samples])
    error = truth.centre_of_friction - centres.mean(axis=0)
    return round(float(gaussian_level(error @ np.linalg.solve(np.cov(centres.T), error), 2)), 4)


def _cell_levels(truth: ObjectModel, posterior: ModelPosterior) -> list[float]:
    """Levels of the cells' shares, as maps state them: mean and standard deviation of mass times friction."""
    model, product = posterior.model, truth.mass * truth.friction
    stated = model.mass * model.friction
    error = product / product.mean() - stated / stated.mean()
    return np.round(gaussian_level((error * stated.mean() / posterior.mass_friction_std) ** 2, 1), 4).tolist()


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {
        "curves": {quantity: [_share_within(results, quantity, level) for level in _LEVELS] for quantity in _QUANTITIES},
        "objects": {name: _row(cases) for name, cases in (grouped(results, "object_name") | {"all": list(results)}).items()},
    }


def _share_within(results: Sequence[CaseResult], quantity: str, level: float) -> float:
    return round(float(np.mean([u <= level for r in results for u in r.values["levels"][quantity]])), 4)


def _row(results: Sequence[CaseResult]) -> Json:
    return {
        **{quantity: _share_within(results, quantity, NOMINAL) for quantity in _QUANTITIES},
        **{key: root_mean_square(v for r in results for v in r.values[key]) for key in ("expected_m", "actual_m")},
        "pushes": sum(len(r.values["actual_m"]) for r in results),
        "not_predicted": sum(r.values["not_predicted"] for r in results),
    }


def _tables(summary: Json) -> str:
    head = [f"share within the {100 * NOMINAL:.0f} % region", *_QUANTITIES.values(), "error expected [mm]", "error observed [mm]"]
    return markdown_table(
        [*head, "pushes", "not predicted"],
        [
            [
                name,
                *(f"{100 * row[quantity]:.0f} %" for quantity in _QUANTITIES),
                *(millimetres(row[key]) for key in ("expected_m", "actual_m")),
                str(row["pushes"]),
                str(row["not_predicted"]),
            ]
            for name, row in summary["objects"].items()
        ],
    )


def _answer(summary: Json) -> str:
    row = summary["objects"]["all"]
    return (
        f"The 90 % regions hold {100 * row['ends']:.0f} % of {row['pushes']} true end poses, {100 * row['centre']:.0f} % of the centres of "
        f"friction and {100 * row['cells']:.0f} % of the cells."
    )


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (ax,) = new_figure(1, width=4.6, height=4.4)
    ax.plot([0, 1], [0, 1], color="black", linestyle=":", linewidth=1)
    for (quantity, label), colour in zip(_QUANTITIES.items(), ("#0072b2", "#d55e00", "#009e73", "#cc79a7"), strict=True):
        ax.plot(_LEVELS, summary["curves"][quantity], "o-", color=colour, markersize=4, label=label)
    ax.set_xlabel("probability of the region")
    ax.set_ylabel("share of truths within it")
    ax.grid(alpha=0.3)
    label_below(ax, 2)
    save(figure, folder / "coverage.svg")
    return {"coverage.svg": "Below the dotted line the stated uncertainty is too small, above it too large."}


STUDY = Experiment(
    name="coverage",
    title="Is the stated uncertainty right?",
    question=(
        f"How often the truth lies within the 90 % region of the posterior of {N_TRAIN} pushes: the end pose of a held-out push, "
        "the centre of friction, the friction of the pusher, and mass times friction of each cell as a share of the mean cell. "
        "The region of a cell is its value in the map with its standard deviation. Errors are root mean squares of the cell error."
    ),
    variants=("four-pushes",),
    needs_truth=True,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    draw=_draw,
)
