"""Roots of covariances, also of those that rounding has spoilt."""

from __future__ import annotations

import numpy as np

from push_ident.types import Float64Array


def lower_root(covariance: Float64Array) -> Float64Array:
    """Lower triangular L with L L' = covariance, shape (n, n): that of Cholesky where there is one.

    The inverse of a Hessian with very steep and very flat directions can have eigenvalues just below 0, and so can a covariance from which
    a part was taken away: they count as 0. Being triangular, L gives the first unknowns the same draws whatever follows them.
    """
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        value, vector = np.linalg.eigh(covariance)
        _, upper = np.linalg.qr((vector * np.sqrt(np.maximum(value, 0.0))).T)
        return np.asarray(np.where(np.diag(upper) < 0.0, -1.0, 1.0) * upper.T)


def square_root(covariance: Float64Array) -> Float64Array:
    """A with A A' = covariance, shape (n, n), also where some directions are known exactly."""
    value, vector = np.linalg.eigh(covariance)
    return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))
