"""How well residuals determine the amplitudes of patterns beside everything that was fitted.

With columns Phi of a pattern, the derivative J of the residuals by the unknowns of the fit and H = J'J + P with the precision P of their
prior, the amplitudes have the information

    A = Phi' (1 - J H^-1 J') Phi

Patterns that each push has for itself have many columns, but Phi'Phi falls into one block a push. With D = 1/s^2 + Phi'Phi and S = J' Phi

    (1/s^2 + A)^-1 = D^-1 + D^-1 S' K^-1 S D^-1,      det(1/s^2 + A) = det D det K / det H,      K = H - S D^-1 S'

(Woodbury's identity and the determinant lemma: Golub & Van Loan, Matrix Computations, section 2.1.4), so that only matrices of the size of
one push and of the unknowns are factored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class AmplitudePrecision:
    """A of one hypothesis, factored for any prior standard deviation s."""

    size: Float64Array
    """Eigenvalues of A, or of the blocks of Phi'Phi, shape (n,)."""
    directions: tuple[tuple[slice, Float64Array], ...]
    """Their eigenvectors, with the columns to which each block belongs."""
    by_unknowns: Float64Array
    """S in these coordinates, shape (n_unknowns, n); of no unknowns where A itself was factored."""
    hessian: Float64Array
    """H, shape (n_unknowns, n_unknowns)."""

    @classmethod
    def of(cls, information: Float64Array) -> AmplitudePrecision:
        """From A itself, shape (n, n)."""
        size, directions = np.linalg.eigh(information)
        n = len(size)
        return cls(np.maximum(size, 0.0), ((slice(0, n), directions),), np.zeros((0, n)), np.zeros((0, 0)))

    @classmethod
    def of_blocks(
        cls, grams: Sequence[Float64Array], columns: Sequence[slice], by_unknowns: Float64Array, hessian: Float64Array
    ) -> AmplitudePrecision:
        """From the blocks of Phi'Phi, the columns of each, S of shape (n_unknowns, n) and H."""
        factors = [np.linalg.eigh(gram) for gram in grams]
        turned = np.hstack([by_unknowns[:, block] @ directions for block, (_, directions) in zip(columns, factors, strict=True)])
        size = np.maximum(np.concatenate([block for block, _ in factors]), 0.0)
        return cls(size, tuple((block, directions) for block, (_, directions) in zip(columns, factors, strict=True)), turned, hessian)

    def log_bayes_factors(self, slope: Float64Array, scales: Sequence[float]) -> Float64Array:
        """1/2 g' (1/s^2 + A)^-1 g - 1/2 log det(1 + s^2 A) for several s and slopes g, shapes (n_scales,) and (n, n_slopes): (n_scales,
        n_slopes) [nat]."""
        turned = np.concatenate([directions.T @ slope[columns] for columns, directions in self.directions])
        values = np.empty((len(scales), slope.shape[1]))
        for row, scale2 in zip(values, np.square(scales), strict=True):
            weight = 1.0 / (1.0 / scale2 + self.size)
            row[:] = 0.5 * weight @ turned**2 - 0.5 * np.sum(np.log1p(scale2 * self.size))
            if len(self.hessian):
                rest = self._rest(weight)
                by_unknowns = (self.by_unknowns * weight) @ turned
                row += 0.5 * np.sum(by_unknowns * np.linalg.solve(rest, by_unknowns), axis=0)
                row -= 0.5 * (np.linalg.slogdet(rest)[1] - np.linalg.slogdet(self.hessian)[1])
        return values

    def amplitudes(self, slope: Float64Array, scale: float) -> Float64Array:
        """(1/s^2 + A)^-1 g for one slope, shape (n,)."""
        turned = np.concatenate([directions.T @ slope[columns] for columns, directions in self.directions])
        weight = 1.0 / (1.0 / scale**2 + self.size)
        amplitudes = weight * turned
        if len(self.hessian):
            amplitudes += weight * (self.by_unknowns.T @ np.linalg.solve(self._rest(weight), self.by_unknowns @ amplitudes))
        return np.concatenate([directions @ amplitudes[columns] for columns, directions in self.directions])

    def _rest(self, weight: Float64Array) -> Float64Array:
        """K."""
        return np.asarray(self.hessian - (self.by_unknowns * weight) @ self.by_unknowns.T)
