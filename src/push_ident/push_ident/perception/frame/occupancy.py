"""Top-down occupancy grid of the workspace."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.perception.frame.view import OBJECT, TABLE, FrameView
from push_ident.perception.kernels import project_down

UNOBSERVED, FREE, OCCUPIED = -1, 0, 100  # as in nav_msgs/OccupancyGrid


@dataclass(frozen=True, slots=True)
class TopDownGrid:
    """Cells of the workspace, rows along y, columns along x, table frame."""

    occupancy: NDArray[np.int8]
    """UNOBSERVED, FREE or OCCUPIED, shape (rows, columns)."""
    height: NDArray[np.float32]
    """Highest point measured in the cell [m], same shape; NaN where there is none."""
    origin: tuple[float, float]
    """Low corner [m]."""
    resolution: float
    """[m]"""


def top_down(view: FrameView) -> TopDownGrid:
    """Project the labelled points of a frame straight down.

    A cell with object points is occupied, a cell with table points only is free, any other cell is unobserved. Gaps of single cells
    between pixels are closed by their neighbours; shadows are not.
    """
    settings = view.settings
    low, high, size = np.array(settings.workspace_low), np.array(settings.workspace_high), settings.grid_resolution
    columns, rows = (int(n) for n in np.maximum(np.ceil((high - low) / size - 1e-9), 1))
    has_table, has_object, height = project_down(view.points, view.labels, TABLE, OBJECT, low, size, rows, columns)
    occupancy = np.full((rows, columns), UNOBSERVED, dtype=np.int8)
    occupancy[_closed(has_table)] = FREE
    occupancy[_closed(has_object)] = OCCUPIED
    return TopDownGrid(occupancy, np.where(np.isfinite(height), height, np.float32(np.nan)), settings.workspace_low, size)


def _closed(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Set the cells most of whose neighbours are set."""
    neighbours = cv2.blur(mask.astype(np.float32), (3, 3), borderType=cv2.BORDER_CONSTANT)
    return mask | (neighbours > 0.5)


class OccupancyMap:
    """Makes the occupancy grid, in turns of the background work.

    Args:
        makes_grid: Without it the turns pass all the same: which work a frame does stays as it is in a live cell.
    """

    def __init__(self, *, makes_grid: bool) -> None:
        self._makes_grid = makes_grid
        self.last = -np.inf
        """Stamp of the frame of the last turn [s]."""
        self.grid: TopDownGrid | None = None

    def step(self, view: FrameView) -> None:
        """Make the grid."""
        self.last = view.frame.stamp
        if self._makes_grid:
            self.grid = top_down(view)
