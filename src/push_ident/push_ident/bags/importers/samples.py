"""Samples of a recording: rows of numbers, time first."""

from __future__ import annotations

import numpy as np

from push_ident.types import Float64Array

__all__ = ["ascending"]


def ascending(samples: Float64Array) -> Float64Array:
    """Samples, shape (n, n_columns), time [s] in the first column, without those whose time does not advance."""
    if not len(samples):
        return samples
    return samples[np.append(True, np.diff(np.maximum.accumulate(samples[:, 0])) > 0)]
