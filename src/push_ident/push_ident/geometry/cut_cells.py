"""Division of an object into cells: squares of one lattice, cut at the outline, so that the cells cover exactly what it encloses.

Cells are a function of squares and outline alone. So an occupancy grid and a polygon, as bags and messages have them, give the same cells
wherever they are read. Here a lattice has squares of edge 1 with whole numbers as centres; pieces of the outline are named by them.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from push_ident.errors import InputError
from push_ident.geometry.outline import polygon_area, polygon_centroid
from push_ident.geometry.se2 import rotation
from push_ident.types import BoolArray, CellGrid, Float64Array, ObjectShape

_Square = tuple[int, int]
_Point = tuple[float, float]
_T = TypeVar("_T")

_LEAST_PART: Final = 0.25
"""Least part of a square that makes a cell [-]; smaller pieces belong to the nearest cell."""
_ROUND: Final = 0.02
"""Difference of the principal moments of an area over their sum, below which noise decides about its axes [-]; as of a square."""
_WHOLE: Final = 1e-4
"""Rounding of a cell that is a whole square [squares]: outlines are sent in single precision."""


def cells_in_outline(outline: ArrayLike, size: float) -> CellGrid:
    """Cells that cover what `outline` [m], shape (n_vertices, 2), encloses: squares of edge `size` [m], cut there.

    The lattice lies along the principal axes of the area, its longest edge where these are undetermined, and is centred. Of the ways to
    centre it, cells of most equal areas are taken.

    Raises InputError when no square is covered to a quarter.
    """
    if not (np.isfinite(size) and size > 0):
        raise InputError(f"cell size is {size}, expected a positive length in metres.")
    polygon = np.asarray(outline, dtype=np.float64)
    area = polygon_area(polygon)
    too_small = InputError(f"no cell of {size:g} m is covered to a quarter by an outline of {abs(area):.3g} m^2; take smaller cells.")
    if not abs(area) >= _LEAST_PART * size**2:  # as a line, or of no numbers
        raise too_small
    polygon = polygon if area > 0 else polygon[::-1]
    turn = rotation(_principal_yaw(polygon))
    local = polygon @ turn / size
    lattices = []
    for phase in product((0.5, 0.0), repeat=2):
        origin = 0.5 * (local.min(axis=0) + local.max(axis=0)) + phase
        pieces = _pieces(local - origin)
        names = sorted((name for name, piece in pieces.items() if piece.area >= _LEAST_PART), key=lambda name: name[::-1])
        if names:
            _, areas = _measured(_joined(pieces, names))
            unevenness = round(len(areas) * float(np.sum(areas**2) / np.sum(areas) ** 2), 6)
            lattices.append((unevenness, (origin + names) * size @ turn.T))
    if not lattices:
        raise too_small
    _, squares = min(lattices, key=lambda lattice: lattice[0])
    return cut_at_outline(ObjectShape(CellGrid(squares, float(size)), polygon)).cells


def cut_at_outline(shape: ObjectShape) -> ObjectShape:
    """The shape with its squares cut at its outline.

    They stay whole where they fill it already, lie on no lattice, or one of them lies outside.
    """
    pieces = _pieces_of(shape)
    if pieces is None:
        return shape
    names, joined, axes = pieces
    centroids, areas = _measured(joined)
    if np.max(np.abs(areas - 1.0)) < _WHOLE and np.max(np.abs(centroids - names)) < _WHOLE:
        return shape
    squares, size = shape.cells.squares, shape.cells.size
    return replace(shape, cells=CellGrid(squares[0] + centroids @ axes, size, squares, areas * size**2))


def cell_polygons(shape: ObjectShape) -> list[list[Float64Array]]:
    """Boundary of each cell, for drawings: one closed line [m], shape (n, 2), or several where the outline divides a cell."""
    cells = shape.cells
    pieces = None if np.array_equal(cells.squares, cells.centres) else _pieces_of(shape)
    if pieces is None:
        corners = 0.5 * cells.size * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) @ rotation(lattice_yaw(cells)).T
        return [[centre + corners] for centre in cells.centres]
    _, joined, axes = pieces
    return [[cells.squares[0] + loop @ axes for loop in _boundary(of_cell)] for of_cell in joined]


def lattice_yaw(cells: CellGrid) -> float:
    """Angle of the lattice of the squares in the object frame [rad], -45 to 45 degrees; 0 where no two squares are neighbours."""
    pairs = KDTree(cells.squares).query_pairs(1.02 * cells.size, output_type="ndarray")
    x, y = (cells.squares[pairs[:, 1]] - cells.squares[pairs[:, 0]]).T
    return _quarter(float(np.angle(np.sum((x + 1j * y) ** 4)) / 4) if len(pairs) else 0.0)


def occupancy(cells: CellGrid) -> tuple[Float64Array, BoolArray]:
    """The squares as an occupancy grid: pose of its lower corner [m, m, rad], shape (3,), and which are occupied, shape (rows, columns).

    Raises InputError for squares that are on no lattice.
    """
    yaw = lattice_yaw(cells)
    along = cells.squares @ rotation(yaw) / cells.size
    low = along.min(axis=0)
    indices = np.rint(along - low).astype(np.int64)
    if np.abs(along - low - indices).max() > 0.02:
        raise InputError(f"cells do not lie on a lattice of {cells.size:g} m; an occupancy grid cannot hold them.")
    occupied = np.zeros(tuple(indices.max(axis=0)[::-1] + 1), dtype=np.bool_)
    occupied[indices[:, 1], indices[:, 0]] = True
    return np.array([*((low - 0.5) * cells.size @ rotation(yaw).T), yaw]), occupied


def _principal_yaw(polygon: Float64Array) -> float:
    """Angle of the principal axes of an area [rad], -45 to 45 degrees; of its longest edge where they are undetermined."""
    (ax, ay), (bx, by) = (polygon - polygon_centroid(polygon)).T, (np.roll(polygon, -1, axis=0) - polygon_centroid(polygon)).T
    cross = ax * by - bx * ay
    xx, yy = np.sum(cross * (ax * ax + ax * bx + bx * bx)) / 12, np.sum(cross * (ay * ay + ay * by + by * by)) / 12
    xy = np.sum(cross * (2 * ax * ay + ax * by + bx * ay + 2 * bx * by)) / 24
    if np.hypot(xx - yy, 2 * xy) > _ROUND * (xx + yy):
        return _quarter(0.5 * float(np.arctan2(2 * xy, xx - yy)))
    longest = int(np.argmax(np.round(np.hypot(bx - ax, by - ay), 9)))
    return _quarter(float(np.arctan2(by[longest] - ay[longest], bx[longest] - ax[longest])))


def _quarter(angle: float) -> float:
    """The same directions of a square lattice: above -45 to 45 degrees, without rounding at either end or at 0."""
    turned = (angle + np.pi / 4 - 1e-7) % (np.pi / 2) - np.pi / 4 + 1e-7
    return 0.0 if abs(turned) < 1e-7 else float(turned)


class _Piece(NamedTuple):
    """What an outline encloses of one square, connected by lines along its sides where that is several parts."""

    corners: list[_Point]
    area: float
    centroid: _Point


def _pieces_of(shape: ObjectShape) -> tuple[list[_Square], list[list[_Piece]], Float64Array] | None:
    """Squares and pieces of each cell, and the axes of the lattice [m], one a row; its origin is the first square.

    None where the squares lie on no lattice, or one of them outside.
    """
    cells = shape.cells
    turn = rotation(lattice_yaw(cells))
    along = (cells.squares - cells.squares[0]) @ turn / cells.size
    names = [(int(i), int(j)) for i, j in np.rint(along)]
    pieces = _pieces((shape.outline - cells.squares[0]) @ turn / cells.size)
    if np.max(np.abs(along - names)) > 0.02 or len(set(names)) < len(names) or not set(names) <= set(pieces):
        return None
    return names, _joined(pieces, names), cells.size * turn.T


def _pieces(polygon: Float64Array) -> dict[_Square, _Piece]:
    """Part of a polygon in each square of the lattice."""
    pieces = {}
    corners = [(float(x), float(y)) for x, y in polygon]
    for i in _span(corners, 0):
        column = _between(corners, 0, i)
        for j in _span(column, 1):
            part = _between(column, 1, j)
            crosses = [a[0] * b[1] - b[0] * a[1] for a, b in _sides(part)]
            area = 0.5 * sum(crosses)
            if area > 1e-6:
                x, y = (sum((a[k] + b[k]) * cross for (a, b), cross in zip(_sides(part), crosses, strict=True)) for k in (0, 1))
                pieces[i, j] = _Piece(part, area, (x / (6 * area), y / (6 * area)))
    return pieces


def _sides(polygon: Sequence[_T]) -> Iterator[tuple[_T, _T]]:
    """Each corner with the next one."""
    return zip(polygon, [*polygon[1:], *polygon[:1]], strict=True)


def _span(corners: Sequence[_Point], axis: int) -> range:
    """Squares along an axis that a polygon may touch."""
    along = [corner[axis] for corner in corners] or [0.5]
    return range(math.floor(min(along) + 0.5), math.ceil(max(along) + 0.5))


def _between(polygon: list[_Point], axis: int, middle: int) -> list[_Point]:
    """Part of a polygon within half a unit of `middle` along an axis (Sutherland & Hodgman 1974)."""
    for sign in (1.0, -1.0):
        bound = middle - 0.5 * sign
        kept = []
        for a, b in _sides(polygon):
            depth_a, depth_b = sign * (a[axis] - bound), sign * (b[axis] - bound)
            if depth_a >= 0:
                kept.append(a)
            if (depth_a >= 0) != (depth_b >= 0):
                across = a[1 - axis] + depth_a / (depth_a - depth_b) * (b[1 - axis] - a[1 - axis])
                kept.append((bound, across) if axis == 0 else (across, bound))
        polygon = kept
    return polygon


def _joined(pieces: Mapping[_Square, _Piece], names: Sequence[_Square]) -> list[list[_Piece]]:
    """Pieces of each cell: that of its square, and those without a cell of their own to whose centroids its square is the nearest."""
    cells = {name: [pieces[name]] for name in names}
    for name, piece in pieces.items():
        if name not in cells:
            # Rounded, since in a symmetric outline several may be as near.
            distance2 = np.round(np.sum((np.array(names) - piece.centroid) ** 2, axis=1), 4)
            cells[names[int(np.argmin(distance2))]].append(piece)
    return list(cells.values())


def _measured(cells: Sequence[Sequence[_Piece]]) -> tuple[Float64Array, Float64Array]:
    """Centroids, shape (n_cells, 2), and areas, shape (n_cells,), of cells of one or more pieces."""
    areas = np.array([sum(piece.area for piece in pieces) for pieces in cells])
    moments = np.array([[sum(piece.area * piece.centroid[axis] for piece in pieces) for axis in (0, 1)] for pieces in cells])
    return moments / areas[:, None], areas


def _boundary(pieces: Sequence[_Piece]) -> list[Float64Array]:
    """Closed lines around pieces: what two of them share, or one passes twice, is left out."""
    ends: dict[_Square, list[_Square]] = defaultdict(list)
    for piece in pieces:
        for start, end in _sides([(round(1e7 * x), round(1e7 * y)) for x, y in piece.corners]):
            if start in ends[end]:
                ends[end].remove(start)
            elif start != end:
                ends[start].append(end)
    loops = []
    while any(ends.values()):
        loop = [next(corner for corner, after in ends.items() if after)]
        while ends[loop[-1]]:
            loop.append(ends[loop[-1]].pop())
        loops.append(1e-7 * np.array(loop[:-1], dtype=np.float64))
    return loops
