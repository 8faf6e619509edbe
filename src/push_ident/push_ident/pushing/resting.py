"""Whether an object was moved: its mean pose at rest before a push against that after it, where single poses are noisy."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy.special import chdtri

from push_ident.geometry.se2 import wrap_angle
from push_ident.types import Float64Array

__all__ = ["RestingPose", "displacement"]

_CHANCE: Final = 1e-4
"""With which noise as stated passes for a motion."""
_EXACT: Final = 1e-12
"""Added to the variance of poses that claim to have none [m^2, rad^2]."""


@dataclass(slots=True)
class RestingPose:
    """Mean of the poses of an object at rest, whose errors are independent."""

    stamp: float = -np.inf
    """Of the latest pose [s]."""
    n: int = 0
    """Number of poses."""
    _first: Float64Array = field(default_factory=lambda: np.zeros(3))
    _sum: Float64Array = field(default_factory=lambda: np.zeros(3))
    _covariances: Float64Array = field(default_factory=lambda: np.zeros((3, 3)))

    def add(self, stamp: float, pose: Float64Array, covariance: Float64Array) -> None:
        """Take in (x, y, yaw) [m, m, rad] with its 3 x 3 covariance; one that is not newer than the latest is ignored."""
        if stamp <= self.stamp:
            return
        if not self.n:
            self._first = pose
        offset = pose - self._first
        offset[2] = wrap_angle(offset[2])
        self.stamp, self.n, self._sum, self._covariances = stamp, self.n + 1, self._sum + offset, self._covariances + covariance

    @property
    def mean(self) -> Float64Array:
        """(x, y, yaw) [m, m, rad]; the yaw is not wrapped."""
        return self._first + self._sum / max(self.n, 1)

    @property
    def covariance(self) -> Float64Array:
        """Of the mean, 3 x 3."""
        return self._covariances / max(self.n, 1) ** 2


def displacement(before: RestingPose, after: RestingPose) -> tuple[float, float, bool]:
    """Shift [m] and turn [rad] between two rests, and whether they are more than the noise of the poses."""
    change = after.mean - before.mean
    change[2] = wrap_angle(change[2])
    covariance = before.covariance + after.covariance + _EXACT * np.eye(3)
    distance2 = float(change @ np.linalg.solve(covariance, change))
    return float(np.hypot(change[0], change[1])), abs(float(change[2])), distance2 > chdtri(3, _CHANCE)
