"""Maps as Gaussian processes over the cells (Matern 3/2), and the modes that describe them.

Source: Rasmussen & Williams, Gaussian Processes for Machine Learning (2006), section 4.2.
"""

from __future__ import annotations

import numpy as np

from push_ident.identification.prior import Prior
from push_ident.types import Float64Array, ObjectShape

__all__ = ["leading_modes", "map_covariance", "relative_distances"]


def leading_modes(shape: ObjectShape, prior: Prior) -> Float64Array:
    """Modes of a unit Gaussian process over the cells, scaled so that modes @ unit normal has its covariance."""
    value, vector = np.linalg.eigh(map_covariance(relative_distances(shape), prior.correlation_length))
    keep = np.argsort(value)[::-1][: prior.max_modes]
    return np.asarray(vector[:, keep] * np.sqrt(np.maximum(value[keep], 0.0)))


def relative_distances(shape: ObjectShape) -> Float64Array:
    """Between the cells, divided by the diagonal of the object, shape (n_cells, n_cells)."""
    centres = shape.cells.centres
    diagonal = float(np.linalg.norm(np.ptp(centres, axis=0))) + shape.cells.size
    return np.asarray(np.linalg.norm(centres[:, None] - centres[None], axis=2) / diagonal)


def map_covariance(distances: Float64Array, length: float) -> Float64Array:
    """Of a unit Gaussian process over the cells (Matern 3/2); `length` and `distances` are divided by the diagonal of the object."""
    scaled = np.sqrt(3) / length * distances
    return np.asarray((1 + scaled) * np.exp(-scaled))
