"""Names of the coordinate frames, and of axes."""

from __future__ import annotations

from typing import Final

import numpy as np

from push_ident.types import Float64Array

TABLE_FRAME: Final = "table"
CAMERA_FRAME: Final = "camera_depth_optical_frame"


def object_frame(object_id: str) -> str:
    """Name of the frame fixed in an object."""
    return f"object_{object_id}"


def axes_text(rotation: Float64Array) -> str:
    """Axes of a frame, by name, that are x, y and z of another: `x,-z,y` for the rotation, shape (3, 3), that makes y of -z and z of y."""
    return ",".join(("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in rotation)
