"""Label of every pixel: table, object, robot or unknown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.rod import Rod
from push_ident.perception.kernels import label_heights, points_in_rods
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import BoolArray

__all__ = ["OBJECT", "ROBOT", "TABLE", "UNKNOWN", "Cylinder", "RobotPart", "in_robot", "label_pixels"]

UNKNOWN: Final = -1
TABLE: Final = 0
OBJECT: Final = 1
ROBOT: Final = 2

_BELOW: Final = -0.02
"""Points below this height are beside the table [m]."""


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A vertical cylinder of the robot without upper end [m], table frame."""

    x: float
    y: float
    radius: float
    z_min: float = -1.0
    """Height of its lower end."""


RobotPart = Cylinder | Rod
"""Tool and hand, placed by the pose of the tool, or links of the arm, placed by its joint states."""


def in_robot(points: NDArray[np.float32], robot: Sequence[RobotPart], margin: float) -> BoolArray:
    """Which of `points`, shape (..., 3), lie in a part of the robot grown by `margin` [m]."""
    if not robot:
        return np.zeros(points.shape[:-1], dtype=bool)
    flat = np.ascontiguousarray(points, dtype=np.float32).reshape(-1, 3)
    inside = points_in_rods(flat, np.array([_as_row(part) for part in robot]), margin)
    return np.asarray(inside.reshape(points.shape[:-1]))


def _as_row(part: RobotPart) -> tuple[float, ...]:
    """Start, unit direction, length and radius of a part."""
    if isinstance(part, Cylinder):
        return part.x, part.y, part.z_min, 0.0, 0.0, 1.0, math.inf, part.radius
    axis = part.end - part.start
    length = float(np.linalg.norm(axis))
    return *part.start, *(axis / length), length, part.radius


def label_pixels(points: NDArray[np.float32], robot: Sequence[RobotPart], settings: PerceptionSettings) -> NDArray[np.int8]:
    """Label every pixel by the height of its point above the table plane.

    A median over 3 x 3 pixels removes single outliers from the heights and keeps edges in place.

    Args:
        points: [m], shape (height, width, 3), table frame with the plane at z = 0.
        robot: Known parts of the robot; everything above `max_object_height` is robot as well.

    Returns:
        UNKNOWN, TABLE, OBJECT or ROBOT, shape (height, width); outside the workspace nothing is OBJECT.
    """
    heights = np.asarray(points[..., 2], dtype=np.float32)
    smooth = cv2.medianBlur(np.where(np.isfinite(heights), heights, np.float32(0.0)), 3)
    (low_x, low_y), (high_x, high_y) = settings.workspace_low, settings.workspace_high
    # Only raised pixels can be robot; the test is run on those few pixels.
    labels, raised = label_heights(
        np.ascontiguousarray(points, dtype=np.float32),
        smooth,
        (low_x, high_x, low_y, high_y),
        (_BELOW, 0.5 * settings.min_object_height, settings.min_object_height, settings.max_object_height),
        (UNKNOWN, TABLE, OBJECT, ROBOT),
    )
    if robot:
        raised[raised] = in_robot(points[raised], robot, settings.mask_margin)
        labels[raised] = ROBOT
    return np.asarray(labels)
