"""How the stated uncertainty of a predicted push compares with its error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammainc

from push_ident.geometry.cells import cell_error
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import predict
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.physics.scenario import PushScenario
from push_ident.types import PushRecord, SolveStatus
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.experiment import CaseResult

__all__ = ["PredictedEnd", "calibration_row", "gaussian_level", "predicted_end", "predicted_ends"]

FloatArray = NDArray[np.float64]

_NOMINAL = 0.9
"""Probability of the regions that `calibration_row` counts."""
_FAR = 3.0
"""An error above this multiple of the expected one counts as far [-]."""


@dataclass(frozen=True, slots=True)
class PredictedEnd:
    """The predicted end of one push, compared with the true one."""

    level: float
    """Smallest probability of a region of the prediction that contains the true end pose [-]."""
    expected: float
    """Cell error that the prediction states, root mean square [m]."""
    actual: float
    """Cell error of the prediction [m]."""


def gaussian_level(squared_distance: ArrayLike, dimension: int) -> FloatArray:
    """Smallest probability of a Gaussian region about the mean that holds a point at this squared Mahalanobis distance."""
    return np.asarray(gammainc(dimension / 2, np.asarray(squared_distance, dtype=np.float64) / 2), dtype=np.float64)


def predicted_end(posterior: ModelPosterior, observed: PushRecord, true_end: FloatArray) -> PredictedEnd | None:
    """Predict the end of a push from its observed first pose.

    Args:
        posterior: of the object.
        observed: the push.
        true_end: pose of the object in the table frame after the push, without noise, shape (3,).

    Returns:
        None where no motion could be predicted.
    """
    start = observe_push(observed, posterior.noise())
    time = np.append(start.time, observed.poses.time[-1])
    prediction = predict(posterior, PushScenario(observed.pusher, start.pose[0], time), first_covariance=start.first_covariance)
    if prediction.status is SolveStatus.SIMULATION_FAILED:
        return None
    error = true_end - prediction.pose[-1]
    level = gaussian_level(error @ np.linalg.solve(prediction.covariance[-1], error), 3)
    actual = cell_error(observed.shape.cells, prediction.pose[-1], true_end)
    return PredictedEnd(round(float(level), 4), round(prediction.cell_error_std, 6), round(actual, 6))


def predicted_ends(posterior: ModelPosterior, observed: Sequence[PushRecord], true_ends: Sequence[FloatArray]) -> Json:
    """`PredictedEnd` of each push as lists (`end_levels`, `expected_m`, `actual_m`), and the number `not_predicted`."""
    ends = [end for record, true_end in zip(observed, true_ends, strict=True) if (end := predicted_end(posterior, record, true_end))]
    return {
        "not_predicted": len(observed) - len(ends),
        "end_levels": [end.level for end in ends],
        "expected_m": [end.expected for end in ends],
        "actual_m": [end.actual for end in ends],
    }


def calibration_row(results: Sequence[CaseResult]) -> Json:
    """Over all pushes of `predicted_ends`: share `within_90` % regions, share `beyond_3` expected errors, root mean squares [m]."""
    levels, expected, actual = (
        np.array([v for r in results for v in r.values[key]], dtype=np.float64) for key in ("end_levels", "expected_m", "actual_m")
    )
    return {
        "within_90": round(float(np.mean(levels <= _NOMINAL)), 4),
        "beyond_3": round(float(np.mean(actual > _FAR * expected)), 4),
        "expected_m": round(float(np.sqrt(np.mean(expected**2))), 6),
        "actual_m": round(float(np.sqrt(np.mean(actual**2))), 6),
        "pushes": len(levels),
        "not_predicted": sum(r.values["not_predicted"] for r in results),
    }
