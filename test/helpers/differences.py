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
