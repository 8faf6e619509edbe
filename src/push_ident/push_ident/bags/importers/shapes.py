"""Shapes of imported objects, and the supports that a user names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import points_in_polygon, polygon_area
from push_ident.limits import LIMITS
from push_ident.types import Float64Array, ObjectShape

CELL_SIZE: Final = 0.01
"""Edge of the cells of an imported object [m]."""


def shape_of_outline(outline: Float64Array, *, cell_size: float = CELL_SIZE, what: str = "the outline") -> ObjectShape:
    """Cells and contact outline from the outline [m], shape (n_vertices, 2), object frame, in either orientation.

    Raises InputError, naming `what`, for an outline that is no polygon or beyond the limits, and for more cells than the limits allow.
    """
    LIMITS.VERTICES.check(len(outline), what)
    extent = float(np.ptp(outline, axis=0).max()) if len(outline) else 0.0
    remedy = "Are its lengths in millimetres, centimetres or inches? Give their unit."
    LIMITS.EXTENT.check(extent, what, remedy=remedy)
    LIMITS.EXTENT.check(float(np.abs(outline).max(initial=0.0)), f"{what}, largest coordinate", remedy=remedy)
    if not cell_size > 0:
        raise InputError(f"cell size is {cell_size:g} m, expected a positive length.")
    LIMITS.GRID.check(float((extent / cell_size + 1.0) ** 2), what, remedy="Choose larger cells.")
    LIMITS.CELLS.check(abs(polygon_area(outline)) / cell_size**2, what, remedy="Choose larger cells.")
    cells = cells_in_outline(outline, cell_size)
    LIMITS.CELLS.check(len(cells), what, remedy="Choose larger cells.")
    return ObjectShape(cells, outline)


def right_triangle(leg_x: float, leg_y: float) -> ObjectShape:
    """A right triangle with its right angle in the origin and its legs [m] along the axes."""
    return shape_of_outline(np.array([[0.0, 0.0], [leg_x, 0.0], [0.0, leg_y]]))


def check_supports(points: Sequence[Sequence[float]] | Float64Array, shape: ObjectShape) -> Float64Array:
    """The support points [m], shape (n, 2), object frame. Raises InputError for points outside the outline."""
    supports = np.array(points, dtype=np.float64).reshape(-1, 2)
    inside = points_in_polygon(supports, shape.outline)
    if not inside.all():
        x, y = supports[~inside][0]
        raise InputError(f"support ({x:g}, {y:g}) m lies outside the object; give supports in metres, in the object frame.")
    return supports


def pose_covariance(position_std: float, yaw_std: float) -> Float64Array:
    """Covariance of (x, y, yaw) [m, m, rad], shape (3, 3). Raises InputError unless both standard deviations are positive."""
    for name, value in (("position", position_std), ("yaw", yaw_std)):
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"standard deviation of the {name} is {value:g}, expected a positive number; a pose is never known exactly.")
    return np.diag([position_std**2, position_std**2, yaw_std**2])
