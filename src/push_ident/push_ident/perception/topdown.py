"""Top-down view of the workspace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.perception.labels import OBJECT, TABLE
from push_ident.perception.settings import PerceptionSettings

__all__ = ["FREE", "OCCUPIED", "UNSEEN", "TopDownGrid", "top_down"]

UNSEEN: Final = -1
FREE: Final = 0
OCCUPIED: Final = 100


@dataclass(frozen=True, slots=True)
class TopDownGrid:
    """Cells of the workspace, rows along y, columns along x, table frame."""

    occupancy: NDArray[np.int8]
    """UNSEEN, FREE or OCCUPIED, shape (rows, columns)."""
    height: NDArray[np.float32]
    """Highest point seen in the cell [m], same shape; NaN where unseen."""
    origin: tuple[float, float]
    """Low corner [m]."""
    resolution: float
    """[m]"""


def top_down(points: NDArray[np.float32], labels: NDArray[np.int8], settings: PerceptionSettings) -> TopDownGrid:
    """Project labelled points straight down.

    A cell is occupied where an object was seen in it, free where only table was; where nothing was seen, or only the robot,
    it is unknown. Gaps of single cells between pixels are closed by their neighbours, shadows are not.

    Args:
        points: [m], shape (height, width, 3), table frame with the plane at z = 0.
        labels: As `label_pixels` gives them.
    """
    low, high, size = np.array(settings.workspace_low), np.array(settings.workspace_high), settings.grid_resolution
    columns, rows = (int(n) for n in np.maximum(np.ceil((high - low) / size - 1e-9), 1))
    height = np.full((rows, columns), -np.inf, dtype=np.float32)
    seen = {}
    for label in (TABLE, OBJECT):
        chosen = points[labels == label]
        index = np.floor((chosen[:, :2] - low.astype(np.float32)) / np.float32(size)).astype(np.int32)
        inside = (index[:, 0] >= 0) & (index[:, 0] < columns) & (index[:, 1] >= 0) & (index[:, 1] < rows)
        flat = index[inside, 1] * columns + index[inside, 0]
        if label == OBJECT:
            np.maximum.at(height.reshape(-1), flat, chosen[inside, 2])
        else:
            # All of the table is of one height: any of its points will do.
            height.reshape(-1)[flat] = chosen[inside, 2]
        seen[label] = np.bincount(flat, minlength=rows * columns).reshape(rows, columns) > 0
    occupancy = np.full((rows, columns), UNSEEN, dtype=np.int8)
    occupancy[_closed(seen[TABLE])] = FREE
    occupancy[_closed(seen[OBJECT])] = OCCUPIED
    return TopDownGrid(occupancy, np.where(np.isfinite(height), height, np.float32(np.nan)), settings.workspace_low, size)


def _closed(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Fill cells of which most neighbours are set."""
    neighbours = cv2.blur(mask.astype(np.float32), (3, 3), borderType=cv2.BORDER_CONSTANT)
    return mask | (neighbours > 0.5)
