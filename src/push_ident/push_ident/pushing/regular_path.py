"""Paths whose stamps jitter.

Logs stamp a sample when it arrives, not when it was taken. Two samples that arrive within 0.1 ms then lie as far apart as others that lie
4 ms apart: between them the pusher would have a speed that no arm has, and would throw the object.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.types import Float64Array, PusherPath

_SAMPLES: Final = 5
"""Number of intervals over which jitter averages out; a smoothing spline needs as many samples."""
_FASTER: Final = 2.0
"""Speed between neighbours over the largest one across `_SAMPLES` intervals, above which stamps jitter [-]: no arm doubles its speed for
one sample. Of 600 recorded pushes with regular stamps 1 % are above it, of 44 with jitter more than three quarters, at 25 in the median."""


def regular_path(path: PusherPath) -> PusherPath:
    """The path at regular times, smoothed where its stamps jitter; otherwise the path itself.

    The smoothing spline takes the amount of noise from the samples (generalised cross-validation: Craven & Wahba, Smoothing noisy data with
    spline functions, Numerische Mathematik 1979).
    """
    time, position = path.time, path.position
    if path.yaw is not None or not stamps_jitter(time, position):
        return path
    from scipy.interpolate import make_smoothing_spline

    # The scale of the coordinate decides how well the penalty of the spline is conditioned.
    span = time[-1] - time[0]
    splines = [make_smoothing_spline((time - time[0]) / span, axis) for axis in position.T]
    regular = np.linspace(0.0, 1.0, len(time))
    smooth = np.column_stack([spline(regular) for spline in splines])
    return replace(path, time=time[0] + span * regular, position=smooth) if np.isfinite(smooth).all() else path


def stamps_jitter(time: Float64Array, position: Float64Array) -> bool:
    """Whether neighbouring samples, of shape (n,) [s] and (n, 2) [m], lie as far apart as only jitter of their stamps explains."""
    return len(time) > _SAMPLES and _fastest(time, position, 1) > _FASTER * _fastest(time, position, _SAMPLES)


def _fastest(time: Float64Array, position: Float64Array, n_intervals: int) -> float:
    """Largest speed over so many intervals [m/s]."""
    way = np.linalg.norm(position[n_intervals:] - position[:-n_intervals], axis=1)
    return float(np.max(way / (time[n_intervals:] - time[:-n_intervals])))
