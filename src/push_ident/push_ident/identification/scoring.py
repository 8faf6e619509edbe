"""Predict before, score after: what a model that had not seen a push said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.identification.identify import uniform_model
from push_ident.identification.observation import NoiseModel, observe_push
from push_ident.identification.prediction import NINETY, cell_error, predict
from push_ident.identification.result import ModelPosterior
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.types import Float64Array, PushRecord, SolveStatus

__all__ = ["PushScore", "RunningRecord", "ScoreSummary", "score_push", "summarise_scores"]

_REMEMBERED = 200
"""Scores that a running record holds one by one."""


@dataclass(frozen=True, slots=True)
class PushScore:
    """How well one push was predicted by the model of the pushes before it."""

    number: int
    """Of the push, from 1; the first is predicted by the prior."""
    source: str
    start: float
    """Stamp of the push [s]."""
    error: float
    """Cell error of the prediction at the end of the push [m]; NaN where it could not be simulated."""
    expected: float
    """That the prediction expected of itself, root mean square [m]."""
    distance2: float
    """Squared normalised error of the last pose: chi squared with 3 degrees of freedom where the covariance is right."""
    uniform: float
    """Cell error of equal cells with nominal values [m]."""

    @property
    def within_ninety(self) -> bool:
        """Whether the last pose lies in the 90 % region of the prediction."""
        return bool(self.distance2 <= NINETY)


@dataclass(frozen=True, slots=True)
class ScoreSummary:
    """The running record of an object."""

    n: int
    mean_error: float
    """[m]; NaN before the first push, as the others."""
    mean_expected: float
    """[m]"""
    mean_uniform: float
    """[m]"""
    share_within_ninety: float


@dataclass(frozen=True, slots=True)
class RunningRecord:
    """Scores of an object that is pushed for as long as one likes: sums over all pushes, and the latest ones themselves."""

    n: int = 0
    """Pushes that could be predicted."""
    sums: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Over these: error, expected error, error of equal cells [m], pushes within the 90 % region."""
    latest: tuple[PushScore, ...] = ()
    """In the order of the pushes, those that could not be predicted too."""

    def add(self, score: PushScore) -> RunningRecord:
        """With one more push."""
        record = replace(self, latest=(*self.latest, score)[-_REMEMBERED:])
        if not np.isfinite(score.error):
            return record
        values = (score.error, score.expected, score.uniform, float(score.within_ninety))
        error, expected, uniform, within = (a + b for a, b in zip(self.sums, values, strict=True))
        return replace(record, n=self.n + 1, sums=(error, expected, uniform, within))

    @property
    def summary(self) -> ScoreSummary:
        """Means over all pushes that could be predicted."""
        if not self.n:
            return ScoreSummary(0, np.nan, np.nan, np.nan, np.nan)
        return ScoreSummary(self.n, *(value / self.n for value in self.sums))


def score_push(
    before: ModelPosterior,
    record: PushRecord,
    number: int,
    *,
    noise: NoiseModel | None = None,
    settings: SimulationSettings | None = None,
) -> PushScore:
    """Predict a finished push with the model that did not know it, and compare.

    Args:
        before: the posterior before the push.
        record: the push.
        number: of the push, from 1.
        noise: of observed poses.
        settings: numerics of the simulation.
    """
    seen = observe_push(record, noise)
    prediction = predict(
        before,
        record.pusher,
        seen.pose[0],
        seen.time[-1:],
        first_covariance=seen.first_covariance,
        noise=noise,
        settings=settings,
        order=record.order,
    )
    plain = simulate(
        uniform_model(record.shape, before.prior), PushScenario(record.pusher, seen.pose[0], seen.time[-1:]), settings=settings
    )
    cells = record.shape.cells
    error = distance2 = np.nan
    if prediction.status is not SolveStatus.SIMULATION_FAILED:
        error = cell_error(cells, prediction.pose[-1], seen.pose[-1])
        off = prediction.pose[-1] - seen.pose[-1]
        distance2 = float(off @ np.linalg.solve(prediction.covariance[-1] + _covariance(seen.whitening[-1]), off))
    return PushScore(
        number=number,
        source=record.source,
        start=float(record.pusher.time[0]),
        error=error,
        expected=prediction.cell_error_std,
        distance2=distance2,
        uniform=cell_error(cells, plain.pose[-1], seen.pose[-1]),
    )


def summarise_scores(scores: Sequence[PushScore]) -> ScoreSummary:
    """Means over the pushes that could be predicted."""
    record = RunningRecord()
    for score in scores:
        record = record.add(score)
    return record.summary


def _covariance(whitening: Float64Array) -> Float64Array:
    return np.asarray(np.linalg.inv(whitening.T @ whitening), dtype=np.float64)
