"""Draws of the posterior: from covariances that rounding has spoilt, and the separate outcomes of a push that they show."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import hammer
from push_ident.identification.predicting.prediction import Prediction, outcomes_of
from push_ident.identification.results.posterior import lower_root
from push_ident.types import Float64Array, SolveStatus

CELLS = hammer(3).shape.cells


def prediction(ends: Float64Array) -> Prediction:
    return Prediction(np.array([1.0]), ends[:1], np.eye(3)[None], 0.01, SolveStatus.CONVERGED, ends)


def drawn(share: float, offset: Float64Array, spread: float, n: int = 32) -> Float64Array:
    rng = np.random.default_rng(0)
    left = np.arange(n) < round(share * n)
    return np.array([0.5, 0.1, np.pi]) + np.where(left[:, None], 0.0, offset) + spread * rng.normal(size=(n, 3)) * [1.0, 1.0, 5.0]


@pytest.mark.parametrize("offset", [np.array([0.0, 0.0, 0.6]), np.array([0.03, 0.02, 0.0])])
def test_separate_outcomes_are_reported_with_their_chances(offset: Float64Array) -> None:
    ends = drawn(0.75, offset, 0.001)
    first, second = outcomes_of(CELLS, prediction(ends))
    assert (first.chance, second.chance) == (0.75, 0.25)
    np.testing.assert_allclose(second.end - first.end, offset, atol=0.005)


@pytest.mark.parametrize(
    "ends",
    [
        drawn(1.0, np.zeros(3), 0.01),
        np.linspace([0.0, 0.0, -0.5], [0.02, 0.0, 0.5], 32),
        drawn(0.95, np.array([0.0, 0.0, 0.8]), 0.001),
        drawn(0.5, np.array([1e-4, 0.0, 0.0]), 1e-7),
    ],
    ids=["one heap", "evenly spread", "a rare one", "a difference that poses do not show"],
)
def test_outcomes_that_are_not_separate_are_one(ends: Float64Array) -> None:
    (outcome,) = outcomes_of(CELLS, prediction(ends))
    assert outcome.chance == 1.0


def test_a_failed_prediction_has_no_outcome() -> None:
    failed = Prediction(np.array([1.0]), np.full((1, 3), np.nan), np.eye(3)[None], np.nan, SolveStatus.SIMULATION_FAILED)
    assert outcomes_of(CELLS, failed) == []


# --- roots of covariances


@pytest.mark.parametrize("rank", [0, 2, 4])
def test_root_of_a_covariance_with_eigenvalues_below_zero_counts_them_as_zero(rank: int) -> None:
    vectors, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(6, 6)))
    covariance = vectors @ np.diag(np.where(np.arange(6) < rank, 10.0 ** -np.arange(6), -1e-15)) @ vectors.T
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(covariance)
    root = lower_root(covariance)
    np.testing.assert_array_equal(root, np.tril(root))
    assert np.all(np.diag(root) >= 0.0)
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-14)
