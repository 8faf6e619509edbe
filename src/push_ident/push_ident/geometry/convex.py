"""A polygon divided into convex pieces, for collision engines that need convex solids."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import InputError
from push_ident.types import Float64Array


def convex_pieces(polygon: ArrayLike) -> list[Float64Array]:
    """Convex polygons without overlap whose union is `polygon`.

    Ears are clipped, the best shaped first; then every diagonal is removed that no reflex corner needs (Hertel and Mehlhorn, 1983). The
    result has at most four times the minimal number of pieces. All corners are corners of `polygon`, so that no side of it is split. It is
    simple, shape (n_vertices, 2); it and the pieces, each of shape (n, 2), are counter-clockwise and not closed [m].

    Raises:
        InputError: the polygon crosses itself, so that no ear remains; or it has no area.
    """
    points = np.asarray(polygon, dtype=np.float64)
    # A triangle whose doubled area is a smaller fraction of the squared extent of the polygon counts as a line.
    flat = 1e-10 * float(np.max(np.ptp(points, axis=0))) ** 2
    return [points[piece] for piece in _merged(points, _triangles(points, flat))]


def _turn(a: Float64Array, b: Float64Array, c: Float64Array) -> Float64Array:
    """Twice the signed area of the triangles (a, b, c), over any leading axes: positive for a left turn."""
    return np.asarray((b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0]))


def _triangles(points: Float64Array, flat: float) -> list[list[int]]:
    """Ear clipping: triangles of corner indices, counter-clockwise."""
    remaining = list(range(len(points)))
    triangles: list[list[int]] = []
    while len(remaining) > 2:
        ring = np.array(remaining)
        before, here, after = points[np.roll(ring, 1)], points[ring], points[np.roll(ring, -1)]
        turn = _turn(before, here, after)
        straight = np.flatnonzero(np.abs(turn) <= flat)
        if len(straight):
            del remaining[int(straight[0])]
            continue
        # A small altitude on the longest side marks a sliver.
        sides = [np.linalg.norm(p - q, axis=1) for p, q in ((before, here), (here, after), (after, before))]
        ears = (i for i in np.argsort(-turn / np.max(sides, axis=0)) if turn[i] > 0 and _is_ear(ring, points, int(i)))
        ear = next(ears, None)
        if ear is None:
            raise InputError("The outline crosses itself, expected a simple polygon; trace the object again.")
        triangles.append([remaining[ear - 1], remaining[ear], remaining[(ear + 1) % len(remaining)]])
        del remaining[ear]
    if not triangles:
        raise InputError("The outline has no area, expected a polygon with corners that are not on one line; trace the object again.")
    return triangles


def _is_ear(ring: NDArray[np.int64], points: Float64Array, i: int) -> bool:
    """Whether the triangle at corner i of the ring holds no other corner."""
    a, b, c = (points[ring[j % len(ring)]] for j in (i - 1, i, i + 1))
    others = points[[v for j, v in enumerate(ring) if (j - i + 1) % len(ring) > 2]]
    inside = (_turn(a, b, others) >= 0) & (_turn(b, c, others) >= 0) & (_turn(c, a, others) >= 0)
    return not bool(inside.any())


def _merged(points: Float64Array, pieces: list[list[int]]) -> list[list[int]]:
    """Hertel and Mehlhorn: join two pieces along their common diagonal wherever the union stays convex."""
    pieces = list(pieces)
    first = 0
    while first < len(pieces):
        joined = next((j for second in range(first + 1, len(pieces)) if (j := _joined(points, pieces, first, second))), None)
        if joined is None:
            first += 1
        else:
            second, pieces[first] = joined
            del pieces[second]
    return pieces


def _joined(points: Float64Array, pieces: list[list[int]], first: int, second: int) -> tuple[int, list[int]] | None:
    """`second` and the union of both pieces where they share a diagonal and the union is convex, else None."""
    one, two = pieces[first], pieces[second]
    for i, start in enumerate(one):
        end = one[(i + 1) % len(one)]
        if end in two and two[(two.index(end) + 1) % len(two)] == start:
            k = two.index(end)
            # Both without the diagonal start -> end: `one` from end round to start, then the other corners of `two`.
            union = one[i + 1 :] + one[: i + 1] + [two[(k + 2 + m) % len(two)] for m in range(len(two) - 2)]
            ring = points[union]
            convex = bool(np.all(_turn(np.roll(ring, 1, axis=0), ring, np.roll(ring, -1, axis=0)) >= 0))
            return (second, union) if convex else None
    return None
