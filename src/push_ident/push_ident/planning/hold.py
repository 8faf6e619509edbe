"""Support of an object that overhangs the edge of the table, by the cells on the table.

    margin = min over directions u of max over cells on the table of u . (r_i - c)

is the distance of the centre of mass c from the border of the hull of these cells; negative where it lies outside, and the object falls.
The edge is only a part of that border: an object with a narrow part on the table may fall to the side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import ndtr

from push_ident.errors import InputError
from push_ident.geometry.se2 import rotation
from push_ident.physics.overhang import TableEdge
from push_ident.types import Float64Array

RISK: Final = 0.01
"""Default of the largest chance that a push brings the centre of mass nearer to the border than the margin [1]: that of a fall is much
smaller."""


@dataclass(frozen=True, slots=True)
class EdgeHold:
    """An edge, and how far inside its support the centre of mass of an object must stay.

    Raises:
        InputError: a margin that is not a number >= 0, or a limit that is not a chance.
    """

    edge: TableEdge
    """Table frame."""
    margin: float = 0.01
    """Least distance of the centre of mass from the border of the cells on the table [m]. A push at a height h above the table moves the
    centre of the load by up to h times the friction coefficient: 10 mm for 25 mm and 0.4."""
    limit: float = RISK
    """Largest chance that a push brings it nearer [1]; what is riskier is not proposed."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.margin) and self.margin >= 0):
            raise InputError(f"The object is to be held by {self.margin} m, expected a number >= 0 in metres.")
        if not 0.0 < self.limit <= 0.5:
            raise InputError(f"The chance that the object is not held may be {self.limit}, expected more than 0 and at most 0.5.")

    def in_frame(self, frame: Float64Array) -> EdgeHold:
        """The same in a frame that lies at `frame` in this one, shape (3,), but for the span of the edge."""
        outward = rotation(float(frame[2])).T @ self.edge.outward
        return EdgeHold(TableEdge(outward, self.edge.offset - float(self.edge.outward @ frame[:2])), self.margin, self.limit)

    def margins(self, cells: Float64Array, centre: Float64Array, poses: Float64Array) -> Float64Array:
        """Distance of the centre of mass from the border of its support [m], negative outside: shape (...).

        Args:
            cells: centres [m], shape (n_cells, 2), object frame.
            centre: of mass [m], shape (..., 2), object frame.
            poses: of the object in the table frame, shape (..., 3).
        """
        n_directions = 32  # the distance is exact to 0.5 %
        angle = 2 * np.pi * np.arange(n_directions) / n_directions
        direction = np.stack([np.cos(angle), np.sin(angle)])
        along, poses = cells @ direction, np.asarray(poses)
        of_centre = np.broadcast_to(centre @ direction, (*poses.shape[:-1], n_directions))
        # n . (p + R r) = n . p + (R' n) . r
        yaw, (nx, ny) = poses[..., 2], self.edge.outward
        turned = np.stack([nx * np.cos(yaw) + ny * np.sin(yaw), ny * np.cos(yaw) - nx * np.sin(yaw)], axis=-1)
        on = turned @ cells.T <= -self.edge.beyond(poses[..., :2])[..., None]
        reach = np.stack([np.max(np.where(on, column, -np.inf), axis=-1) for column in along.T], axis=-1)
        return np.asarray(np.min(reach - of_centre, axis=-1))

    def risk(self, margins: Float64Array) -> Float64Array:
        """Chance that the centre of mass comes nearer to the border than the margin, from samples, shape (n, ...): shape (...).

        Taken from a normal distribution of the samples, since few of them lie in its tail.
        """
        if np.any(np.isnan(margins)):
            margins = np.where(np.isnan(margins), -np.inf, margins)
        finite = np.all(np.isfinite(margins), axis=0)
        safe = np.where(finite, margins, 0.0)
        spread = np.maximum(np.std(safe, axis=0), 1e-6)
        return np.asarray(np.where(finite, ndtr((self.margin - np.mean(safe, axis=0)) / spread), 1.0))

    def chance(self, cells: Float64Array, centres: Float64Array, pose: Float64Array, covariance: Float64Array) -> float:
        """Probability that the object is held by the margin [1].

        Args:
            cells: centres [m], shape (n_cells, 2), object frame.
            centres: of mass, by models that may be true [m], shape (n_models, 2), object frame.
            pose: as observed, shape (3,).
            covariance: of it, shape (3, 3).
        """
        value, vector = np.linalg.eigh(covariance)
        root = vector * np.sqrt(np.maximum(value, 0.0))
        # Poses and models are paired. Mean and deviation of 64 samples are known to an eighth of the deviation.
        n = max(64, len(centres))
        poses = pose + np.random.default_rng(0).normal(size=(n, 3)) @ root.T
        return 1.0 - float(self.risk(self.margins(cells, np.resize(centres, (n, 2)), poses)))
