"""Predictions of recorded pushes by one model, beside what was observed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import CHI2_90, Prediction, predict
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.pages.tables import html_table
from push_ident.physics.scenario import PushScenario
from push_ident.types import Float64Array, PushRecord, SolveStatus, short_repr


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

    def __iter__(self) -> Iterator[PredictedPush]:
        return iter(self.pushes)

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
