"""Derivatives by differences, with their uncertainty."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from push_ident.types import Float64Array


def ridders(f: Callable[[float], Float64Array], h: float, *, one_sided: bool) -> tuple[Float64Array, float]:
    """Derivative of f at 0 from differences over h, h / 2, h / 4, ..., extrapolated to zero length, and how far it may be off.

    Source: Ridders, Accurate computation of F'(x) and F'(x) F''(x), 1982.
    """
    base = 2.0 if one_sided else 4.0
    before: list[Float64Array] = []
    best, least = np.empty(0), np.inf
    at_zero = f(0.0) if one_sided else None
    for i in range(5):
        step = h / 2**i
        row = [(f(step) - at_zero) / step if at_zero is not None else (f(step) - f(-step)) / (2 * step)]
        for j, old in enumerate(before):
            row.append(row[j] + (row[j] - old) / (base ** (j + 1) - 1))
            error = float(max(np.abs(row[-1] - row[-2]).max(), np.abs(row[-1] - old).max()))
            if error < least:
                best, least = row[-1], error
        before = row
    return best, least


def compare_columns(
    f: Callable[[Float64Array], Float64Array],
    derivative: Float64Array,
    point: Float64Array,
    scale: Float64Array,
    *,
    n_body: int,
    whole: float,
) -> tuple[Float64Array, Float64Array]:
    """Relative error of each column of a derivative, and the relative uncertainty of its differences, each of shape (n,).

    Args:
        f: of all parameters, in the order of `Motion.jacobian`.
        derivative: of f at `point`, shape (..., n).
        point: the parameters, shape (n,).
        scale: of each of them, shape (n,).
        n_body: number of parameters before those of effects; coefficients and limits among them are never negative.
        whole: size of the quantity; a column is measured against a hundredth of it at least.
    """
    errors, doubts = np.zeros(len(point)), np.zeros(len(point))
    for column in range(len(point)):
        first = 1e-4 if column in (3, 6) else 3e-5 if column < 7 else 1e-3
        unit = scale[column] * np.eye(len(point))[column]
        one_sided = 7 <= column < n_body and point[column] < first * scale[column]
        estimate, uncertain = ridders(lambda h, unit=unit: f(point + h * unit), first, one_sided=one_sided)  # type: ignore[misc]
        exact = derivative[..., column] * scale[column]
        size = max(float(np.abs(exact).max()), 0.01 * whole, 1e-9)
        errors[column], doubts[column] = np.abs(exact - estimate).max() / size, uncertain / size
    return errors, doubts
