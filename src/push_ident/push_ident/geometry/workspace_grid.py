"""Occupancy of the table around the objects, as perception publishes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.se2 import inverse, transform_points
from push_ident.types import BoolArray, Float64Array

_LEAST_AREA: Final = 4e-4
"""Smaller pieces are noise [m^2]: what perception ignores as an object."""
_FAR: Final = 1e6
"""Cells from the grid at which an object covers none of them."""


@dataclass(frozen=True, slots=True, eq=False)
class WorkspaceGrid:
    """Occupancy of a lattice of cells."""

    cells: NDArray[np.int8]
    """Occupancy [percent], -1 where nothing is seen, shape (rows, columns)."""
    pose: Float64Array
    """Of the lower corner, table frame, shape (3,): columns along x, rows along y."""
    size: float
    """Edge of a cell [m]."""

    @property
    def least(self) -> int:
        """Number of cells of the smallest piece that is no noise."""
        return max(1, round(_LEAST_AREA / self.size**2))

    def is_like(self, other: WorkspaceGrid) -> bool:
        """Whether the cells are at the same places."""
        return self.cells.shape == other.cells.shape and self.size == other.size and bool(np.array_equal(self.pose, other.pose))

    def within(self, bounds: tuple[float, float, float, float]) -> BoolArray:
        """Whether the centre of a cell is in (x_min, x_max, y_min, y_max) [m], table frame, shape (rows, columns)."""
        rows, columns = np.indices(self.cells.shape)
        x, y = transform_points(self.pose, (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) * self.size).T
        x_min, x_max, y_min, y_max = bounds
        return np.asarray((x_min <= x) & (x <= x_max) & (y_min <= y) & (y <= y_max)).reshape(self.cells.shape)

    def without(self, cells: BoolArray, outlines: Sequence[Float64Array]) -> BoolArray:
        """Some cells without those of tracked objects, shape (rows, columns); `outlines`: table frame [m], each of shape (n, 2)."""
        covered = np.zeros(cells.shape, dtype=np.uint8)
        for outline in outlines:
            corners = transform_points(inverse(self.pose), outline) / self.size - 0.5
            if float(np.abs(corners).max()) < _FAR:
                cv2.fillPoly(covered, [np.rint(corners).astype(np.int32)], (1,))
        # The border of an object may lie anywhere in a cell, and perception closes gaps by one more.
        return np.asarray(cells & (cv2.dilate(covered, np.ones((5, 5), dtype=np.uint8)) == 0))
