"""Measures that studies share: errors on held-out pushes, means and shares with their uncertainty, times of calls that are compared."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaincinv, gammainc

from push_ident.geometry.cells import cell_error
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import held_out_errors, predict
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.results.result import Identification
from push_ident.physics.scenario import PushScenario
from push_ident.types import Float64Array, PoseTrack, PushRecord, SolveStatus
from push_ident_sim.objects import SimObject
from push_ident_sim.recordings.truth import true_model
from push_ident_sim.studies.common.study import CaseResult, CaseSettings, Json

MODELS: Final = ("identified", "scalar", "uniform", "truth")
"""Whose predictions are compared: the identified maps, equal cells with fitted scalars, equal cells with nominal values, the true maps."""
NOMINAL: Final = 0.9
"""Probability of the regions whose share of truths is counted [-]."""
N_TRAIN: Final = 4
"""Pushes that the studies of the paper's figures identify from."""


def micrometres(values: ArrayLike) -> list[float | None]:
    """Lengths [m] rounded to a micrometre, to keep files small; None where there is none (a simulation failed)."""
    return [round(float(v), 6) if np.isfinite(v) else None for v in np.ravel(values)]


def ends_of(record: PushRecord) -> PushRecord:
    """The same push with one frame before and one after it."""
    poses, ends = record.poses, [0, -1]
    return replace(record, poses=PoseTrack(poses.time[ends], poses.pose[ends], poses.covariance[ends]))


def fit_errors(
    train: Sequence[PushRecord], test: Sequence[PushRecord], sim_object: SimObject, method: str, settings: CaseSettings
) -> tuple[Identification, Json]:
    """Identify from `train`; the cell errors of `MODELS` on each push of `test` [m], and time and simulations of the solve."""
    result = identify(train, method=method, budget=settings.budget)
    models = dict(zip(MODELS, (result.model, result.scalar, result.uniform, true_model(sim_object)), strict=True))
    return result, solve_values(result) | {
        "errors_m": {name: micrometres(held_out_errors(model, test)) for name, model in models.items()},
    }


def solve_values(result: Identification) -> Json:
    """How a solve ended, its simulations and its time."""
    return {"status": result.status.name.lower(), "n_simulations": result.n_simulations, "time_s": round(result.time_s, 4)}


def gaussian_level(squared_distance: ArrayLike, dimension: int) -> Float64Array:
    """Smallest probability of a Gaussian region about the mean that holds a point at this squared Mahalanobis distance."""
    return np.asarray(gammainc(dimension / 2, np.asarray(squared_distance, dtype=np.float64) / 2), dtype=np.float64)


def predicted_end(posterior: ModelPosterior, record: PushRecord, true_end: Float64Array) -> tuple[float, float, float] | None:
    """Of the end of a push, predicted from its observed first pose: smallest probability of a region that contains the true end, and the
    expected and the actual cell error [m]. None where no motion could be predicted."""
    start = observe_push(record, posterior.noise())
    time = np.append(start.time, record.poses.time[-1])
    prediction = predict(posterior, PushScenario(record.pusher, start.pose[0], time), first_covariance=start.first_covariance)
    if prediction.status is SolveStatus.SIMULATION_FAILED:
        return None
    error = true_end - prediction.pose[-1]
    level = gaussian_level(error @ np.linalg.solve(prediction.covariance[-1], error), 3)
    actual = cell_error(record.shape.cells, prediction.pose[-1], true_end)
    return round(float(level), 4), round(prediction.cell_error_std, 6), round(actual, 6)


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
    means = [np.mean(of_truth) for group in grouped(results, "truth").values() if (of_truth := pooled(group, model))]
    standard_error = np.std(means, ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
    values = [np.mean(means), standard_error, np.median(errors), np.quantile(errors, 0.9), np.max(errors)]
    row: Json = dict(zip(("mean_m", "standard_error_m", "median_m", "q90_m", "max_m"), micrometres(values), strict=True))
    return row | {"pushes": len(errors), "not_simulated": sum(len(r.values["errors_m"][model]) for r in results) - len(errors)}


def share(successes: Iterable[bool]) -> Json:
    """`n`, `successes`, and the interval of Clopper and Pearson in which the true share lies at 95 % (`low`, `high`)."""
    outcomes = [bool(success) for success in successes]
    n, k = len(outcomes), sum(outcomes)
    low = float(betaincinv(k, n - k + 1, 0.025)) if k else 0.0
    high = float(betaincinv(k + 1, n - k, 1 - 0.025)) if k < n else 1.0
    return {"n": n, "successes": k, "share": round(k / n, 4) if n else None, "low": round(low, 4), "high": round(high, 4)}


def failures(ends: Iterable[str], good: str) -> dict[str, int]:
    """How often each other end occurred, the most frequent first."""
    return dict(Counter(end for end in ends if end != good).most_common())


def mean_of(values: Iterable[float | None], digits: int = 3) -> float | None:
    """Of those that were measured; None where none was."""
    known = [value for value in values if value is not None and np.isfinite(value)]
    return round(float(np.mean(known)), digits) if known else None


def root_mean_square(values: Iterable[float | None], digits: int = 6) -> float | None:
    """Of those that were measured; None where none was."""
    mean = mean_of([None if value is None else value**2 for value in values], 15)
    return None if mean is None else round(float(np.sqrt(mean)), digits)


Name = TypeVar("Name", bound=Hashable)
Result = TypeVar("Result")


def interleaved(calls: Mapping[Name, Callable[[], Result]], rounds: int) -> tuple[dict[Name, dict[str, Any]], dict[Name, Result]]:
    """Time calls in turn, so that a slow period of the machine affects all of them: `statistics` of each [s], and what it gave.

    Each is run once before the clock starts, then has `rounds` turns. The clock is the processor time of this process, on which other
    processes weigh less than on the wall clock.
    """
    results = {name: call() for name, call in calls.items()}
    seconds: dict[Name, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            started = time.process_time()
            call()
            seconds[name].append(time.process_time() - started)
    return {name: statistics(values) for name, values in seconds.items()}, results


def statistics(seconds: ArrayLike) -> dict[str, Any]:
    """`median_s`, the quartiles `q25_s` and `q75_s`, and how many there are (`n`)."""
    values = np.asarray(seconds, dtype=np.float64)
    low, middle, high = (float(f"{v:.4g}") for v in np.quantile(values, [0.25, 0.5, 0.75]))
    return {"median_s": middle, "q25_s": low, "q75_s": high, "n": len(values)}


def late_quantiles(seconds: Sequence[float]) -> dict[str, float]:
    """Median, 99 % quantile and maximum: `median_s`, `p99_s`, `worst_s`."""
    median, late, worst = (float(v) for v in np.quantile(seconds, [0.5, 0.99, 1.0])) if seconds else (0.0, 0.0, 0.0)
    return {"median_s": median, "p99_s": late, "worst_s": worst}


def milliseconds(timing: Mapping[str, Any]) -> str:
    """Median and quartiles for a table."""
    return f"{1e3 * timing['median_s']:.3g} ({1e3 * timing['q25_s']:.3g}–{1e3 * timing['q75_s']:.3g})"
