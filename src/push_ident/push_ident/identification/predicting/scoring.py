"""Predict before a push, score after it, with the model of the pushes before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.identification.observing.observation import NoiseModel, observe_push
from push_ident.identification.predicting.prediction import CHI2_90, predict
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.mechanics import uniform_model
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import PushRecord, SolveStatus


@dataclass(frozen=True, slots=True)
class PushScore:
    """How well one push was predicted by the model of the pushes before it."""

    number: int
    """Of the push, from 1; the first is predicted by the prior."""
    source: str
    start: float
    """Stamp of the push [s]."""
    cell_error: float
    """Of the prediction at the end of the push [m]; NaN where it could not be simulated."""
    expected_cell_error: float
    """By the covariance of the prediction, root mean square [m]."""
    mahalanobis2: float
    """Squared Mahalanobis distance of the last pose: chi squared with 3 degrees of freedom where the covariance is right."""
    uniform_cell_error: float
    """Of equal cells with nominal values [m]."""
    explained: bool = True
    """Whether the model explains this push once it was fitted to it, too; False: its poses and the model contradict each other."""

    @property
    def within_90(self) -> bool:
        """Whether the last pose is in the 90 % region of the prediction."""
        return bool(self.mahalanobis2 <= CHI2_90)


@dataclass(frozen=True, slots=True)
class ScoreSummary:
    """Means over the scores of an object."""

    n: int
    mean_cell_error: float
    """[m]; NaN before the first push, as the other means."""
    mean_expected_cell_error: float
    """[m]"""
    mean_uniform_cell_error: float
    """[m]"""
    share_within_90: float


@dataclass(frozen=True, slots=True)
class RunningRecord:
    """Scores of an object in bounded memory: sums over all pushes, and the latest scores themselves."""

    n: int = 0
    """Number of pushes that could be predicted."""
    sums: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Over these: cell error, expected cell error, cell error of equal cells [m], pushes within the 90 % region."""
    latest: tuple[PushScore, ...] = ()
    """In the order of the pushes, including those that could not be predicted."""

    def add(self, score: PushScore, remembered: int = 200) -> RunningRecord:
        """With one more push; so many of the latest scores are kept."""
        record = replace(self, latest=(*self.latest, score)[-remembered:])
        if not np.isfinite(score.cell_error):
            return record
        values = (score.cell_error, score.expected_cell_error, score.uniform_cell_error, float(score.within_90))
        error, expected, uniform, within = (a + b for a, b in zip(self.sums, values, strict=True))
        return replace(record, n=self.n + 1, sums=(error, expected, uniform, within))

    @property
    def summary(self) -> ScoreSummary:
        """Means over all pushes that could be predicted."""
        if not self.n:
            return ScoreSummary(0, np.nan, np.nan, np.nan, np.nan)
        return ScoreSummary(self.n, *(value / self.n for value in self.sums))


def score_push(before: ModelPosterior, record: PushRecord, number: int, *, noise: NoiseModel | None = None) -> PushScore:
    """Predict a finished push with the model of the pushes before it, and compare.

    Args:
        before: the posterior before the push.
        record: the push.
        number: of the push, from 1.
        noise: of observed poses.
    """
    observed = observe_push(record, before.noise(noise))
    scenario = PushScenario(record.pusher, observed.pose[0], observed.time[-1:], record.order)
    prediction = predict(before, scenario, first_covariance=observed.first_covariance, noise=noise)
    plain = simulate(uniform_model(record.shape, before.prior), PushScenario(record.pusher, observed.pose[0], observed.time[-1:]))
    cells = record.shape.cells
    error = mahalanobis2 = np.nan
    if prediction.status is not SolveStatus.SIMULATION_FAILED:
        error = cell_error(cells, prediction.pose[-1], observed.pose[-1])
        difference = prediction.pose[-1] - observed.pose[-1]
        covariance = prediction.covariance[-1] + np.linalg.inv(observed.whitening[-1].T @ observed.whitening[-1])
        mahalanobis2 = float(difference @ np.linalg.solve(covariance, difference))
    return PushScore(
        number=number,
        source=record.source,
        start=float(record.pusher.time[0]),
        cell_error=error,
        expected_cell_error=prediction.cell_error_std,
        mahalanobis2=mahalanobis2,
        uniform_cell_error=cell_error(cells, plain.pose[-1], observed.pose[-1]),
    )


def summarise_scores(scores: Sequence[PushScore]) -> ScoreSummary:
    """Means over the pushes that could be predicted."""
    record = RunningRecord()
    for score in scores:
        record = record.add(score)
    return record.summary
