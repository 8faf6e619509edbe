"""The five objects of the simulated cell, each a grid of cells with its own mass and support friction.

Hammer, wrench, crimp, toolbox and book follow the experimental setup of Song & Boularias, "Identifying Mechanical Models through
Differentiable Simulations" (2020): iron against wood, a handle that does not touch the table, contents that lie on one side. The
numbers are our own.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import InputError
from push_ident.geometry.outline import outline_of_cells, polygon_area
from push_ident.types import Float64Array

IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SimObject:
    """Ground truth of one object. Object frame: origin in the mean of the cell centres, on the table, z up, axes along the grid."""

    name: str
    cell_size: float
    """Edge of a cell [m]."""
    cells: Float64Array
    """Cell centres [m], shape (n_cells, 2)."""
    height: Float64Array
    """Height of each cell [m], shape (n_cells,)."""
    mass: Float64Array
    """Cell mass [kg], shape (n_cells,), all > 0."""
    friction: Float64Array
    """Friction coefficient of each cell on the table [-], shape (n_cells,), all >= 0."""
    pusher_friction: float
    """Friction coefficient of the pusher on the outline [-]."""
    outline: Float64Array = field(init=False)
    """Border of the union of the cells [m], shape (n_vertices, 2), counter-clockwise, not closed."""

    def __post_init__(self) -> None:
        for name, shape in (("cells", (-1, 2)), ("height", (-1,)), ("mass", (-1,)), ("friction", (-1,))):
            _freeze(self, name, np.reshape(getattr(self, name), shape))
        n_cells = len(self.cells)
        for name in ("height", "mass", "friction"):
            values = getattr(self, name)
            if len(values) != n_cells:
                raise InputError(f"SimObject.{name} has {len(values)} values, expected {n_cells}, one per cell.")
            lowest_allowed = 0.0 if name == "friction" else 1e-9
            if not np.all(np.isfinite(values)) or np.any(values < lowest_allowed):
                raise InputError(f"SimObject.{name} must be finite and {'>= 0' if name == 'friction' else '> 0'}, got {values.min()}.")
        _freeze(self, "outline", outline_of_cells(self.cells, self.cell_size))
        if not np.isclose(polygon_area(self.outline), n_cells * self.cell_size**2):
            raise InputError(f"The {n_cells} cells of {self.name} are not one piece without holes, joined along cell edges.")

    def __len__(self) -> int:
        return len(self.cells)


def _freeze(owner: object, name: str, value: ArrayLike) -> None:
    array = np.array(value, dtype=np.float64)
    array.setflags(write=False)
    object.__setattr__(owner, name, array)


def _grid_indices(cells: Float64Array, size: float) -> IntArray:
    """Integer (column, row) of each cell; refuses centres that do not lie on one square grid."""
    steps = (cells - cells.min(axis=0)) / size
    indices = np.rint(steps).astype(np.int64)
    if np.abs(steps - indices).max() > 1e-6:
        raise InputError(f"Cell centres are up to {np.abs(steps - indices).max() * size:.2e} m from a square grid of {size} m.")
    if len(np.unique(indices, axis=0)) != len(indices):
        raise InputError("Two cells share one place of the grid.")
    return indices


def outline_rectangles(cells: Float64Array, size: float) -> list[tuple[Float64Array, Float64Array]]:
    """Overlapping rectangles (centre [m], edges [m]) whose union is the cells, with every straight side of the outline on one of them.

    A side shared by two rectangles would have a seam on which a sliding pusher catches.
    """
    indices = _grid_indices(cells, size)
    filled = np.zeros(indices.max(axis=0) + 1, dtype=bool)
    filled[tuple(indices.T)] = True
    outline = np.rint((outline_of_cells(cells, size) - cells.min(axis=0)) / size + 0.5).astype(np.int64)
    rectangles: set[tuple[int, int, int, int]] = set()
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        inward = np.sign(np.array([start[1] - end[1], end[0] - start[0]]))
        low, high = np.minimum(start, end), np.maximum(start, end)
        rectangles.add(_grow(filled, np.minimum(low, low + inward), np.maximum(high, high + inward)))
    return [
        (cells.min(axis=0) + (np.array([i0 + i1, j0 + j1]) / 2 - 0.5) * size, np.array([i1 - i0, j1 - j0]) * size)
        for i0, j0, i1, j1 in sorted(rectangles)
    ]


def _grow(filled: NDArray[np.bool_], low: IntArray, high: IntArray) -> tuple[int, int, int, int]:
    """Largest rectangle of filled cells that grows from [low, high), side by side in turn."""
    (i0, j0), (i1, j1) = (int(v) for v in low), (int(v) for v in high)
    grown = True
    while grown:
        grown = False
        if i0 > 0 and filled[i0 - 1, j0:j1].all():
            i0, grown = i0 - 1, True
        if i1 < filled.shape[0] and filled[i1, j0:j1].all():
            i1, grown = i1 + 1, True
        if j0 > 0 and filled[i0:i1, j0 - 1].all():
            j0, grown = j0 - 1, True
        if j1 < filled.shape[1] and filled[i0:i1, j1].all():
            j1, grown = j1 + 1, True
    return i0, j0, i1, j1


@dataclass(frozen=True, slots=True)
class Part:
    """Nominal values of one part of an object; `make_object` varies them."""

    mass: float
    """Of the whole part [kg]."""
    friction: float
    height: float
    """[m]"""


def object_from_picture(
    name: str, picture: list[str], parts: dict[str, Part], cell_size: float, pusher_friction: float, rng: np.random.Generator | None = None
) -> SimObject:
    """Object drawn in letters: rows from +y down to -y, columns along +x, one letter of `parts` per cell, a dot for nothing.

    With `rng` the mass and friction of every part vary by about 15 %, and inside a part by a smooth slope of up to 15 % at its ends.
    """
    rows = [(column, -row, letter) for row, line in enumerate(picture) for column, letter in enumerate(line) if letter != "."]
    unknown = {letter for *_, letter in rows} - parts.keys()
    if unknown:
        raise InputError(f"Object {name} draws cells {sorted(unknown)} that no part describes, expected {sorted(parts)}.")
    cells = np.array([[column, row] for column, row, _ in rows], dtype=np.float64) * cell_size
    letters = np.array([letter for *_, letter in rows])
    height, mass, friction = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows))
    for letter, part in parts.items():
        of_part = letters == letter
        height[of_part] = part.height
        mass[of_part] = part.mass / of_part.sum() * _variation(cells[of_part], rng)
        friction[of_part] = part.friction * _variation(cells[of_part], rng)
    return SimObject(name, cell_size, cells - cells.mean(axis=0), height, mass, friction, pusher_friction)


def _variation(cells: Float64Array, rng: np.random.Generator | None) -> Float64Array:
    if rng is None:
        return np.ones(len(cells))
    level = np.clip(rng.lognormal(sigma=0.15), 0.75, 1.35)
    angle = rng.uniform(-np.pi, np.pi)
    along = (cells - cells.mean(axis=0)) @ np.array([np.cos(angle), np.sin(angle)])
    return level * (1.0 + rng.uniform(0.0, 0.15) * along / np.abs(along).max())


_DRAWINGS: dict[str, tuple[list[str], dict[str, Part], float]] = {
    "hammer": (
        ["." * 18 + "H" * 4] * 4 + ["w" * 18 + "H" * 4] * 2 + ["." * 18 + "H" * 4] * 4,
        {"H": Part(mass=0.60, friction=0.25, height=0.035), "w": Part(mass=0.14, friction=0.40, height=0.025)},
        0.012,
    ),
    # The jaws are thicker than the handle, so the handle hangs above the table and bears no friction.
    "wrench": (
        ["JJJJJ" + "." * 15 + "JJJJJ"] * 2 + ["..JJJ" + "h" * 15 + "JJJ.."] * 2 + ["JJJJJ" + "." * 15 + "JJJJJ"] * 2,
        {"J": Part(mass=0.40, friction=0.30, height=0.030), "h": Part(mass=0.18, friction=0.0, height=0.025)},
        0.011,
    ),
    "crimp": (
        ["." * 12 + "I" * 5] + ["g" * 12 + "I" * 5] * 2 + ["." * 12 + "I" * 5] * 2 + ["g" * 12 + "I" * 5] * 2 + ["." * 12 + "I" * 5],
        {"I": Part(mass=0.55, friction=0.50, height=0.035), "g": Part(mass=0.20, friction=0.45, height=0.028)},
        0.012,
    ),
    "toolbox": (
        ["IIIIIppppp"] * 8,
        {"I": Part(mass=0.80, friction=0.35, height=0.050), "p": Part(mass=0.25, friction=0.35, height=0.050)},
        0.014,
    ),
    "book": (
        ["LLLLLLRRRRRR"] * 8,
        {"L": Part(mass=0.55, friction=0.30, height=0.035), "R": Part(mass=0.20, friction=0.30, height=0.025)},
        0.013,
    ),
}
"""Picture, parts and edge of a cell [m] of each object."""
OBJECT_NAMES = tuple(_DRAWINGS)


def make_object(name: str = "hammer", seed: int = 0, pusher_friction: float = 0.3) -> SimObject:
    """One of `OBJECT_NAMES`; each seed is another ground truth of the same shape. Total mass 0.4 to 1.5 kg."""
    if name not in _DRAWINGS:
        raise InputError(f"Object {name!r} is not known, expected one of {', '.join(OBJECT_NAMES)}.")
    if not (np.isfinite(pusher_friction) and pusher_friction >= 0):
        raise InputError(f"pusher_friction is {pusher_friction}, expected a number >= 0.")
    return object_from_picture(name, *_DRAWINGS[name], pusher_friction, np.random.default_rng([seed, OBJECT_NAMES.index(name)]))
