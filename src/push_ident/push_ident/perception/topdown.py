"""Top-down occupancy grid of the workspace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.errors import FrameError
from push_ident.perception.kernels import project_down
from push_ident.perception.labels import OBJECT, TABLE
from push_ident.perception.settings import PerceptionSettings

__all__ = ["FREE", "OCCUPIED", "UNOBSERVED", "TopDownGrid", "top_down"]

UNOBSERVED: Final = -1
FREE: Final = 0
OCCUPIED: Final = 100


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


def top_down(points: NDArray[np.float32], labels: NDArray[np.int8], settings: PerceptionSettings) -> TopDownGrid:
    """Project labelled points straight down.

    A cell with object points is occupied, a cell with table points only is free, any other cell is unobserved. Gaps of single cells
    between pixels are closed by their neighbours; shadows are not.

    Args:
        points: [m], shape (height, width, 3), table frame with the plane at z = 0.
        labels: As `label_pixels` gives them.

    Raises:
        FrameError: Points and labels are of images of different sizes.
    """
    points, labels = np.ascontiguousarray(points, dtype=np.float32), np.ascontiguousarray(labels)
    if points.shape != (*labels.shape, 3):
        raise FrameError(f"Points have shape {points.shape} and labels {labels.shape}, expected both of one image.")
    low, high, size = np.array(settings.workspace_low), np.array(settings.workspace_high), settings.grid_resolution
    columns, rows = (int(n) for n in np.maximum(np.ceil((high - low) / size - 1e-9), 1))
    has_table, has_object, height = project_down(points, labels, TABLE, OBJECT, low, size, rows, columns)
    occupancy = np.full((rows, columns), UNOBSERVED, dtype=np.int8)
    occupancy[_closed(has_table)] = FREE
    occupancy[_closed(has_object)] = OCCUPIED
    return TopDownGrid(occupancy, np.where(np.isfinite(height), height, np.float32(np.nan)), settings.workspace_low, size)


def _closed(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Set the cells most of whose neighbours are set."""
    neighbours = cv2.blur(mask.astype(np.float32), (3, 3), borderType=cv2.BORDER_CONSTANT)
    return mask | (neighbours > 0.5)
