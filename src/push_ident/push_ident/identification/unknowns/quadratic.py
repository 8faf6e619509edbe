"""A cost that is a quadratic in the unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class Quadratic:
    """1/2 (z - point)' H (z - point) + gradient' (z - point)."""

    point: Float64Array
    """Shape (n,)."""
    gradient: Float64Array
    """At the point, shape (n,)."""
    hessian: Float64Array
    """Shape (n, n)."""

    @classmethod
    def zero(cls, n: int) -> Quadratic:
        """No information on `n` unknowns."""
        return cls(np.zeros(n), np.zeros(n), np.zeros((n, n)))

    @classmethod
    def beyond_unit_normal(cls, mean: Float64Array, covariance: Float64Array) -> Quadratic:
        """Cost of a normal prior of `mean`, shape (n,), and `covariance`, shape (n, n), less that of a unit normal one.

        Raises InputError where the covariance is singular.
        """
        try:
            np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            raise InputError("The covariance of the model is singular, expected a positive definite one; identify again.") from None
        return cls(mean, -mean, np.linalg.inv(covariance) - np.eye(len(mean)))

    def transformed(self, matrix: Float64Array) -> Quadratic:
        """The same cost of y with z = matrix @ y, up to the cost at zero, shape (n, m)."""
        zero = np.zeros(len(self.point))
        return Quadratic(np.zeros(matrix.shape[1]), matrix.T @ self.slope(zero), matrix.T @ self.hessian @ matrix)

    def slope(self, z: Float64Array) -> Float64Array:
        """Gradient at `z`, shape (n,)."""
        return np.asarray(self.gradient + self.hessian @ (z - self.point))

    def __call__(self, z: Float64Array) -> float:
        """Cost at `z`."""
        step = z - self.point
        return float(self.gradient @ step + 0.5 * step @ self.hessian @ step)

    def __add__(self, other: Quadratic) -> Quadratic:
        """The sum up to a constant, around the point of `other`."""
        return Quadratic(other.point, self.slope(other.point) + other.gradient, self.hessian + other.hessian)
