"""Patterns of each push by their blocks, against all of their columns at once."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from push_ident.diagnosis.something_else.precision import AmplitudePrecision


def test_blocks_of_pushes_say_the_same_as_all_columns_together() -> None:
    rng = np.random.default_rng(3)
    sizes, n_rows, n_unknowns = (4, 7, 2), 12, 5
    blocks = [rng.normal(size=(n_rows, n)) for n in sizes]
    jacobian = rng.normal(size=(n_rows * len(sizes), n_unknowns))
    # The last column is nearly what the fit has explained already.
    blocks[2][:, 1] = jacobian[2 * n_rows :, 0] + 1e-4 * rng.normal(size=n_rows)
    hessian = jacobian.T @ jacobian + np.diag([1.0, 1.0, 0.3, 0.0, 0.0])
    columns = np.zeros((len(jacobian), sum(sizes)))
    ends = np.cumsum([0, *sizes])
    places = [slice(a, b) for a, b in pairwise(ends)]
    for k, block in enumerate(blocks):
        columns[k * n_rows : (k + 1) * n_rows, places[k]] = block
    information = columns.T @ (columns - jacobian @ np.linalg.solve(hessian, jacobian.T @ columns))
    slope, scales = rng.normal(size=(sum(sizes), 3)), (0.1, 1.0, 30.0)

    together = AmplitudePrecision.of(information)
    apart = AmplitudePrecision.of_blocks([block.T @ block for block in blocks], places, jacobian.T @ columns, hessian)
    np.testing.assert_allclose(apart.log_bayes_factors(slope, scales), together.log_bayes_factors(slope, scales), rtol=1e-9)
    for scale in scales:
        expected = np.linalg.solve(information + np.eye(len(information)) / scale**2, slope[:, 0])
        np.testing.assert_allclose(together.amplitudes(slope[:, 0], scale), expected, rtol=1e-9)
        np.testing.assert_allclose(apart.amplitudes(slope[:, 0], scale), expected, rtol=1e-8)
    # By its definition, with the determinant of the prior predictive.
    value = 0.5 * slope[:, 0] @ np.linalg.solve(information + np.eye(len(information)), slope[:, 0])
    value -= 0.5 * np.linalg.slogdet(np.eye(len(information)) + information)[1]
    assert together.log_bayes_factors(slope, (1.0,))[0, 0] == pytest.approx(value)
