"""The pinhole camera that a sensor_msgs/CameraInfo states: one reading for live messages, bags and calibration files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from push_ident.errors import FrameError
from push_ident.perception.frame.depth_image import check_intrinsics
from push_ident.types import CameraIntrinsics


@dataclass(frozen=True, slots=True)
class CameraInfoFields:
    """What of a camera info says how a rectified depth image was taken; lengths in pixels of the full resolution."""

    width: int
    height: int
    k: Sequence[float]
    """Camera matrix, 9 numbers by rows; of the image before rectification."""
    p: Sequence[float]
    """Projection matrix, 12 numbers by rows; of the rectified image. Zero or empty where nothing was rectified."""
    d: Sequence[float] = ()
    """Distortion of the image before rectification."""
    binning: tuple[int, int] = (1, 1)
    """Pixels that one pixel of the image stands for, along x and y."""
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)
    """Part of the full resolution that the image shows: x and y offset, width, height; no size for all of it."""

    @classmethod
    def of_message(cls, info: Any) -> CameraInfoFields:
        """Of a message of ROS 2, or of ROS 1, which has capital names."""
        k, p, d = (getattr(info, name) if hasattr(info, name) else getattr(info, name.upper()) for name in ("k", "p", "d"))
        roi = info.roi
        return cls(
            int(info.width),
            int(info.height),
            [float(value) for value in k],
            [float(value) for value in p],
            [float(value) for value in d],
            (max(int(info.binning_x), 1), max(int(info.binning_y), 1)),
            (int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)),
        )

    def intrinsics(self) -> CameraIntrinsics:
        """Of the image that was sent: P, or K where P is zero and nothing is distorted, within the region of interest and binned.

        Source: sensor_msgs/CameraInfo, and image_geometry/PinholeCameraModel, which adjusts P in this order.

        Raises FrameError: No size, no focal length, or a distortion that nothing has taken out.
        """
        if self.width <= 0 or self.height <= 0:
            raise FrameError(f"Camera info is for {self.width} x {self.height} pixels; the camera driver has not filled it.")
        is_rectified = len(self.p) == 12 and bool(np.any(np.asarray(self.p)[[0, 5]] != 0))
        if not is_rectified and np.any(np.abs(self.d) > 0):
            raise FrameError(
                f"Camera info has distortion {[round(float(d), 4) for d in self.d]} and no projection matrix P, so the depth image is not "
                "rectified; publish or record it through image_proc (rectify)."
            )
        if not is_rectified and len(self.k) != 9:
            raise FrameError(f"Camera info has a camera matrix of {len(self.k)} numbers, expected 9 by rows; calibrate the camera.")
        matrix = np.asarray(self.p).reshape(3, 4) if is_rectified else np.asarray(self.k).reshape(3, 3)
        x_offset, y_offset, roi_width, roi_height = self.roi
        width, height = (roi_width, roi_height) if roi_width and roi_height else (self.width, self.height)
        x, y = self.binning
        camera = CameraIntrinsics(
            width // x, height // y, matrix[0, 0] / x, matrix[1, 1] / y, (matrix[0, 2] - x_offset) / x, (matrix[1, 2] - y_offset) / y
        )
        check_intrinsics(camera)
        return camera


def intrinsics_of(info: Any) -> CameraIntrinsics:
    """Of the image that goes with a sensor_msgs/CameraInfo; as `CameraInfoFields.intrinsics`."""
    return CameraInfoFields.of_message(info).intrinsics()


def check_image_size(width: int, height: int, camera: CameraIntrinsics) -> None:
    """Refuse an image of another size than its camera info states, with binning and region of interest. Raises FrameError."""
    if (width, height) != (camera.width, camera.height):
        raise FrameError(
            f"Depth image is {width} x {height} pixels, its camera info is for {camera.width} x {camera.height}, binning and region of "
            "interest included; expected the same: record or publish the camera info of this very image."
        )
