"""Names of the coordinate frames."""

from __future__ import annotations

from typing import Final

TABLE_FRAME: Final = "table"
CAMERA_FRAME: Final = "camera_depth_optical_frame"


def object_frame(object_id: str) -> str:
    """Name of the frame fixed in an object."""
    return f"object_{object_id}"
