"""Noise of a height on the table, by the distance from the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.perception.frame.view import points_in_table
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import BoolArray, DepthFrame, Float64Array

_WIDTHS: Final = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Widths of a band [m]; the first one with few enough bands is used."""
_LEAST_POINTS: Final = 200
"""Bands with fewer points are left out."""
_DEVIATION: Final = 1.4826
"""Standard deviation over the median absolute deviation of a normal distribution."""


@dataclass(frozen=True, slots=True)
class NoiseBand:
    """The heights of the table at one distance."""

    near: float
    """Least depth [m]."""
    far: float
    """Largest depth [m]."""
    n_points: int
    """Pixels of one frame."""
    deviation: float
    """Standard deviation of single heights in one frame about the median of the band [m]."""
    over_time: float | None
    """The part of it that changes from frame to frame [m]; None for a single frame. The rest stays: it is a pattern of the camera."""
    median: float
    """Median height of the band in the median of all frames [m]: the systematic part, 0 on a flat table without distortion."""


def noise_by_distance(
    frames: Sequence[DepthFrame], picture: DepthFrame, camera_in_table: Float64Array, settings: PerceptionSettings
) -> tuple[tuple[NoiseBand, ...], float]:
    """Noise of single heights on the table: the bands, nearest first, and the deviation of all heights from the plane in single frames [m].

    `frames` are at rest, `picture` is their median; `camera_in_table`: optical frame in the table frame whose z = 0 is the plane, shape (4,
    4).
    """
    points = points_in_table(picture, camera_in_table)
    on_table = _on_table(points, settings)
    depth = picture.depth[on_table]
    if len(depth) < _LEAST_POINTS:
        return (), 0.0
    mean_height = points[..., 2][on_table]
    some = frames[:: max(1, len(frames) // 5)][:5]  # measured one by one: each has thousands of points
    single = np.stack([points_in_table(frame, camera_in_table)[..., 2][on_table] for frame in some])
    bands = []
    for near, far in _limits(depth):
        in_band = (depth >= near) & (depth < far)
        if np.count_nonzero(in_band) < _LEAST_POINTS:
            continue
        heights = single[:, in_band]
        over_time = _over_time(heights) if len(some) > 1 else None
        bands.append(
            NoiseBand(near, far, int(np.count_nonzero(in_band)), _spread(heights), over_time, float(np.median(mean_height[in_band])))
        )
    return tuple(bands), _DEVIATION * float(np.nanmedian(np.abs(single)))


def _on_table(points: NDArray[np.float32], settings: PerceptionSettings) -> BoolArray:
    """Pixels in the workspace that show the table, three pixels away from the edges of everything else, where depths are mixed.

    Points within 12 mm of the plane are table: wide enough for the noise of a Kinect at 2 m and for a plate that is not flat.
    """
    (low_x, low_y), (high_x, high_y) = settings.workspace_low, settings.workspace_high
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    with np.errstate(invalid="ignore"):
        flat = (np.abs(z) < 0.012) & (x > low_x) & (x < high_x) & (y > low_y) & (y < high_y)
    return np.asarray(cv2.erode(flat.astype(np.uint8), np.ones((7, 7), np.uint8), borderValue=0) > 0)


def _limits(depth: NDArray[np.float32], most: int = 6) -> list[tuple[float, float]]:
    """Least and largest depth [m] of `most` bands or fewer."""
    low, high = (float(value) for value in np.quantile(depth, [0.005, 0.995]))
    width = next((w for w in _WIDTHS if np.ceil(high / w) - np.floor(low / w) <= most), _WIDTHS[-1])
    first, last = int(np.floor(low / width)), int(np.ceil(high / width))
    return [(round(i * width, 3), round((i + 1) * width, 3)) for i in range(first, last)]


def _spread(heights: NDArray[np.float32]) -> float:
    """Deviation about the median of each frame, shape (frames, points)."""
    centred = heights - np.nanmedian(heights, axis=1, keepdims=True)
    return _DEVIATION * float(np.nanmedian(np.abs(centred)))


def _over_time(heights: NDArray[np.float32]) -> float | None:
    """Root mean variance over the frames, of the pixels that all frames measured; shape (frames, points). Depths come in steps, so that a
    median of differences would be zero."""
    everywhere = heights[:, np.isfinite(heights).all(axis=0)]
    if everywhere.shape[1] < _LEAST_POINTS:
        return None
    return float(np.sqrt(np.mean(np.var(everywhere, axis=0, ddof=1))))
