"""What every pixel shows: table, object, robot, or nothing known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.arm_shape import Rod
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import BoolArray

__all__ = ["OBJECT", "ROBOT", "TABLE", "UNKNOWN", "Cylinder", "RobotPart", "in_robot", "label_pixels"]

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


RobotPart = Cylinder | Rod
"""Tool and hand as the node knows them from the pose of the tool, links of the arm from its joint states."""


def in_robot(points: NDArray[np.float32], robot: Sequence[RobotPart], margin: float) -> BoolArray:
    """Which of `points`, shape (..., 3), lie in a part of the robot grown by `margin` [m]."""
    inside = np.zeros(points.shape[:-1], dtype=bool)
    for part in robot:
        inside |= _in_cylinder(points, part, margin) if isinstance(part, Cylinder) else _in_rod(points, part, margin)
    return inside


def _in_cylinder(points: NDArray[np.float32], part: Cylinder, margin: float) -> BoolArray:
    distance = (points[..., 0] - part.x) ** 2 + (points[..., 1] - part.y) ** 2
    return np.asarray((distance < (part.radius + margin) ** 2) & (points[..., 2] > part.z_min - margin))


def _in_rod(points: NDArray[np.float32], rod: Rod, margin: float) -> BoolArray:
    axis = rod.end - rod.start
    length = float(np.linalg.norm(axis))
    direction = (axis / length).astype(np.float32)
    from_start = points - rod.start.astype(np.float32)
    along = from_start @ direction
    across = np.sum(np.square(from_start), axis=-1) - along**2
    return np.asarray((across < (rod.radius + margin) ** 2) & (along > -margin) & (along < length + margin))


def label_pixels(points: NDArray[np.float32], robot: Sequence[RobotPart], settings: PerceptionSettings) -> NDArray[np.int8]:
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
        labels[seen & (smooth > settings.max_object_height)] = ROBOT
        # The table itself is not robot, and leaving it out leaves little to look at.
        raised = seen & (smooth > 0.5 * settings.min_object_height) & (smooth <= settings.max_object_height)
    labels[raised] = np.where(in_robot(points[raised], robot, settings.mask_margin), ROBOT, labels[raised])
    return labels
