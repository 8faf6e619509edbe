"""What stands on the table beside the tracked objects, from perception's occupancy of the workspace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.distance_field import DistanceField, contours, grown, pieces
from push_ident.geometry.se2 import transform_points
from push_ident.planning.keep_out import Obstacle
from push_ident.types import BoolArray, Float64Array

LEAST_AREA: Final = 4e-4
"""Smaller pieces are noise [m^2]: what perception ignores as an object."""
_OCCUPIED: Final = 50
"""Least occupancy of a cell that shows something [percent]; perception writes 100."""


@dataclass(frozen=True, slots=True, eq=False)
class WorkspaceGrid:
    """Occupancy of a lattice of cells."""

    cells: NDArray[np.int8]
    """Occupancy [percent], -1 where nothing is seen, shape (rows, columns)."""
    pose: Float64Array
    """Of the lower corner, table frame, shape (3,): columns along x, rows along y."""
    size: float
    """Edge of a cell [m]."""

    def is_like(self, other: WorkspaceGrid) -> bool:
        """Whether the cells are at the same places."""
        return self.cells.shape == other.cells.shape and self.size == other.size and bool(np.array_equal(self.pose, other.pose))

    def centres(self, cells: BoolArray) -> Float64Array:
        """Centres of some cells, table frame [m], shape (n, 2)."""
        return transform_points(self.pose, (np.argwhere(cells)[:, ::-1] + 0.5) * self.size)

    def without(self, cells: BoolArray, tracked: Sequence[Obstacle]) -> BoolArray:
        """Some cells without those of tracked objects, shape (rows, columns)."""
        left, centres = cells.copy(), self.centres(cells)
        if tracked and len(centres):
            around = DistanceField.of([one.outline for one in tracked], centres.min(axis=0), centres.max(axis=0))
            # The border of an object may lie anywhere in a cell, and perception closes gaps by one more.
            left[cells] = around.at(centres) > 2.0 * self.size
        return left


class UntrackedThings:
    """Keeps the cells that show something and belong to no tracked object.

    A cell that is hidden keeps what it showed last: the arm hides what it stands over. A grid that comes while an object moves is left out,
    since poses and grid are then of different times.
    """

    def __init__(self) -> None:
        self._grid: WorkspaceGrid | None = None
        self._cells: BoolArray = np.zeros((0, 0), dtype=np.bool_)
        self._poses: dict[str, Float64Array] = {}

    def take(self, grid: WorkspaceGrid, poses: Mapping[str, Float64Array], tracked: Sequence[Obstacle]) -> None:
        """Take a grid and the tracked objects, with their poses, each of shape (3,), and their outlines."""
        before, self._poses = self._poses, dict(poses)
        known = [name for name in poses if name in before]
        # A corner at 10 cm moves by a cell where an object turns by ten cells a metre.
        moved = max((float(np.max(np.abs(poses[name] - before[name]) * [1.0, 1.0, 0.1])) for name in known), default=0.0)
        if moved > grid.size:
            return
        shown = grid.without(grid.cells >= _OCCUPIED, tracked)
        if self._grid is not None and grid.is_like(self._grid):
            shown |= self._cells & (grid.cells < 0)
        self._grid, self._cells = grid, shown

    def obstacles(self, tracked: Sequence[Obstacle]) -> list[Obstacle]:
        """What the cells show beside the objects that are tracked now."""
        grid = self._grid
        if grid is None:
            return []
        found = []
        for first, piece in pieces(grid.without(self._cells, tracked)):
            if np.count_nonzero(piece) * grid.size**2 >= LEAST_AREA:
                border = transform_points(grid.pose, (contours(piece)[0] + first + 0.5) * grid.size)
                x, y = border.mean(axis=0)
                # A cell reaches by half its diagonal beyond its centre.
                wide = grown(border, float(np.sqrt(0.5)) * grid.size)
                found.append(Obstacle(f"something at ({x:.2f}, {y:.2f}) m that is no tracked object", wide))
        return found
