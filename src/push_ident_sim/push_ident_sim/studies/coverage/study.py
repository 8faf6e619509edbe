"""Whether the stated uncertainty is right: how often the truth lies within the regions that the posterior gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident.identification.unknowns.mechanics import model_at
from push_ident.types import ObjectModel
from push_ident_sim.recordings.truth import load_truth, true_model
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.calibration import gaussian_level, predicted_end
from push_ident_sim.studies.common.drawing import label_below, markdown_table, millimetres, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import fit_errors, grouped

__all__ = ["STUDY"]

FloatArray = NDArray[np.float64]

_N_TRAIN = 4
_N_SAMPLES = 500
_LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
_NOMINAL = 0.9
_QUANTITIES = {
    "ends": "end poses of held-out pushes",
    "centre": "centre of friction",
    "pusher_friction": "friction of the pusher",
    "cells": "mass times friction of the cells",
}


def _run(case: Case, settings: CaseSettings) -> Json:
    train, test, thing = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    exact = replace(settings.noise, position_std=1e-9, yaw_std=1e-9)
    _, clean, _ = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, exact)
    result, values = fit_errors(train[:_N_TRAIN], test, thing, DEFAULT_SOLVER, settings)
    truth, posterior = true_model(thing), result.posterior
    ends = [end for observed, true in zip(test, clean, strict=True) if (end := predicted_end(posterior, observed, true.poses.pose[-1]))]
    samples = _samples(posterior, np.random.default_rng([case.model, 2]))
    pusher = posterior.pusher_friction
    distance = np.log(truth.pusher_friction / pusher.value) * pusher.value / pusher.std
    return values | {
        "not_predicted": len(test) - len(ends),
        "levels": {
            "ends": [end.level for end in ends],
            "centre": [_centre(truth, samples)],
            "pusher_friction": [round(float(gaussian_level(distance**2, 1)), 4)],
            "cells": _cells(truth, samples, posterior),
        },
        "expected_m": [end.expected for end in ends],
        "actual_m": [end.actual for end in ends],
    }


def _samples(posterior: ModelPosterior, rng: np.random.Generator) -> list[ObjectModel]:
    z = rng.multivariate_normal(posterior.z, posterior.covariance, size=_N_SAMPLES, method="eigh")
    return [model_at(posterior.unknowns, row) for row in z]


def _centre(truth: ObjectModel, samples: Sequence[ObjectModel]) -> float:
    centres = np.array([model.centre_of_friction for model in samples])
    error = truth.centre_of_friction - centres.mean(axis=0)
    return round(float(gaussian_level(error @ np.linalg.solve(np.cov(centres.T), error), 2)), 4)


def _cells(truth: ObjectModel, samples: Sequence[ObjectModel], posterior: ModelPosterior) -> list[float]:
    """Levels of the cells' shares in the logarithm; a cell without load lies outside every region."""
    shares = np.log([model.mass * model.friction / np.mean(model.mass * model.friction) for model in samples])
    left_out = (posterior.prior.mass_map_std**2 + posterior.prior.friction_map_std**2) * posterior.unknowns.map_remainder
    product = truth.mass * truth.friction
    with np.errstate(divide="ignore"):
        error = np.log(product / product.mean()) - shares.mean(axis=0)
    return np.round(gaussian_level(error**2 / (shares.var(axis=0) + left_out), 1), 4).tolist()


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {
        "curves": {quantity: [_share(results, quantity, level) for level in _LEVELS] for quantity in _QUANTITIES},
        "objects": {name: _row(own) for name, own in grouped(results, "object_name").items()} | {"all": _row(results)},
    }


def _share(results: Sequence[CaseResult], quantity: str, level: float) -> float:
    return round(float(np.mean([u <= level for r in results for u in r.values["levels"][quantity]])), 4)


def _row(results: Sequence[CaseResult]) -> Json:
    row: Json = {quantity: _share(results, quantity, _NOMINAL) for quantity in _QUANTITIES}
    for key in ("expected_m", "actual_m"):
        row[key] = round(float(np.sqrt(np.mean([v**2 for r in results for v in r.values[key]]))), 6)
    return row | {
        "pushes": sum(len(r.values["actual_m"]) for r in results),
        "not_predicted": sum(r.values["not_predicted"] for r in results),
    }


def _tables(summary: Json) -> str:
    head = [
        f"share within the {100 * _NOMINAL:.0f} % region",
        *_QUANTITIES.values(),
        "error expected [mm]",
        "error found [mm]",
        "pushes",
        "not predicted",
    ]
    return markdown_table(
        head,
        [
            [
                name,
                *(f"{100 * own[quantity]:.0f} %" for quantity in _QUANTITIES),
                *(millimetres(own[key]) for key in ("expected_m", "actual_m")),
                str(own["pushes"]),
                str(own["not_predicted"]),
            ]
            for name, own in summary["objects"].items()
        ],
    )


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (ax,) = new_figure(1, width=5.2, height=5.0)
    ax.plot([0, 1], [0, 1], color="black", linestyle=":", linewidth=1)
    for (quantity, label), colour in zip(_QUANTITIES.items(), ("#0072b2", "#d55e00", "#009e73", "#cc79a7"), strict=True):
        ax.plot(_LEVELS, summary["curves"][quantity], "o-", color=colour, markersize=4, label=label)
    ax.set_xlabel("probability of the region")
    ax.set_ylabel("share of truths within it")
    ax.grid(alpha=0.3)
    label_below(ax, 2)
    save(figure, folder / "coverage.png")
    return {"coverage.png": "Below the dotted line the stated uncertainty is too small, above it too large."}


STUDY = Experiment(
    name="coverage",
    place=50,
    title="Is the stated uncertainty right?",
    question=(
        "After 4 training pushes, how often does the truth lie within the 90 % region of the posterior? Compared are the end pose of a "
        "held-out push (the true one, three dimensions), the centre of friction, the friction of the pusher, and mass times friction "
        "of each cell as a share of the mean cell. The regions of a cell are those of a logarithm, so that a cell without load, as in "
        "the handle of the wrench, lies outside all of them. Expected and observed errors are root mean squares of the cell error."
    ),
    variants=("four-pushes",),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
)
