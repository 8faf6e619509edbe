"""Outline polygons: traced from square cells, and measured.

A polygon is simple, counter-clockwise and not closed, shape (n_vertices, 2), in metres.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import InputError
from push_ident.geometry.se2 import rotation
from push_ident.types import BoolArray, Float64Array

_Corner = tuple[int, int]


def polygon_area(polygon: ArrayLike) -> float:
    """Signed area [m^2]: positive for counter-clockwise."""
    x, y = np.asarray(polygon, dtype=np.float64).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def polygon_centroid(polygon: ArrayLike) -> tuple[float, float]:
    """Centroid (x, y) of the area [m]."""
    x, y = np.asarray(polygon, dtype=np.float64).T
    x_next, y_next = np.roll(x, -1), np.roll(y, -1)
    cross = x * y_next - x_next * y
    return float(np.sum((x + x_next) * cross) / (3 * np.sum(cross))), float(np.sum((y + y_next) * cross) / (3 * np.sum(cross)))


def edge_normals(polygon: Float64Array) -> Float64Array:
    """Outward unit normal of each edge, from vertex i to i + 1, shape (n_vertices, 2); either orientation."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return np.asarray(normal if polygon_area(polygon) > 0 else -normal)


def line_crossing(p: Float64Array, u: Float64Array, q: Float64Array, v: Float64Array) -> Float64Array | None:
    """Where the line through p along u crosses the one through q along v, shape (2,); None where they are nearly parallel: at a sine below
    0.25 noise displaces the crossing by four times its size and more. `u` and `v` have unit length."""
    sine = u[0] * v[1] - u[1] * v[0]
    if abs(sine) < 0.25:
        return None
    between = q - p
    return np.asarray(p + (between[0] * v[1] - between[1] * v[0]) / sine * u)


def points_in_polygon(points: ArrayLike, polygon: ArrayLike) -> BoolArray:
    """Which of `points` (n, 2) lie inside, shape (n,), by the even-odd rule; points on the boundary may count as either."""
    start = np.asarray(polygon, dtype=np.float64)
    return np.asarray(_in_blocks(_inside, np.asarray(points, dtype=np.float64), start), dtype=np.bool_)


def _inside(points: Float64Array, start: Float64Array) -> BoolArray:
    px, py = points.T[:, :, None]
    (ax, ay), (bx, by) = start.T, np.roll(start, -1, axis=0).T
    crosses = (ay > py) != (by > py)
    height = np.where(by == ay, 1.0, by - ay)
    return np.asarray(np.count_nonzero(crosses & (px < ax + (py - ay) * (bx - ax) / height), axis=1) % 2 == 1)


def signed_distance(points: ArrayLike, polygon: ArrayLike) -> Float64Array:
    """Distance of each of `points` (n, 2) to the outline [m], shape (n,): positive outside, negative inside."""
    start = np.asarray(polygon, dtype=np.float64)
    return np.asarray(_in_blocks(_distance, np.asarray(points, dtype=np.float64), start), dtype=np.float64)


def outline_distance(position: Float64Array, pose: Float64Array, outline: Float64Array) -> Float64Array:
    """Distance of points to an outline [m], negative inside, shape (n,); points, shape (n, 2), and poses, shape (n, 3), in `table`."""
    x, y = (position - pose[:, :2]).T
    cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return signed_distance(np.column_stack([cosine * x + sine * y, cosine * y - sine * x]), outline)


def _distance(points: Float64Array, start: Float64Array) -> Float64Array:
    edge = np.roll(start, -1, axis=0) - start
    from_start = points[:, None, :] - start
    along = np.clip(np.sum(from_start * edge, axis=2) / np.maximum(np.sum(edge * edge, axis=1), 1e-300), 0.0, 1.0)
    distance = np.min(np.linalg.norm(from_start - along[..., None] * edge, axis=2), axis=1)
    return np.where(_inside(points, start), -distance, distance)


def outline_contact(points: Float64Array, polygon: Float64Array) -> tuple[Float64Array, Float64Array, NDArray[np.intp]]:
    """Distance of each of `points` (n, 2) to the outline [m], negative inside, shape (n,), its gradient by the point, shape (n, 2), and the
    nearest edge, shape (n,).

    The gradient is the outward normal of the edge, or points away from the nearest corner.
    """
    edge = np.roll(polygon, -1, axis=0) - polygon
    from_start = points[:, None, :] - polygon
    along = np.clip(np.sum(from_start * edge, axis=2) / np.maximum(np.sum(edge * edge, axis=1), 1e-300), 0.0, 1.0)
    away = from_start - along[..., None] * edge
    nearest = np.argmin(np.linalg.norm(away, axis=2), axis=1)
    away = away[np.arange(len(points)), nearest]
    distance = np.linalg.norm(away, axis=1) * np.where(_inside(points, polygon), -1.0, 1.0)
    on_it = np.abs(distance) < 1e-9  # [m]: the difference has lost its direction
    gradient = np.where(on_it[:, None], edge_normals(polygon)[nearest], away / np.where(on_it, 1.0, distance)[:, None])
    return distance, gradient, nearest


def _in_blocks(function: Callable[[Float64Array, Float64Array], Any], points: Float64Array, polygon: Float64Array) -> NDArray[Any]:
    """`function` of the points, so many at once that all pairs of points and vertices fit into little memory."""
    size = max(1, 1_000_000 // max(1, len(polygon)))  # pairs: 50 MB
    if len(points) <= size:
        return np.asarray(function(points, polygon))
    return np.concatenate([function(points[at : at + size], polygon) for at in range(0, len(points), size)])


def outline_of_cells(centres: ArrayLike, size: float, *, yaw: float = 0.0) -> Float64Array:
    """Exact boundary of the union of square cells, counter-clockwise, shape (n_vertices, 2), corners only.

    `centres` [m], shape (n_cells, 2), lie on one square lattice of edge `size` [m], turned by `yaw` [rad]. Of several
    pieces the largest is taken (cells that share only a corner belong to different pieces); holes are ignored.
    Raises InputError when there are no cells or they do not lie on one lattice.
    """
    centres = np.asarray(centres, dtype=np.float64)
    if centres.ndim != 2 or centres.shape[1] != 2 or len(centres) == 0:
        raise InputError(f"cell centres have shape {centres.shape}, expected (n_cells, 2) with at least one cell.")
    if not (np.isfinite(size) and size > 0 and np.isfinite(yaw) and np.isfinite(centres).all()):
        raise InputError(f"cells are not finite, or their size {size} is not a positive length in metres.")
    lattice = (centres - centres[0]) @ rotation(yaw) / size
    indices = np.rint(lattice).astype(np.int64)
    error = float(np.abs(lattice - indices).max())
    if error > 0.02:  # [cells]: rounding to float32 causes far less, a wrong size far more
        raise InputError(f"cell centres lie up to {error * size:.2g} m from a lattice of {size:g} m; pass its size and yaw.")
    loops = _boundary_loops({(int(i), int(j)) for i, j in indices})
    corners = max(loops, key=polygon_area)
    loop = np.asarray(corners, dtype=np.float64)
    before, after = loop - np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0) - loop
    vertices = loop[before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]]  # the corners at which it turns
    return (vertices - 0.5) * size @ rotation(yaw).T + centres[0]


def _boundary_loops(cells: set[_Corner]) -> list[list[_Corner]]:
    """Simple loops of lattice corners around `cells`, which lie to their left: outer loops turn left, holes right.

    Cell (i, j) has the corners (i, j) and (i + 1, j + 1).
    """
    next_corners: dict[_Corner, list[_Corner]] = defaultdict(list)
    for i, j in sorted(cells):
        for neighbour, start, end in (
            ((i, j - 1), (i, j), (i + 1, j)),
            ((i + 1, j), (i + 1, j), (i + 1, j + 1)),
            ((i, j + 1), (i + 1, j + 1), (i, j + 1)),
            ((i - 1, j), (i, j + 1), (i, j)),
        ):
            if neighbour not in cells:
                next_corners[start].append(end)
    loops: list[list[_Corner]] = []
    while next_corners:
        walk = [next(iter(next_corners))]
        position = {walk[0]: 0}
        while walk:
            corner = _leave(next_corners, walk)
            if corner not in position:
                position[corner] = len(walk)
                walk.append(corner)
                continue
            # The walk passes twice where cells share only a corner: cutting it there keeps every loop simple.
            loops.append(walk[position[corner] :])
            for closed in loops[-1]:
                del position[closed]
            del walk[len(walk) - len(loops[-1]) :]
            if walk:
                position[corner] = len(walk)
                walk.append(corner)
    return loops


def _leave(next_corners: dict[_Corner, list[_Corner]], walk: list[_Corner]) -> _Corner:
    """Remove and return the edge that leaves the last corner of `walk`, the leftmost of two."""
    corner = walk[-1]
    ends = next_corners[corner]
    if len(ends) > 1 and len(walk) > 1:
        back = walk[-2]
        heading = (corner[0] - back[0], corner[1] - back[1])
        ends.sort(key=lambda end: heading[0] * (end[1] - corner[1]) - heading[1] * (end[0] - corner[0]))
    end = ends.pop()
    if not ends:
        del next_corners[corner]
    return end


def dense(outline: Float64Array, step: float = 2.5e-4) -> Float64Array:
    """Points along the outline every `step` [m], by default as dense as in a traced contour."""
    ends = np.roll(outline, -1, axis=0)
    counts = np.maximum(np.linalg.norm(ends - outline, axis=1) / step, 1.0).astype(np.int64)
    return np.concatenate(
        [a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a) for a, b, n in zip(outline, ends, counts, strict=True)]
    )
