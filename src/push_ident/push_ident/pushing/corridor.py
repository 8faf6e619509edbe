"""Where the tool may be corrected to while it moves: what was checked before the motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.types import Float64Array

__all__ = ["Corridor"]

_INSIDE: Final = 0.95
"""A point nearer to the line than this share of half the width is no part of the border [1]: rounding, and the pieces of a bend."""


@dataclass(frozen=True, slots=True)
class Corridor:
    """A strip along a line of the table.

    Raises:
        InputError: less than two points, numbers that are not finite, or a width that is not positive.
    """

    line: Float64Array
    """Middle of the strip [m], shape (n, 2), table frame."""
    half_width: float
    """Largest distance from the line [m]."""

    def __post_init__(self) -> None:
        line = np.array(self.line, dtype=np.float64)
        if line.ndim != 2 or line.shape[1:] != (2,) or len(line) < 2 or not np.isfinite(line).all():
            raise InputError(f"The line of a corridor has shape {line.shape}, expected two points (x, y) or more, all finite, in metres.")
        if not (np.isfinite(self.half_width) and self.half_width > 0):
            raise InputError(f"Half the width of a corridor is {self.half_width} m, expected a positive number.")
        line.setflags(write=False)
        object.__setattr__(self, "line", line)

    def outline(self) -> Float64Array:
        """Border of the strip for drawing [m], shape (n, 2), with flat ends, and without what lies within it inside of a bend."""
        tangent = np.gradient(self.line, axis=0)
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        aside = self.half_width * np.column_stack([-tangent[:, 1], tangent[:, 0]])
        border = np.vstack([self.line + aside, (self.line - aside)[::-1]])
        return border[Corridor(self.line, _INSIDE * self.half_width).excess(border) > 0.0]

    def excess(self, points: Float64Array) -> Float64Array:
        """Distance of points, shape (..., 2), out of the strip [m], shape (...); 0 inside."""
        # By coordinates: an axis of two would cost more than the arithmetic, for hundreds of tools in each correction.
        (x, y), (along_x, along_y) = self.line[:-1].T, np.diff(self.line, axis=0).T
        points = np.asarray(points)
        away_x, away_y = points[..., :1] - x, points[..., 1:] - y
        share = np.clip((away_x * along_x + away_y * along_y) / np.maximum(along_x**2 + along_y**2, 1e-18), 0.0, 1.0)
        away_x, away_y = away_x - share * along_x, away_y - share * along_y
        distance = np.sqrt(np.min(away_x * away_x + away_y * away_y, axis=-1))
        return np.asarray(np.maximum(distance - self.half_width, 0.0))
