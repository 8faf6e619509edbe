"""Loops that divide pixels into surfaces and trace objects, compiled as in `kernels`.

Each gives the same result as the operations on whole arrays that it replaces, to the last bit; the tests hold those.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numba import types

from push_ident.perception.kernels import kernel, read_only

__all__ = ["edges_nearest", "grow_surfaces", "highest_in_cells", "mark_folds", "mark_jumps", "outline_distances", "sort_columns"]

_REAL: Final = types.float64
_ROWS: Final = read_only(types.float64, 2)
_DEPTH: Final = read_only(types.float32, 2)
_MASK: Final = read_only(types.bool_, 2)
_NUMBERS: Final = read_only(types.int32, 2)


@kernel(_ROWS, _ROWS)
def outline_distances(points: Any, outline: Any) -> Any:
    """`geometry.outline.signed_distance`, compiled: the same operations in the same order, so equal to the last bit.

    Args:
        points: Shape (n, 2) [m].
        outline: Shape (n_vertices, 2) [m].
    """
    n = len(outline)
    edge, square = np.empty((n, 2)), np.empty(n)
    for k in range(n):
        end = k + 1 if k + 1 < n else 0
        edge[k, 0], edge[k, 1] = outline[end, 0] - outline[k, 0], outline[end, 1] - outline[k, 1]
        square[k] = max(edge[k, 0] * edge[k, 0] + edge[k, 1] * edge[k, 1], 1e-300)
    result = np.empty(len(points))
    for i in range(len(points)):
        px, py = points[i, 0], points[i, 1]
        nearest2, inside = math.inf, False
        above = outline[0, 1] > py
        for k in range(n):
            ex, ey = edge[k, 0], edge[k, 1]
            x, y = px - outline[k, 0], py - outline[k, 1]
            along = min(max((x * ex + y * ey) / square[k], 0.0), 1.0)
            off_x, off_y = x - along * ex, y - along * ey
            distance2 = off_x * off_x + off_y * off_y
            if not distance2 >= nearest2:  # so that NaN stays NaN
                nearest2 = distance2
            end = k + 1 if k + 1 < n else 0
            end_above = outline[end, 1] > py
            if above != end_above and px < outline[k, 0] + y * ex / ey:
                inside = not inside
            above = end_above
        result[i] = -math.sqrt(nearest2) if inside else math.sqrt(nearest2)
    return result


@kernel(_ROWS, _ROWS)
def edges_nearest(points: Any, outline: Any) -> Any:
    """Index of the edge nearest to each point (n, 2), of several the first; and how far along that edge, or beyond it, the point lies [m].

    Shapes (n,). `outline` has shape (n_vertices, 2).
    """
    n = len(outline)
    edge, direction, length = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    for k in range(n):
        end = k + 1 if k + 1 < n else 0
        edge[k, 0], edge[k, 1] = outline[end, 0] - outline[k, 0], outline[end, 1] - outline[k, 1]
        length[k] = math.sqrt(edge[k, 0] * edge[k, 0] + edge[k, 1] * edge[k, 1])
        direction[k, 0], direction[k, 1] = edge[k, 0] / length[k], edge[k, 1] / length[k]
    index, position = np.zeros(len(points), dtype=np.int64), np.zeros(len(points))
    for i in range(len(points)):
        nearest, nearest2 = math.inf, math.inf
        for k in range(n):
            x, y = points[i, 0] - outline[k, 0], points[i, 1] - outline[k, 1]
            along = (x * edge[k, 0] + y * edge[k, 1]) / length[k]
            foot = min(max(along, 0.0), length[k])
            off_x, off_y = x - foot * direction[k, 0], y - foot * direction[k, 1]
            distance2 = off_x * off_x + off_y * off_y
            # Two edges that share the nearest corner may differ in the last bit of the square: the first one counts.
            if distance2 < nearest2 and math.sqrt(distance2) < nearest:
                nearest, nearest2 = math.sqrt(distance2), distance2
                index[i], position[i] = k, along
    return index, position


@kernel(types.Array(types.float32, 2, "C"))
def sort_columns(values: Any) -> Any:
    """Sort each column of `values`, shape (n, m), in place, ascending; NaN is not allowed.

    A network of compare-and-swap of whole rows (odd-even transposition), which the compiler turns into vector instructions.
    """
    n, m = values.shape
    for turn in range(n):
        for row in range(turn % 2, n - 1, 2):
            for column in range(m):
                a, b = values[row, column], values[row + 1, column]
                values[row, column], values[row + 1, column] = (a if a < b else b), (b if a < b else a)


@kernel(_DEPTH, read_only(types.float64, 1), _REAL, types.int64, types.int64)
def highest_in_cells(points: Any, origin: Any, size: Any, rows: Any, columns: Any) -> Any:
    """Height of the highest of the points in each cell, -infinity in cells without any [m], shape (rows, columns).

    Args:
        points: [m], shape (n, 3), all in the cells.
        origin: Low corner of the first cell [m], shape (2,).
        size: Edge of a cell [m].
    """
    heights = np.full((rows, columns), np.float32(-np.inf))
    for i in range(len(points)):
        column, row = int((points[i, 0] - origin[0]) / size), int((points[i, 1] - origin[1]) / size)
        heights[row, column] = max(heights[row, column], points[i, 2])
    return heights


@kernel(_DEPTH, _MASK, _REAL)
def mark_jumps(depth: Any, mask: Any, step: Any) -> Any:
    """Pixels of the mask whose depth differs by more than `step` [m] from a pixel of it one or two pixels away, straight or diagonally.

    `depth` [m] and `mask` have shape (height, width), as has the result.
    """
    height, width = mask.shape
    threshold = np.float32(step)
    cut = np.zeros(mask.shape, dtype=np.bool_)
    for v in range(height):
        for u in range(width):
            if not mask[v, u]:
                continue
            for lag in (1, 2):
                for rows, columns in ((0, lag), (lag, 0), (lag, lag), (lag, -lag)):
                    i, j = v + rows, u + columns
                    if i < height and 0 <= j < width and mask[i, j] and abs(depth[i, j] - depth[v, u]) > threshold:
                        cut[v, u] = cut[i, j] = True
    return cut


@kernel(_DEPTH, _NUMBERS, types.UniTuple(types.UniTuple(types.int64, 2), 4), _REAL)
def mark_folds(inverse: Any, patches: Any, legs: Any, sag: Any) -> Any:
    """Pixels deeper than a chord by more than `sag` [m], whose two ends are on the same patch as the pixel.

    Args:
        inverse: Inverse depth [1/m], shape (height, width).
        patches: Number of the patch of each pixel, 0 for none, same shape.
        legs: From the middle to the end of each chord: rows, which are not negative, and columns.
    """
    height, width = patches.shape
    least, one, two = np.float32(sag), np.float32(1.0), np.float32(2.0)
    folded = np.zeros(patches.shape, dtype=np.bool_)
    for v in range(height):
        for u in range(width):
            number = patches[v, u]
            if number == 0:
                continue
            for rows, columns in legs:
                top, left, bottom, right = v - rows, u - columns, v + rows, u + columns
                if top < 0 or bottom >= height or min(left, right) < 0 or max(left, right) >= width:
                    continue
                if patches[top, left] == number and patches[bottom, right] == number:
                    chord = two / (inverse[top, left] + inverse[bottom, right])
                    if one / inverse[v, u] - chord > least:
                        folded[v, u] = True
                        break
    return folded


@kernel(_NUMBERS, _DEPTH, _MASK, _REAL)
def grow_surfaces(surfaces: Any, depth: Any, mask: Any, step: Any) -> Any:
    """Grow numbered surfaces over the pixels of `mask`, one ring of pixels at a time.

    Each pixel joins, of its four neighbours that belong to a surface, the one nearest in depth, if the difference is below `step` [m]. A
    pixel that could not join is looked at again only when another neighbour has joined. All arrays have shape (height, width).
    """
    height, width = mask.shape
    threshold = np.float32(step)
    grown, looked_at = surfaces.copy(), np.zeros(mask.shape, dtype=np.int32)
    border, following = np.empty(mask.size, dtype=np.int64), np.empty(mask.size, dtype=np.int64)
    joined = np.empty(mask.size, dtype=np.int32)
    n, turn = 0, 1
    for v in range(height):
        for u in range(width):
            if mask[v, u] and grown[v, u] == 0:
                border[n] = v * width + u
                n += 1
    while n > 0:
        for k in range(n):
            v, u = border[k] // width, border[k] % width
            best, joined[k] = threshold, 0
            for rows, columns in ((0, -1), (0, 1), (-1, 0), (1, 0)):
                i, j = v + rows, u + columns
                if 0 <= i < height and 0 <= j < width and grown[i, j] > 0:
                    difference = abs(depth[i, j] - depth[v, u])
                    if difference < best:
                        best, joined[k] = difference, grown[i, j]
        for k in range(n):
            if joined[k] > 0:
                grown[border[k] // width, border[k] % width] = joined[k]
        n_following = 0
        for k in range(n):
            if joined[k] == 0:
                continue
            v, u = border[k] // width, border[k] % width
            for rows, columns in ((0, -1), (0, 1), (-1, 0), (1, 0)):
                i, j = v + rows, u + columns
                if 0 <= i < height and 0 <= j < width and mask[i, j] and grown[i, j] == 0 and looked_at[i, j] != turn:
                    looked_at[i, j] = turn
                    following[n_following] = i * width + j
                    n_following += 1
        border, following = following, border
        n, turn = n_following, turn + 1
    return grown
