"""Predictions beside what was observed: before each push by the model of those before it, and of recorded pushes by one model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.observing.observation import NoiseModel, observe_push
from push_ident.identification.predicting.prediction import CHI2_90, Prediction, predict
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.mechanics import uniform_model
from push_ident.pages.tables import html_table
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import Float64Array, PushRecord, SolveStatus, short_repr


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
    """Predict a finished push, with its number from 1, by the model of the pushes before it, and compare."""
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


@dataclass(frozen=True, slots=True)
class PredictedPush:
    """One recorded push, predicted from its first pose."""

    record: PushRecord
    prediction: Prediction
    """Its covariance does not hold the noise of the observed pose."""
    observed: Float64Array
    """(x, y, yaw) at the end [m, m, rad], table frame, shape (3,): the mean of the frames at rest."""
    cell_error: float
    """At the end of the push [m]; NaN where it could not be simulated."""
    within_90: bool
    """Whether the observed end is in the 90 % region of the prediction."""

    __repr__ = short_repr


@dataclass(frozen=True, slots=True)
class Comparison(Sequence[PredictedPush]):
    """Predictions of several pushes, in their order."""

    pushes: tuple[PredictedPush, ...]

    def __len__(self) -> int:
        return len(self.pushes)

    def __getitem__(self, index: int) -> PredictedPush:  # type: ignore[override]
        return self.pushes[index]

    @property
    def mean_cell_error(self) -> float:
        """Over the pushes that could be simulated [m]; NaN where none could."""
        errors = np.array([push.cell_error for push in self.pushes])
        return float(np.nanmean(errors)) if np.isfinite(errors).any() else float("nan")

    def __repr__(self) -> str:
        inside = sum(push.within_90 for push in self.pushes)
        return f"Comparison({len(self)} pushes, mean cell error {1e3 * self.mean_cell_error:.1f} mm, {inside} within their 90 % regions)"

    def _repr_html_(self) -> str:
        """For notebooks: a row for each push."""
        rows = [
            (
                push.record.source or str(number),
                f"{1e3 * push.cell_error:.1f} mm",
                f"{1e3 * push.prediction.cell_error_std:.1f} mm",
                "yes" if push.within_90 else "no",
            )
            for number, push in enumerate(self.pushes, 1)
        ]
        return html_table(
            f"Mean cell error {1e3 * self.mean_cell_error:.1f} mm over {len(self)} pushes",
            ("push", "cell error at the end", "expected", "within 90 %"),
            rows,
        )


def compare_pushes(posterior: ModelPosterior, records: Sequence[PushRecord]) -> Comparison:
    """Predict recorded pushes from their first poses, and compare the ends.

    Raises:
        InputError: no push, or pushes of an object with other cells than the model.
    """
    if not records:
        raise InputError("There is no push to predict; give at least one push record.")
    expected = posterior.unknowns.shape.cells
    for got in (record.shape.cells for record in records):
        # Both are written with more digits than a millimetre.
        if len(expected) != len(got) or not np.allclose(expected.centres, got.centres, atol=1e-3):
            raise InputError(
                f"The model has {len(expected)} cells, the object in the bag {len(got)} others; "
                "predict bags that share the cells of the model."
            )
    return Comparison(tuple(_compare(posterior, record) for record in records))


def _compare(posterior: ModelPosterior, record: PushRecord) -> PredictedPush:
    observed = observe_push(record, posterior.noise())
    scenario = PushScenario(record.pusher, observed.pose[0], observed.time)
    prediction = predict(posterior, scenario, first_covariance=observed.first_covariance)
    difference = observed.pose[-1] - prediction.pose[-1]
    difference[2] = wrap_angle(difference[2])
    covariance = prediction.covariance[-1] + np.linalg.inv(observed.whitening[-1].T @ observed.whitening[-1])
    failed = prediction.status is SolveStatus.SIMULATION_FAILED
    return PredictedPush(
        record=record,
        prediction=prediction,
        observed=observed.pose[-1],
        cell_error=cell_error(record.shape.cells, prediction.pose[-1], observed.pose[-1]),
        within_90=bool(not failed and difference @ np.linalg.solve(covariance, difference) < CHI2_90),
    )
