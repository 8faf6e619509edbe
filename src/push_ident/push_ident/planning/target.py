"""Where an object is pushed to: a pose, and at an edge of the table what must hold it there."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from push_ident.planning.goal import CERTAIN, Goal
from push_ident.planning.hold import EdgeHold
from push_ident.types import Float64Array

__all__ = ["Target"]


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A pose with tolerances, and the edge that the object overhangs there."""

    goal: Goal
    hold: EdgeHold | None = None
    """None away from edges."""
    cells: Float64Array = field(default_factory=lambda: np.empty((0, 2)))
    """Centres of the object's cells [m], shape (n_cells, 2), object frame; with a hold only."""
    centres: Float64Array = field(default_factory=lambda: np.empty((0, 2)))
    """Of mass, by models that may be true [m], shape (n_models, 2), object frame; with a hold only."""

    def margin(self, pose: Float64Array) -> float:
        """Expected distance of the centre of mass from the border of its support at a pose, shape (3,) [m]; NaN without a hold."""
        if self.hold is None:
            return float("nan")
        return float(np.mean(self.hold.margins(self.cells, self.centres, np.tile(pose, (len(self.centres), 1)))))

    def overhang(self, outline: Float64Array) -> float:
        """How far an outline, shape (n, 2), table frame, reaches beyond the edge [m]; NaN without one."""
        return float("nan") if self.hold is None else float(np.max(self.hold.edge.beyond(outline)))

    def is_reached(self, pose: Float64Array, covariance: Float64Array) -> bool:
        """Whether the object is there, and held, at a pose, shape (3,), known with a covariance, shape (3, 3)."""
        if self.goal.chance(pose, covariance) < CERTAIN:
            return False
        return self.hold is None or self.hold.chance(self.cells, self.centres, pose, covariance) >= CERTAIN
