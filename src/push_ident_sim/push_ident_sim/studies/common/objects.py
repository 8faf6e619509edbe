"""Objects of studies: a square plate cut into any number of cells, the same at each resolution, and objects of random shape and maps."""

from __future__ import annotations

import numpy as np

from push_ident.geometry.outline import outline_of_cells
from push_ident.physics.simulation import PoseLoss
from push_ident.pushing.push import PushSettings
from push_ident.pushing.sampling import sample_push
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath
from push_ident_sim.objects import SimObject

_SIDE = 0.12
"""Of the plate [m]."""
_PUSHES = PushSettings(
    workspace=(-0.6, 0.6, -0.6, 0.6),
    pusher_radius=0.008,
    clearance=0.01,
    distance_range=(0.09, 0.09),
    speed_range=(0.1, 0.1),
    cone=float(np.radians(40.0)),
)
FRAMES = np.linspace(0.0, 1.0, 31)
"""Times of the poses [s]: at the rate of a camera."""


def plate(cells_along: int, seed: int) -> ObjectModel:
    """`cells_along`² cells with wavy maps of mass and friction that depend only on `seed` and on the place; 0.5 kg."""
    rng = np.random.default_rng(seed)
    size = _SIDE / cells_along
    along = (np.arange(cells_along) - (cells_along - 1) / 2) * size
    centres = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)
    mass = np.exp(_waves(centres, 0.5, rng))
    friction = 0.3 * np.exp(_waves(centres, 0.3, rng))
    shape = ObjectShape(CellGrid(centres, size), outline_of_cells(centres, size))
    return ObjectModel(shape, 0.5 * mass / mass.sum(), friction, 0.3)


def _waves(centres: Float64Array, amplitude: float, rng: np.random.Generator) -> Float64Array:
    """Three plane waves, one to two wavelengths long on the plate."""
    angle, length, phase = rng.uniform(0, 2 * np.pi, 3), rng.uniform(_SIDE / 2, _SIDE, 3), rng.uniform(0, 2 * np.pi, 3)
    across = centres @ np.array([np.cos(angle), np.sin(angle)])
    return np.asarray(amplitude * np.cos(2 * np.pi * across / length + phase).sum(axis=1))


def plate_pushes(n: int, seed: int) -> list[PusherPath]:
    """`n` random pushes of the plate at the origin, as in the paper but for their speed: each lasts one second."""
    rng, shape = np.random.default_rng([seed, 1]), plate(4, seed).shape
    plans = [sample_push(shape, np.zeros(3), rng, _PUSHES) for _ in range(n)]
    return [
        PusherPath(np.array([0.0, 1.0]), np.array([p.tool_at_contact - _PUSHES.clearance * p.heading, p.tool_end]), _PUSHES.pusher_radius)
        for p in plans
    ]


def distance_to(target: Float64Array) -> PoseLoss:
    """Half the sum of squared differences to poses, an angle taken at a lever of 5 cm [m²]; `target` of shape (n_frames, 3)."""
    weight = np.array([1.0, 1.0, 0.05**2])

    def loss(poses: Float64Array) -> tuple[float, Float64Array]:
        error = poses - target
        return 0.5 * float(np.sum(weight * error**2)), weight * error

    return loss


def plate_in_bullet(model: ObjectModel) -> SimObject:
    """The plate as an object of the simulated cell."""
    cells = model.shape.cells
    return SimObject("plate", cells.size, cells.centres, np.full(len(cells), 0.03), model.mass, model.friction, model.pusher_friction)


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
    extent = float(np.ptp(centres, axis=0).max())
    waves = sum(np.cos(centres @ rng.normal(size=2) * 4.0 / extent + rng.uniform(0, 2 * np.pi)) for _ in range(3))
    return np.exp(log_std * waves / np.std(waves))
