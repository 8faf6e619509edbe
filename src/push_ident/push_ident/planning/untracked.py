"""What stands on the table beside the tracked objects, from perception's occupancy of the workspace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.distance_field import contours, pieces
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.limits import LIMITS
from push_ident.planning.keep_out import Obstacle
from push_ident.types import BoolArray, Float64Array

LEAST_AREA: Final = 4e-4
"""Smaller pieces are noise [m^2]: what perception ignores as an object."""
_BESIDE: Final = 0.1
"""Distance from the workspace of the tool within which things count [m]: tool and object stay in it but for the radius of the tool."""
_FAR: Final = 1e6
"""Cells from the grid at which an object covers none of them."""
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

    @property
    def least(self) -> int:
        """Number of cells of the smallest piece that is no noise."""
        return max(1, round(LEAST_AREA / self.size**2))

    def is_like(self, other: WorkspaceGrid) -> bool:
        """Whether the cells are at the same places."""
        return self.cells.shape == other.cells.shape and self.size == other.size and bool(np.array_equal(self.pose, other.pose))

    def within(self, bounds: tuple[float, float, float, float]) -> BoolArray:
        """Whether the centre of a cell is in (x_min, x_max, y_min, y_max) [m], table frame, shape (rows, columns)."""
        rows, columns = np.indices(self.cells.shape)
        x, y = transform_points(self.pose, (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) * self.size).T
        x_min, x_max, y_min, y_max = bounds
        return np.asarray((x_min <= x) & (x <= x_max) & (y_min <= y) & (y <= y_max)).reshape(self.cells.shape)

    def without(self, cells: BoolArray, tracked: Sequence[Obstacle]) -> BoolArray:
        """Some cells without those of tracked objects, shape (rows, columns)."""
        covered = np.zeros(cells.shape, dtype=np.uint8)
        for one in tracked:
            corners = transform_points(inverse(self.pose), one.outline) / self.size - 0.5
            if float(np.abs(corners).max()) < _FAR:
                cv2.fillPoly(covered, [np.rint(corners).astype(np.int32)], (1,))
        # The border of an object may lie anywhere in a cell, and perception closes gaps by one more.
        return np.asarray(cells & (cv2.dilate(covered, np.ones((5, 5), dtype=np.uint8)) == 0))


class UntrackedThings:
    """Keeps the cells that show something and belong to no tracked object.

    A cell that is hidden keeps what it showed last: the arm hides what it stands over. A grid that comes while an object moves is left out,
    since poses and grid are then of different times.

    Args:
        workspace: (x_min, x_max, y_min, y_max) of the tool [m], table frame; what is further than 10 cm from it does not count.
    """

    def __init__(self, workspace: tuple[float, float, float, float]) -> None:
        x_min, x_max, y_min, y_max = workspace
        self._bounds = x_min - _BESIDE, x_max + _BESIDE, y_min - _BESIDE, y_max + _BESIDE
        self._grid: WorkspaceGrid | None = None
        self._cells: BoolArray = np.zeros((0, 0), dtype=np.bool_)
        self._poses: dict[str, Float64Array] = {}

    def take(self, grid: WorkspaceGrid, poses: Mapping[str, Float64Array], tracked: Sequence[Obstacle]) -> None:
        """Take a grid and the tracked objects, with their poses, each of shape (3,), and their outlines.

        Raises:
            InputError: the grid shows more things than a cell has objects; the one before is kept.
        """
        before, self._poses = self._poses, dict(poses)
        known = [name for name in poses if name in before]
        # A corner at 10 cm moves by a cell where an object turns by ten cells a metre.
        moved = max((float(np.max(np.abs(poses[name] - before[name]) * [1.0, 1.0, 0.1])) for name in known), default=0.0)
        if moved > grid.size:
            return
        shown = grid.without((grid.cells >= _OCCUPIED) & grid.within(self._bounds), tracked)
        if self._grid is not None and grid.is_like(self._grid):
            shown |= self._cells & (grid.cells < 0)
        LIMITS.OBJECTS.check(len(pieces(shown, grid.least)), "Occupancy of the workspace, beside what is tracked")
        self._grid, self._cells = grid, shown

    def obstacles(self, tracked: Sequence[Obstacle]) -> list[Obstacle]:
        """What the cells show beside the objects that are tracked now."""
        grid = self._grid
        if grid is None:
            return []
        found = []
        for first, piece in pieces(grid.without(self._cells, tracked), grid.least):
            # Through the centres of the cells around it: a piece reaches by half a cell less.
            around = cv2.dilate(np.pad(piece, 1).astype(np.uint8), np.ones((3, 3), dtype=np.uint8)) > 0
            border = transform_points(grid.pose, (contours(around)[0] + first - 0.5) * grid.size)
            x, y = border.mean(axis=0)
            found.append(Obstacle(f"something at ({x:.2f}, {y:.2f}) m that is no tracked object", border))
        return found
