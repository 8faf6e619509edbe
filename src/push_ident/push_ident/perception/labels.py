"""What every pixel shows: table, object, robot, or nothing known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.perception.settings import PerceptionSettings
from push_ident.types import BoolArray

__all__ = ["OBJECT", "ROBOT", "TABLE", "UNKNOWN", "Cylinder", "in_cylinders", "label_pixels"]

UNKNOWN: Final = -1
TABLE: Final = 0
OBJECT: Final = 1
ROBOT: Final = 2

_BELOW: Final = -0.02
"""Lower points are beside the table [m]."""


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A vertical cylinder of the robot, open upwards [m], table frame."""

    x: float
    y: float
    radius: float
    z_min: float = -1.0
    """Where it begins."""


def in_cylinders(points: NDArray[np.float32], robot: Sequence[Cylinder], margin: float) -> BoolArray:
    """Which of `points`, shape (..., 3), lie in a cylinder grown by `margin` [m]."""
    inside = np.zeros(points.shape[:-1], dtype=bool)
    for cylinder in robot:
        distance = (points[..., 0] - cylinder.x) ** 2 + (points[..., 1] - cylinder.y) ** 2
        inside |= (distance < (cylinder.radius + margin) ** 2) & (points[..., 2] > cylinder.z_min - margin)
    return inside


def label_pixels(points: NDArray[np.float32], robot: Sequence[Cylinder], settings: PerceptionSettings) -> NDArray[np.int8]:
    """Label every pixel by the height of its point above the table plane.

    A median over 3 x 3 pixels takes single outliers off the heights and keeps edges where they are.

    Args:
        points: [m], shape (height, width, 3), table frame with the plane at z = 0.
        robot: What is known of the robot; everything above the highest object is robot as well.

    Returns:
        UNKNOWN, TABLE, OBJECT or ROBOT, shape (height, width); outside the workspace nothing is OBJECT.
    """
    heights = points[..., 2]
    seen = np.isfinite(heights)
    smooth = cv2.medianBlur(np.where(seen, heights, np.float32(0.0)), 3)
    low, high = settings.workspace_low, settings.workspace_high
    with np.errstate(invalid="ignore"):
        x, y = points[..., 0], points[..., 1]
        in_workspace = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
        labels = np.full(heights.shape, UNKNOWN, dtype=np.int8)
        labels[seen & (heights > _BELOW)] = TABLE
        labels[seen & in_workspace & (smooth > settings.min_object_height)] = OBJECT
        labels[seen & ((smooth > settings.max_object_height) | in_cylinders(points, robot, settings.mask_margin))] = ROBOT
    return labels
