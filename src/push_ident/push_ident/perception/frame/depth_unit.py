"""Whether depths came in another unit than they were taken for: the table is then seen at a multiple of its depth by the camera pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.perception.frame.view import STRIDE, FrameView
from push_ident.types import DepthFrame, Float64Array

_UNITS: Final = (1e-4, 1.25e-4, 2e-4, 2.5e-4, 1e-3, 1e-2, 1.0)
"""Of depth images [m]: REP 118 (millimetres, metres), RealSense (D405 0.1 mm, SR300 0.125 mm, L515 0.25 mm), TUM RGB-D (0.2 mm), and cm."""
_NEAR: Final = 0.04
"""Relative difference of a depth that an error of the pose makes [-]: 30 mm at 0.75 m. The nearest two units differ by a fifth."""
_MIN_SHARE: Final = 0.15
"""Least fraction of the depths that lie on the table."""


@dataclass(frozen=True, slots=True)
class WrongUnit:
    """The unit of depths that were taken for another one."""

    factor: float
    """Depth that was read over the depth that is [-]."""
    unit: float
    """Metres per unit of the image."""

    def __str__(self) -> str:
        times, size = max(self.factor, 1.0 / self.factor), "large" if self.factor > 1.0 else "small"
        return f"the depth is {times:.1f} times too {size}: its unit is {1e3 * self.unit:g} mm"


def wrong_unit(frame: DepthFrame, camera_in_table: Float64Array) -> WrongUnit | None:
    """The unit in which a table at z = 0 is where the pose of the camera, shape (4, 4), says; None: the one in use, or none."""
    centre, rays = FrameView(frame, camera_in_table).rays
    down = -rays[::STRIDE, ::STRIDE, 2].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = frame.depth[::STRIDE, ::STRIDE] * down / centre[2]
    ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
    if not len(ratio):
        return None
    near = {unit: np.abs(ratio * unit / frame.unit - 1.0) < _NEAR for unit in {*_UNITS, frame.unit}}
    best = max(near, key=lambda unit: (np.count_nonzero(near[unit]), unit == frame.unit))
    if best == frame.unit or float(np.mean(near[best])) < _MIN_SHARE:
        return None
    return WrongUnit(float(np.median(ratio[near[best]])), best)
