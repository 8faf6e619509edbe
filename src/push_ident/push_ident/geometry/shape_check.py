"""Whether what is given as the shape of an object, or of a pusher, can be one.

A shape from outside has two descriptions, cells and outline, which must agree to the resolution of the cells. So an outline in another
unit, scaled, mirrored or displaced is refused where it is read, before a fit learns from contacts that never happened.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.limits import LIMITS
from push_ident.types import Float64Array, ObjectShape


@dataclass(frozen=True, slots=True)
class ShapeLimits:
    """Agreement of cells and outline of one shape."""

    least_extent: float = 2e-3
    """Least width of an object [m]: a camera with millimetre accuracy sees no smaller one; 60 mm given in the wrong unit are 0.06 mm."""
    crossing_depth: float = 1e-6
    """Depth from which edges cross [m]: outlines are sent in single precision, which rounds by 6e-8 m at 1 m."""
    cell_outside: float = 1.0
    """Largest distance of a cell's centre outside the outline [cells]: a cell that touches the outline with a corner has it 0.7 cells
    outside. Largest of 16 recordings: 0 (real triangles, tracked and simulated objects)."""
    outline_beyond: float = 3.0
    """Largest distance of the outline from the nearest centre of a cell [cells]: the tip of a wedge of 20 degrees is 2.8 from the first
    centre inside. Largest of 16 recordings: 1.6, the tip of a triangle."""
    overlap: float = 0.04
    """Largest overlap of neighbouring cells [cells]: each lies within 0.02 of its lattice (`outline_of_cells`)."""
    area: float = 1.0
    """Largest difference between the areas of cells and outline, over the length of the outline [cells]. Cells whose centres are inside
    differ by 0.26 at most (20,000 random polygons of 2 to 150 cells), cells that touch the outline by 0.7; on a square of 10 x 10 cells, a
    size that is a fifth too small by 1.1."""
    edge_points: int = 1_000
    """Largest number of points of one edge that are compared with the cells."""


_LIMITS: Final = ShapeLimits()


def check_shape(shape: ObjectShape, *, remedy: str = "") -> ObjectShape:
    """The same shape, if it can be one of an object. `remedy`: where to look, for the text of an error.

    Raises:
        InputError: the size is none of an object that an arm pushes, the outline crosses itself, cells overlap, or cells and outline do
            not agree.
    """
    remedy = remedy or "Give cells and outline of the same object, in the object frame, in metres."
    extent = float(np.max(np.ptp(shape.outline, axis=0)))
    LIMITS.EXTENT.check(extent, "Outline", remedy=remedy)
    if extent < _LIMITS.least_extent:
        raise InputError(f"The outline is {extent:.2g} m wide, expected at least {_LIMITS.least_extent:g} m. {remedy}")
    LIMITS.EXTENT.check(shape.cells.size, "Cell", remedy=remedy)
    if shape.outline_std is not None:
        LIMITS.EXTENT.check(float(np.max(shape.outline_std)), "Deviation of an outline", remedy=remedy)
    if (crossing := crossing_edges(shape.outline)) is not None:
        first, second = crossing
        raise InputError(
            f"The outline crosses itself: its edges {first} and {second} of {len(shape.outline)} intersect. Give its vertices in order."
        )
    centres, size = shape.cells.squares, shape.cells.size
    outside = float(np.max(signed_distance(centres, shape.outline)))
    if outside > _LIMITS.cell_outside * size:
        raise InputError(f"Cells lie up to {outside:.3g} m outside the outline, expected at most a cell of {size:.3g} m. {remedy}")
    beyond = _distance_to_cells(shape, _LIMITS.outline_beyond * size)
    if beyond > _LIMITS.outline_beyond * size:
        most = f"{_LIMITS.outline_beyond:g} cells of {size:.3g} m"
        raise InputError(f"The outline lies {beyond:.3g} m away from the cells, expected at most {most}. {remedy}")
    _check_cells(shape, remedy)
    return shape


def _check_cells(shape: ObjectShape, remedy: str) -> None:
    """Raise InputError where cells overlap, or cover another area than the outline encloses."""
    centres, size, along = shape.cells.squares, shape.cells.size, np.roll(shape.outline, -1, axis=0) - shape.outline
    distance = np.linalg.norm(centres[:, None] - centres, axis=2) + np.diag(np.full(len(centres), np.inf))
    nearest = float(np.min(distance))
    if nearest < (1.0 - _LIMITS.overlap) * size:
        raise InputError(f"Two cells are {nearest:.3g} m apart, expected at least their size of {size:.3g} m. {remedy}")
    covered, enclosed = len(centres) * size**2, polygon_area(shape.outline)
    if abs(covered - enclosed) > _LIMITS.area * size * float(np.sum(np.linalg.norm(along, axis=1))):
        raise InputError(f"Cells of {size:.3g} m cover {covered:.3g} m^2, expected about the {enclosed:.3g} m^2 of the outline. {remedy}")


def check_pusher_radius(radius: float) -> float:
    """The same radius [m]; raises InputError where it is none of a pusher. 0 is a point."""
    if not radius >= 0:
        raise InputError(f"The radius of the pusher is {radius:g} m, expected a length >= 0 in metres.")
    LIMITS.PUSHER_RADIUS.check(radius, "Pusher", remedy="Give it in metres.")
    return radius


def crossing_edges(outline: Float64Array) -> tuple[int, int] | None:
    """Numbers of two edges that cross, of a polygon of shape (n_vertices, 2) [m]; None where there are none. Edge i starts at vertex i."""
    start, end = outline, np.roll(outline, -1, axis=0)
    along = end - start
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-300)
    for i in range(len(outline) - 2):
        others = slice(i + 2, len(outline) - (i == 0))  # neighbours share a vertex
        # Signed distances of the ends of each edge from the line of the other one.
        from_this = [_cross(along[i], points[others] - start[i]) / length[i] for points in (start, end)]
        from_others = [_cross(along[others], point - start[others]) / length[others] for point in (start[i], end[i])]
        crosses = np.ones(len(start[others]), dtype=bool)
        for a, b in (from_this, from_others):
            crosses &= (a * b < 0) & (np.minimum(np.abs(a), np.abs(b)) > _LIMITS.crossing_depth)
        if np.any(crosses):
            return i, i + 2 + int(np.argmax(crosses))
    return None


def _cross(a: Float64Array, b: Float64Array) -> Float64Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _distance_to_cells(shape: ObjectShape, allowed: float) -> float:
    """Largest distance of a point of the outline from the nearest centre of a cell [m], to within half a cell.

    It stops at the first edge that is further away than `allowed`, so that the work is bounded by the cells and not by what the outline
    claims.
    """
    start = shape.outline
    along = np.roll(start, -1, axis=0) - start
    worst = 0.0
    for a, edge in zip(start, along, strict=True):
        n = min(int(np.linalg.norm(edge) / (0.5 * shape.cells.size)) + 1, _LIMITS.edge_points)
        points = a + np.arange(n)[:, None] / n * edge
        distance2 = np.min(np.sum((points[:, None] - shape.cells.squares) ** 2, axis=2), axis=1)
        worst = max(worst, float(np.sqrt(np.max(distance2))))
        if worst > allowed:
            break
    return worst
