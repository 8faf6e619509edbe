"""Something that must not be touched, with the clearance that the uncertainty of its place asks for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import ndtri

from push_ident.geometry.distance_field import grown
from push_ident.geometry.se2 import transform_points
from push_ident.types import Float64Array

RISK: Final = 0.01
"""Largest chance that a push touches what it must not, and default of that of coming nearer to a border than the margin [1]: that of a fall
is much smaller."""
DEVIATIONS: Final = float(ndtri(1.0 - RISK))
"""Standard deviations that are exceeded on one side with the chance `RISK` [1]."""


@dataclass(frozen=True, slots=True)
class Obstacle:
    """Something that must not be touched."""

    name: str
    """For people."""
    outline: Float64Array
    """With its clearance, table frame [m], shape (n_vertices, 2)."""

    @classmethod
    def of_object(cls, object_id: str, outline: Float64Array, pose: Float64Array, covariance: Float64Array | None) -> Obstacle:
        """Another tracked object, by its outline, shape (n, 2), object frame, at a pose, shape (3,), with its covariance, (3, 3); None: not
        known."""
        wide = 0.0 if covariance is None else clearance(outline, covariance)
        return cls(f"`{object_id}`", grown(transform_points(pose, outline), wide))


def clearance(outline: Float64Array, covariance: Float64Array) -> float:
    """Distance beyond which a point of an outline, shape (n, 2), object frame, lies with the chance `RISK` at most [m], for a pose with a
    covariance, shape (3, 3)."""
    lever = float(np.max(np.linalg.norm(outline, axis=1)))
    across = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    return DEVIATIONS * float(np.sqrt(across + lever**2 * covariance[2, 2]))
