"""The table that objects stand on, as a polygon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class Table:
    """A convex table top.

    Raises:
        InputError: fewer than three corners, numbers that are not finite, a side shorter than a centimetre, or a shape that is not convex.
    """

    corners: Float64Array
    """[m], shape (n, 2), table frame; stored counter-clockwise."""

    def __post_init__(self) -> None:
        corners = np.array(self.corners, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1:] != (2,) or len(corners) < 3 or not np.isfinite(corners).all():
            raise InputError(f"A table has corners of shape {corners.shape}, expected three or more pairs x, y of finite numbers [m].")
        side = np.roll(corners, -1, axis=0) - corners
        if float(np.linalg.norm(side, axis=1).min()) < 0.01:
            raise InputError("A side of the table is shorter than 10 mm; give its corners in metres, each once.")
        following = np.roll(side, -1, axis=0)
        bend = side[:, 0] * following[:, 1] - side[:, 1] * following[:, 0]
        turns = np.arctan2(bend, np.sum(side * following, axis=1))
        # A star turns the same way at each corner too, but goes round more than once.
        if not (np.all(bend >= 0) or np.all(bend <= 0)) or not np.isclose(abs(turns.sum()), 2 * np.pi):
            raise InputError("The table is not convex; give the corners of its convex part around the workspace, in order.")
        if turns.sum() < 0:
            corners = corners[::-1].copy()
        corners.setflags(write=False)
        object.__setattr__(self, "corners", corners)

    @classmethod
    def rectangle(cls, bounds: Float64Array) -> Table:
        """From x_min, x_max, y_min, y_max [m]. Raises InputError as the class does."""
        x_min, x_max, y_min, y_max = bounds
        if not (x_min < x_max and y_min < y_max):
            raise InputError(f"The table is {list(bounds)}, expected x_min < x_max and y_min < y_max in metres.")
        return cls(np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]]))

    def beyond(self, points: Float64Array) -> float:
        """How far the outermost of points, shape (n, 2), table frame, lies beyond a side [m]; negative where all are on the table."""
        side = np.roll(self.corners, -1, axis=0) - self.corners
        outward = np.column_stack([side[:, 1], -side[:, 0]]) / np.linalg.norm(side, axis=1)[:, None]
        return float(np.max(np.asarray(points) @ outward.T - np.sum(outward * self.corners, axis=1)))
