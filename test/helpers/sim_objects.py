"""Objects of the simulated world, and the camera over it, that several tests share."""

from __future__ import annotations

import numpy as np

from helpers.depth_scene import CAMERA
from push_ident.perception.frame import view
from push_ident.types import DepthFrame, Float64Array
from push_ident_sim.cell.camera import INTRINSICS
from push_ident_sim.objects import Part, SimObject, object_from_picture


def block(columns: int = 10, rows: int = 6, friction: float = 0.3, mass: float = 0.6) -> SimObject:
    return object_from_picture("block", ["b" * columns] * rows, {"b": Part(mass, friction, 0.03)}, 0.012, 0.3)


def disc(friction: float = 0.3, mass: float = 0.6) -> SimObject:
    x, y = np.meshgrid(*2 * [np.arange(-5, 6) * 0.012])
    inside = np.hypot(x, y) <= 0.058
    cells = np.column_stack([x[inside], y[inside]])
    n = len(cells)
    return SimObject("disc", 0.012, cells, np.full(n, 0.03), np.full(n, mass / n), np.full(n, friction), 0.3)


def points_in_table(depth: np.ndarray) -> Float64Array:
    """Points [m] of a depth image of `CAMERA` in the table frame, shape (height, width, 3)."""
    return view.points_in_table(DepthFrame(0.0, depth, INTRINSICS), CAMERA)
