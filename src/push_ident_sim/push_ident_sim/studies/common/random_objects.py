"""Objects of random shape and random maps."""

from __future__ import annotations

import numpy as np

from push_ident.geometry.outline import outline_of_cells
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape

__all__ = ["random_object", "random_shape"]

_CELL = 0.011
"""Edge of a cell [m]."""


def random_object(rng: np.random.Generator) -> ObjectModel:
    """Two or three rectangles that overlap, 50 to 120 cells, with wavy maps; every other object hides a heavy lump."""
    shape = random_shape(rng)
    centres = shape.cells.centres
    mass = _wavy_map(centres, 0.7, rng)
    if rng.uniform() < 0.5:
        lump = np.linalg.norm(centres - rng.choice(centres), axis=1) < 0.03
        mass = mass + lump * mass.mean() * rng.uniform(2.0, 6.0)
    friction = np.clip(rng.uniform(0.2, 0.45) * _wavy_map(centres, 0.4, rng), 0.05, 1.0)
    return ObjectModel(shape, mass * rng.uniform(0.3, 0.8) / mass.sum(), friction, rng.uniform(0.15, 0.5))


def random_shape(rng: np.random.Generator) -> ObjectShape:
    """Two or three overlapping rectangles of cells, 50 to 120 cells in all."""
    n = 20
    while True:
        cells = np.zeros((n, n), dtype=bool)
        seed = np.array([n // 2, n // 2])
        for _ in range(rng.integers(2, 4)):
            size = rng.integers(3, 11, 2)
            low = np.clip(seed - rng.integers(0, size), 0, n - size)
            cells[low[0] : low[0] + size[0], low[1] : low[1] + size[1]] = True
            seed = rng.integers(low, low + size)
        if 50 <= cells.sum() <= 120:
            centres = np.argwhere(cells) * _CELL
            centres = centres - centres.mean(axis=0)
            return ObjectShape(CellGrid(centres, _CELL), outline_of_cells(centres, _CELL))


def _wavy_map(centres: Float64Array, log_std: float, rng: np.random.Generator) -> Float64Array:
    """Three plane waves as the logarithm of a map."""
    extent = float(np.ptp(centres, axis=0).max())
    waves = sum(np.cos(centres @ rng.normal(size=2) * 4.0 / extent + rng.uniform(0, 2 * np.pi)) for _ in range(3))
    return np.exp(log_std * waves / np.std(waves))
