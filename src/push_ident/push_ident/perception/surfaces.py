"""Division of pixels above the table into the surfaces of different objects.

Two criteria separate objects that touch in the image, both known from the segmentation of convex parts (Stein et al., "Object partitioning
using local convexity", 2014): the depth jumps, or two surfaces meet in a fold, as where a wall rises from a lower object beside it. The
inverse depth of a plane is linear in the image, so the chord between two pixels of one plane passes through the pixel midway between
them, whatever the view; in a fold that pixel lies behind the chord. Objects themselves have steps and folds (the head of a
hammer is higher than its handle), so both count only above a size. Objects of the same height side by side are not separated.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.types import BoolArray

__all__ = ["split_surfaces"]

_ACROSS: Final = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Directions (rows, columns) in which chords are drawn."""
_LEG: Final = 0.8
"""Half of a chord, across the line of sight, in steps: 0.8 of each side of a fold of a right angle."""
_SAG: Final = 0.5
"""Depth of a fold behind its chord, in steps."""
_CORE: Final = 60
"""Pixels that a surface needs inside its borders; smaller patches are merged into their neighbours."""


def split_surfaces(depth: NDArray[np.float32], mask: BoolArray, focal: float, step: float) -> NDArray[np.int32]:
    """Number the surfaces of `mask`, which jumps of depth and folds divide.

    Args:
        depth: [m], shape (rows, columns); NaN where nothing was measured.
        mask: Pixels to divide, same shape.
        focal: Focal length [px].
        step: Height of the smallest step that divides [m].

    Returns:
        1, 2, ... for the surfaces and 0 outside the mask, shape (rows, columns).
    """
    known = np.where(np.isfinite(depth), depth, np.float32(0.0))
    smooth = cv2.medianBlur(known, 5)
    smooth = np.where(mask & (smooth > 0), smooth, known)
    mask = mask & (smooth > 0)
    if not mask.any():
        return np.zeros(mask.shape, dtype=np.int32)
    cut = _jumps(smooth, mask, step)
    patches = _cores(mask & ~cut)
    leg = _LEG * step * focal / float(np.median(smooth[mask]))
    folded = _folds(smooth, patches, leg, _SAG * step)
    surfaces = _cores((patches > 0) & ~(cv2.dilate(folded.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0))
    return _grown(surfaces, smooth, mask, step)


def _shifted(image: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """`image` shifted by whole pixels, NaN where no pixel was shifted to."""
    moved = np.full_like(image, np.nan)
    height, width = image.shape
    if abs(rows) >= height or abs(columns) >= width:
        return moved
    to = slice(max(0, rows), height + min(0, rows)), slice(max(0, columns), width + min(0, columns))
    of = slice(max(0, -rows), height + min(0, -rows)), slice(max(0, -columns), width + min(0, -columns))
    moved[to] = image[of]
    return moved


def _jumps(depth: NDArray[np.float32], mask: BoolArray, step: float) -> BoolArray:
    """Pixels of the mask on either side of a jump; neighbours and pixels at a distance of two, since sensors blur a jump over one pixel."""
    masked = np.where(mask, depth, np.float32(np.nan))
    cut = np.zeros(mask.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        for rows, columns in _ACROSS:
            for lag in (1, 2):
                for sign in (lag, -lag):
                    cut |= np.abs(_shifted(masked, sign * rows, sign * columns) - masked) > step
    return cut


def _folds(depth: NDArray[np.float32], patches: NDArray[np.int32], leg: float, sag: float) -> BoolArray:
    """Pixels that lie behind a chord whose two ends are on the same patch as the pixel."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = _averaged(np.reciprocal(depth), patches > 0)
        number = patches.astype(np.float32)
        folded = np.zeros(patches.shape, dtype=bool)
        for rows, columns in _ACROSS:
            lag = max(2, round(leg / float(np.hypot(rows, columns))))
            ends = [(_shifted(inverse, s * rows, s * columns), _shifted(number, s * rows, s * columns)) for s in (lag, -lag)]
            chord = 2.0 / (ends[0][0] + ends[1][0])
            folded |= (1 / inverse - chord > sag) & (ends[0][1] == number) & (ends[1][1] == number)
    return folded


def _averaged(values: NDArray[np.float32], mask: BoolArray) -> NDArray[np.float32]:
    """Mean over 3 x 3 pixels of the mask; NaN outside."""
    fraction = cv2.blur(mask.astype(np.float32), (3, 3))
    total = cv2.blur(np.where(mask, values, np.float32(0.0)), (3, 3))
    return np.where(mask, total / np.maximum(fraction, np.float32(0.1)), np.float32(np.nan))


def _cores(mask: BoolArray) -> NDArray[np.int32]:
    """Connected patches of the mask that are large enough, numbered 1, 2, ..."""
    n, components, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    large = np.flatnonzero(boxes[:, cv2.CC_STAT_AREA] >= _CORE)
    number = np.zeros(n, dtype=np.int32)
    kept = large[large > 0]
    number[kept] = np.arange(1, len(kept) + 1)
    return number[components]


def _grown(surfaces: NDArray[np.int32], depth: NDArray[np.float32], mask: BoolArray, step: float) -> NDArray[np.int32]:
    """Grow the surfaces over the pixels of their borders: each pixel joins the neighbour nearest in depth, but not across a jump."""
    grown = surfaces.copy()
    while True:
        open_pixels = mask & (grown == 0)
        best, nearest = np.full(mask.shape, step, dtype=np.float32), np.zeros(mask.shape, dtype=np.int32)
        for rows, columns in _ACROSS[:2]:
            for sign in (1, -1):
                number = np.nan_to_num(_shifted(grown.astype(np.float32), sign * rows, sign * columns)).astype(np.int32)
                difference = np.abs(_shifted(depth, sign * rows, sign * columns) - depth)
                nearer = open_pixels & (number > 0) & (difference < best)
                best[nearer], nearest[nearer] = difference[nearer], number[nearer]
        if not nearest.any():
            return grown
        grown[nearest > 0] = nearest[nearest > 0]
