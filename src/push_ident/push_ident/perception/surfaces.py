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

from push_ident.perception.shape_kernels import grow_surfaces, mark_folds, mark_jumps
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
    cut = mark_jumps(smooth, mask, step)
    patches = _cores(mask & ~cut)
    leg = _LEG * step * focal / float(np.median(smooth[mask]))
    folded = _folds(smooth, patches, leg, _SAG * step)
    surfaces = _cores((patches > 0) & ~(cv2.dilate(folded.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0))
    return np.asarray(grow_surfaces(surfaces, smooth, mask, step))


def _folds(depth: NDArray[np.float32], patches: NDArray[np.int32], leg: float, sag: float) -> BoolArray:
    """Pixels that lie behind a chord whose two ends are on the same patch as the pixel."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = _averaged(np.reciprocal(depth), patches > 0)
    furthest = max(depth.shape)  # a longer chord ends outside; a wrong unit would make one of any length
    lags = [max(2, round(min(leg / float(np.hypot(rows, columns)), furthest))) for rows, columns in _ACROSS]
    legs = tuple((lag * rows, lag * columns) for lag, (rows, columns) in zip(lags, _ACROSS, strict=True))
    return np.asarray(mark_folds(inverse, patches, legs, sag))


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
