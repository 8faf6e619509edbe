"""Distances from outlines on a grid: one look-up a point, however many outlines there are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.types import BoolArray, Float64Array

RESOLUTION: Final = 1e-3
"""Edge of a cell [m]: half the spacing of the cells of perception's occupancy."""
_MOST_ALONG: Final = 3000
"""Largest number of cells along a side: they are larger where that does not do, so that no outline takes more than some 100 MB."""
_SUBPIXEL: Final = 8
"""Bits of a fraction of a pixel in the corners of a polygon [1]."""


@dataclass(frozen=True, slots=True)
class DistanceField:
    """Signed distance from the union of outlines."""

    low: Float64Array
    """Centre of the first cell [m], shape (2,)."""
    size: float
    """Edge of a cell [m]."""
    distance: NDArray[np.float32]
    """Of the centre of each cell [m], negative inside, shape (rows along y, columns along x)."""

    @classmethod
    def of(cls, outlines: Sequence[Float64Array], low: Float64Array, high: Float64Array) -> DistanceField:
        """Of outlines, each of shape (n_vertices, 2), over a rectangle with corners `low` and `high`, shape (2,) [m]. What of them lies
        outside of it does not count."""
        size = max(RESOLUTION, float(np.max(high - low)) / _MOST_ALONG)
        columns, rows = np.ceil((high - low) / size) + 1
        return cls(np.array(low), size, size * _signed(_filled(outlines, low, size, (int(rows), int(columns)))))

    def at(self, points: Float64Array) -> Float64Array:
        """Distance of points, shape (..., 2), exact to 1.2 cells [m], shape (...); outside the rectangle that of its nearest cell. -inf for
        a point that is not finite."""
        finite: BoolArray = np.all(np.isfinite(points), axis=-1)
        index = np.rint((np.where(finite[..., None], points, 0.0) - self.low) / self.size).astype(np.int64)
        rows, columns = self.distance.shape
        nearest = self.distance[np.clip(index[..., 1], 0, rows - 1), np.clip(index[..., 0], 0, columns - 1)]
        return np.asarray(np.where(finite, nearest, -np.inf), dtype=np.float64)


def grown(outline: Float64Array, by: float) -> Float64Array:
    """Outline of all points within a distance `by` [m] of an outline, shape (n, 2): shape (m, 2), up to a cell further out; holes are
    filled."""
    if by <= 0.0:
        return outline
    size = max(RESOLUTION, (float(np.max(np.ptp(outline, axis=0))) + 2.0 * by) / _MOST_ALONG)
    low, high = outline.min(axis=0) - by - 3 * size, outline.max(axis=0) + by + 3 * size
    columns, rows = np.ceil((high - low) / size)
    near = size * _signed(_filled([outline], low, size, (int(rows), int(columns)))) <= by + size
    return low + size * max(contours(near), key=len)


def pieces(mask: BoolArray, least: int) -> list[tuple[Float64Array, BoolArray]]:
    """Connected pieces of a mask with so many cells at least: the (column, row) of the first cell of each, shape (2,), and the piece in its
    bounding box."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    found = []
    for number in 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= least):
        x, y, width, height = stats[number, :4].tolist()
        found.append((np.array([x, y], dtype=np.float64), labels[y : y + height, x : x + width] == number))
    return found


def contours(mask: BoolArray) -> list[Float64Array]:
    """Outer borders of the pieces of a mask, each of shape (n, 2), counter-clockwise, in (column, row) of cell centres."""
    borders, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    # Within half a cell, so that a straight side has two ends.
    lines = [cv2.approxPolyDP(contour, 0.5, closed=True)[:, 0, :].astype(np.float64) for contour in borders]
    return [line[::-1] if cv2.contourArea(line.astype(np.float32), oriented=True) < 0 else line for line in lines]


def _filled(outlines: Sequence[Float64Array], low: Float64Array, size: float, shape: tuple[int, int]) -> NDArray[np.uint8]:
    image = np.zeros(shape, dtype=np.uint8)
    for outline in outlines:
        corners = np.rint((outline - low) / size * (1 << _SUBPIXEL)).astype(np.int32)
        cv2.fillPoly(image, [corners], (1,), shift=_SUBPIXEL)
    return image


def _signed(filled: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Distance from the outermost filled cells [cells], negative inside; the largest one of the image where none is filled."""
    if not filled.any():
        return np.full(filled.shape, float(np.hypot(*filled.shape)), dtype=np.float32)
    outside, inside = (cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for mask in (1 - filled, filled))
    # Cells on the border are filled as well: it passes through their centres.
    return np.asarray(np.where(filled == 1, 1.0 - inside, outside), dtype=np.float32)
