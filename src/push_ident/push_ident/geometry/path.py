"""Paths of points in space."""

from __future__ import annotations

import numpy as np

from push_ident.types import Float64Array

__all__ = ["nearest_on_path"]


def nearest_on_path(path: Float64Array, point: Float64Array) -> tuple[float, float]:
    """Distance of a point from a path of straight lines.

    Args:
        path: its corners [m], shape (n, d), n at least 1.
        point: shape (d,) [m].

    Returns:
        The distance [m], and the nearest place as an index of corners: 2.25 is a quarter of the way from the third to the fourth.
    """
    edge = np.diff(path, axis=0)
    if len(edge) == 0:
        return float(np.linalg.norm(path[0] - point)), 0.0
    from_start = point - path[:-1]
    share = np.clip(np.sum(from_start * edge, axis=1) / np.maximum(np.sum(edge * edge, axis=1), 1e-300), 0.0, 1.0)
    distance = np.linalg.norm(from_start - share[:, None] * edge, axis=1)
    k = int(np.argmin(distance))
    return float(distance[k]), float(k + share[k])
