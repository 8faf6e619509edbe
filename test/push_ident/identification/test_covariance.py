"""Roots of covariances that rounding has spoilt."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.identification.results.posterior import lower_root


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


def test_near_singular_covariance_gives_the_first_unknowns_the_draws_of_a_regular_one() -> None:
    rows = np.random.default_rng(2).normal(size=(4, 4))
    regular = rows @ rows.T + 0.1 * np.eye(4)
    np.testing.assert_array_equal(lower_root(regular), np.linalg.cholesky(regular))
    more = np.zeros((5, 5))
    more[:4, :4] = regular
    more[4], more[:, 4] = more[3], more[:, 3]  # the last unknown is the one before it
    more[4, 4] -= 1e-14
    np.testing.assert_allclose(lower_root(more)[:4, :4], np.linalg.cholesky(regular), atol=1e-6)
