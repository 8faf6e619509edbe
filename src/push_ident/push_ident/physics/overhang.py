"""An object that overhangs the edge of its table: cells beyond the edge bear no load, the others bear its whole weight.

The object is rigid, and rests on its cells as on springs whose stiffness gives each cell its own weight w_i while all are on the table.
With cells off the table it sinks and tilts a little, so that the loads are

    N_i = w_i max(0, l_0 + l . a_i) on the table, else 0          a_i: cell from the centre of mass
    sum N_i = W,   sum N_i a_i = 0                                equilibrium

Whatever overhangs, the size of the load and its centre stay the weight and the centre of mass; what changes is its spread, and the
friction under it. Where the centre of mass lies beyond the outermost cells on the table there is no such load, and the object falls.
Cells count as on the table by their centres: the object is taken to fall up to half a cell early, which is the careful side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from push_ident.errors import InputError
from push_ident.physics.kernel import kernel
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class TableEdge:
    """A straight edge of the table; the table lies where `outward . p <= offset`.

    Raises:
        InputError: numbers that are not finite, or no direction.
    """

    outward: Float64Array
    """Unit vector from the table into the air, shape (2,), table frame; scaled to length 1 here."""
    offset: float
    """Distance of the edge from the origin along `outward` [m]."""
    span: tuple[float, float] = (-math.inf, math.inf)
    """From where to where the edge goes, along `outward` turned to the left by a right angle [m]."""

    def __post_init__(self) -> None:
        outward = np.array(self.outward, dtype=np.float64)
        length = float(np.linalg.norm(outward)) if outward.shape == (2,) else np.nan
        if not (np.isfinite(length) and length > 0 and np.isfinite(self.offset)):
            raise InputError(
                f"The table's edge has the outward direction {self.outward} and the offset {self.offset}, expected two finite numbers that "
                "are not both zero, and a finite distance in metres."
            )
        if not self.span[0] < self.span[1]:
            raise InputError(f"The table's edge goes from {self.span[0]} to {self.span[1]} m, expected a length.")
        outward /= length
        outward.setflags(write=False)
        object.__setattr__(self, "outward", outward)

    @classmethod
    def between(cls, first: Float64Array, second: Float64Array) -> TableEdge:
        """The edge from one point to another, each of shape (2,) [m], with the table on the left.

        Raises:
            InputError: points that are not finite, or nearer to each other than a centimetre.
        """
        shortest = 0.01
        first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
        along = second - first
        length = float(np.linalg.norm(along))
        if not length >= shortest or not np.isfinite(length):
            raise InputError(
                f"The table's edge goes from {first.tolist()} to {second.tolist()} m, expected two finite points, {1e3 * shortest:.0f} mm "
                "apart or more."
            )
        along /= length
        outward = np.array([along[1], -along[0]])
        return cls(outward, float(outward @ first), (float(along @ first), float(along @ second)))

    @property
    def along(self) -> Float64Array:
        """Unit vector along the edge, shape (2,); the table is on its left."""
        return np.array([-self.outward[1], self.outward[0]])

    @property
    def ends(self) -> Float64Array:
        """First and last point [m], shape (2, 2), of an edge whose `span` is finite."""
        return self.offset * self.outward + np.array(self.span)[:, None] * self.along

    def beyond(self, points: Float64Array) -> Float64Array:
        """How far points, shape (..., 2), table frame, lie beyond the edge [m]; negative on the table. Shape (...)."""
        return np.asarray(np.asarray(points) @ self.outward - self.offset)


class Overhang(NamedTuple):
    """The edge and an object, as kernels take them."""

    outward: Float64Array
    """As in `TableEdge`."""
    offset: float
    weight: Float64Array
    """Of each cell as a share of the whole, shape (n_cells,)."""


@kernel
def share_loads(edge: Overhang, arms: Float64Array, centre: Float64Array, cos: float, sin: float, factor: Float64Array) -> bool:
    """Fill `factor`, shape (n_cells,), with the load of each cell relative to its own weight.

    `arms`: cells from the centre of mass, shape (2, n_cells), object axes [m]; `centre`: of mass in the table frame, shape (2,) or more;
    `cos`, `sin`: of the object's yaw. Returns False, and leaves `factor` as it is, where no load on the table holds the object.
    """
    n_cells = arms.shape[1]
    across, along = cos * edge.outward[0] + sin * edge.outward[1], -sin * edge.outward[0] + cos * edge.outward[1]
    room = edge.offset - edge.outward[0] * centre[0] - edge.outward[1] * centre[1]
    n_on, reach = 0, 0.0
    for i in range(n_cells):
        n_on += across * arms[0, i] + along * arms[1, i] <= room
        reach = max(reach, math.hypot(arms[0, i], arms[1, i]))
    if n_on == n_cells:
        factor[:] = 1.0
        return True
    if room <= 0.0 or reach == 0.0:
        return False
    unknown, residual, matrix = np.array([1.0, 0.0, 0.0]), np.empty(3), np.empty((3, 3))
    # Newton's method: the loads are linear between the changes of the cells that bear any, and few change.
    for _ in range(30):
        residual[0], residual[1], residual[2] = -1.0, 0.0, 0.0
        matrix[:] = 0.0
        for i in range(n_cells):
            if across * arms[0, i] + along * arms[1, i] <= room:
                x, y = arms[0, i] / reach, arms[1, i] / reach
                load = unknown[0] + unknown[1] * x + unknown[2] * y
                if load > 0.0:
                    w = edge.weight[i]
                    residual[0] += w * load
                    residual[1] += w * load * x
                    residual[2] += w * load * y
                    matrix[0, 0] += w
                    matrix[0, 1] += w * x
                    matrix[0, 2] += w * y
                    matrix[1, 1] += w * x * x
                    matrix[1, 2] += w * x * y
                    matrix[2, 2] += w * y * y
        # Shares of the weight, and of the weight at the lever of the farthest cell.
        if max(abs(residual[0]), abs(residual[1]), abs(residual[2])) < 1e-9:
            for i in range(n_cells):
                on = across * arms[0, i] + along * arms[1, i] <= room
                load = unknown[0] + (unknown[1] * arms[0, i] + unknown[2] * arms[1, i]) / reach
                factor[i] = load if on and load > 0.0 else 0.0
            return True
        for j in range(3):
            # Cells in one line leave a direction open in which nothing presses.
            matrix[j, j] += 1e-9 * max(matrix[0, 0], 1e-9)
            for k in range(j):
                matrix[j, k] = matrix[k, j]
        unknown -= np.linalg.solve(matrix, residual)
        if not math.isfinite(unknown[0] + unknown[1] + unknown[2]):
            return False
    return False
