"""Measures that experiments share: errors on held-out pushes, learning curves, means with their uncertainty."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.result import Checkpoint, Identification
from push_ident.types import ObjectModel, PushRecord
from push_ident_sim.objects import SimObject
from push_ident_sim.recordings.truth import true_model
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.experiment import CaseResult, CaseSettings

__all__ = [
    "MODELS", "curve_on_grid", "error_row", "fit_errors", "grouped", "history_with_end", "learning_curve", "micrometres", "pooled",
    "solve_row", "solve_values",
]  # fmt: skip

FloatArray = NDArray[np.float64]

MODELS = ("identified", "scalar", "uniform", "truth")
"""Whose predictions are compared: the identified maps, equal cells with fitted scalars, equal cells with nominal values, the true maps."""
_MAX_CHECKPOINTS = 30


def micrometres(values: ArrayLike) -> list[float | None]:
    """Lengths [m] rounded to a micrometre, to keep files small; None where there is none (a simulation failed)."""
    return [round(float(v), 6) if np.isfinite(v) else None for v in np.ravel(values)]


def fit_errors(
    train: Sequence[PushRecord], test: Sequence[PushRecord], thing: SimObject, method: str, settings: CaseSettings
) -> tuple[Identification, Json]:
    """Identify from `train`; the cell errors of `MODELS` on each push of `test` [m], and time and simulations of the solve."""
    result = identify(train, method=method, budget=settings.budget)
    models = dict(zip(MODELS, (result.model, result.scalar, result.uniform, true_model(thing)), strict=True))
    return result, solve_values(result) | {
        "errors_m": {name: micrometres(held_out_errors(model, test)) for name, model in models.items()},
    }


def solve_values(result: Identification) -> Json:
    """How a solve ended, its simulations and its time, and the priors that it compared with their probabilities."""
    return {
        "status": result.status.name.lower(),
        "n_simulations": result.n_simulations,
        "time_s": round(result.time_s, 4),
        "candidates": {candidate.name: round(candidate.probability, 4) for candidate in result.candidates},
    }


def solve_row(results: Sequence[CaseResult]) -> Json:
    """Of `solve_values` of many solves: times [s], how many ended in which way, and how many preferred which prior."""
    times = [r.values["time_s"] for r in results]
    preferred = [max(own, key=own.__getitem__) for r in results if (own := r.values["candidates"])]
    return {
        "median_time_s": round(float(np.median(times)), 3),
        "max_time_s": round(float(np.max(times)), 3),
        "statuses": dict(Counter(r.values["status"] for r in results).most_common()),
        "priors": dict(Counter(preferred).most_common()),
    }


def history_with_end(result: Identification) -> tuple[Checkpoint, ...]:
    """The history of a solve and its result, which may be more than the last model: `gauss_newton` averages over several fits."""
    return (*result.history, Checkpoint(result.n_simulations, result.time_s, result.cost, result.model))


def learning_curve(history: Sequence[Checkpoint], uniform: ObjectModel, test: Sequence[PushRecord]) -> Json:
    """Mean error on `test` of the best model so far against simulations and seconds; it begins with equal cells of nominal values."""
    n = len(history)
    chosen = np.unique(np.geomspace(1, max(n, 1), _MAX_CHECKPOINTS).round().astype(int)) - 1
    points = [history[i] for i in chosen if i < n]
    return {
        "n_simulations": [0, *(p.n_simulations for p in points)],
        "time_s": [0.0, *(round(p.time_s, 5) for p in points)],
        "error_m": micrometres([np.nanmean(held_out_errors(model, test)) for model in (uniform, *(p.model for p in points))]),
    }


def curve_on_grid(curve: Json, axis: str, grid: FloatArray) -> FloatArray:
    """Error of the last point of a learning curve at or before each value of `grid` of `axis`."""
    last = np.searchsorted(np.asarray(curve[axis]), grid, side="right") - 1
    return np.asarray(curve["error_m"], dtype=np.float64)[last]


def grouped(results: Sequence[CaseResult], key: str) -> dict[Any, list[CaseResult]]:
    """Results by an attribute of their cases, in the order of first appearance."""
    groups: dict[Any, list[CaseResult]] = {}
    for result in results:
        groups.setdefault(getattr(result.case, key), []).append(result)
    return groups


def pooled(results: Sequence[CaseResult], model: str) -> list[float]:
    """The errors of one of `MODELS` on all pushes of all cases that could be simulated [m]."""
    return [error for result in results for error in result.values["errors_m"][model] if error is not None]


def error_row(results: Sequence[CaseResult], model: str = "identified") -> Json:
    """Statistics of the errors of one of `MODELS` over all pushes of `results` [m].

    The standard error is over ground truths, which are independent; pushes of one are not.
    """
    errors = pooled(results, model)
    means = [np.mean(own) for group in grouped(results, "truth").values() if (own := pooled(group, model))]
    standard_error = np.std(means, ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
    values = [np.mean(means), standard_error, np.median(errors), np.quantile(errors, 0.9), np.max(errors)]
    row: Json = dict(zip(("mean_m", "standard_error_m", "median_m", "q90_m", "max_m"), micrometres(values), strict=True))
    return row | {"pushes": len(errors), "not_simulated": sum(len(r.values["errors_m"][model]) for r in results) - len(errors)}
