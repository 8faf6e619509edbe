"""What stands on the table beside the tracked objects, from perception's occupancy of the workspace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np

from push_ident.geometry.distance_field import contours, pieces
from push_ident.geometry.se2 import transform_points
from push_ident.geometry.workspace_grid import WorkspaceGrid
from push_ident.limits import LIMITS
from push_ident.planning.obstacle import Obstacle
from push_ident.types import BoolArray, Float64Array

_BESIDE: Final = 0.1
"""Distance from the workspace of the tool within which things count [m]: tool and object stay in it but for the radius of the tool."""
_OCCUPIED: Final = 50
"""Least occupancy of a cell that shows something [percent]; perception writes 100."""


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
        shown = grid.without((grid.cells >= _OCCUPIED) & grid.within(self._bounds), [one.outline for one in tracked])
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
        for first, piece in pieces(grid.without(self._cells, [one.outline for one in tracked]), grid.least):
            # Through the centres of the cells around it: a piece reaches by half a cell less.
            around = cv2.dilate(np.pad(piece, 1).astype(np.uint8), np.ones((3, 3), dtype=np.uint8)) > 0
            border = transform_points(grid.pose, (contours(around)[0] + first - 0.5) * grid.size)
            x, y = border.mean(axis=0)
            found.append(Obstacle(f"something at ({x:.2f}, {y:.2f}) m that is no tracked object", border))
        return found
