"""The pinhole camera of a camera info: one reading, whatever the message came by."""

from __future__ import annotations

from dataclasses import replace

import pytest
from sensor_msgs.msg import CameraInfo, RegionOfInterest

from push_ident.errors import FrameError
from push_ident.perception.frame.camera_info import CameraInfoFields, intrinsics_of
from push_ident.types import CameraIntrinsics

K = [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0]
P = [580.0, 0.0, 316.0, 0.0, 0.0, 582.0, 238.0, 0.0, 0.0, 0.0, 1.0, 0.0]
RAW = CameraInfoFields(640, 480, K, [0.0] * 12)


def test_the_rectified_image_has_the_projection_matrix_and_a_raw_one_without_distortion_the_camera_matrix() -> None:
    assert replace(RAW, p=P, d=[0.1, -0.2]).intrinsics() == CameraIntrinsics(640, 480, 580.0, 582.0, 316.0, 238.0)
    assert RAW.intrinsics() == CameraIntrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    with pytest.raises(FrameError, match="distortion.*rectify"):
        replace(RAW, d=[0.1, -0.2]).intrinsics()
    with pytest.raises(FrameError, match="matrix of 4 numbers, expected 9"):
        replace(RAW, k=K[:4]).intrinsics()
    with pytest.raises(FrameError, match="not filled"):
        replace(RAW, width=0).intrinsics()


def test_binning_and_region_of_interest_are_applied_in_this_order() -> None:
    part = replace(RAW, roi=(100, 60, 400, 300), binning=(2, 2))
    assert part.intrinsics() == CameraIntrinsics(200, 150, 300.0, 300.0, 110.0, 90.0)


def test_a_message_is_read_with_all_of_it() -> None:
    roi = RegionOfInterest(x_offset=100, y_offset=60, width=400, height=300)
    info = CameraInfo(width=640, height=480, k=K, p=P, d=[0.1], binning_x=2, binning_y=0, roi=roi)
    assert intrinsics_of(info) == CameraIntrinsics(200, 300, 290.0, 582.0, 108.0, 178.0)
