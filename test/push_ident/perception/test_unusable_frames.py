"""Frames that no camera should send: each is refused or taken, and perception goes on. All were found by fuzzing."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER, render
from push_ident.errors import FrameError, PerceptionError
from push_ident.perception.frame.depth_image import check_intrinsics, usable_frame
from push_ident.perception.pipeline import Perception
from push_ident.perception.search.segments import split_surfaces
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import CameraIntrinsics, DepthFrame

SMALL = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)


@pytest.fixture(scope="module")
def frames() -> list[DepthFrame]:
    rng = np.random.default_rng(0)
    prisms = [prism.at((0.0, 0.0, 0.3)) for prism in HAMMER]
    return [render(prisms, CAMERA, rng=rng, stamp=0.3 * k, intrinsics=SMALL) for k in range(8)]


def with_object(frames: list[DepthFrame]) -> Perception:
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=3))
    found = [name for frame in frames[:5] for name in perception.observe(frame).new_shapes]
    assert found == ["o1"]
    return perception


def test_what_is_no_depth_counts_as_not_measured(frames: list[DepthFrame]) -> None:
    unmeasured, other = frames[0].depth.copy(), frames[0].depth.astype(np.float64)
    for row, value in enumerate((np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300)):
        unmeasured[40 * row : 40 * row + 20], other[40 * row : 40 * row + 20] = np.nan, value
    cleaned = usable_frame(replace(frames[0], depth=np.asfortranarray(other)))
    np.testing.assert_array_equal(cleaned.depth, unmeasured)
    assert cleaned.depth.dtype == np.float32 and cleaned.depth.flags.c_contiguous
    assert usable_frame(frames[0]) is frames[0]
    of_both = [Perception(CAMERA).observe(replace(frames[0], depth=depth)) for depth in (unmeasured, other)]
    assert of_both[0].counts == of_both[1].counts


@pytest.mark.parametrize(
    "wrong",
    [{"fx": 1e300}, {"fy": 1e9}, {"fx": 1e-9}, {"cx": 1e6}, {"cy": -1e300}, {"fx": 12.0}],
    ids=str,
)
def test_intrinsics_of_no_camera_are_refused(frames: list[DepthFrame], wrong: dict[str, float]) -> None:
    perception = Perception(CAMERA)
    with pytest.raises(FrameError, match="calibrate the camera"):
        perception.observe(replace(frames[0], intrinsics=replace(SMALL, **wrong)))
    assert perception.observe(frames[1]).counts["table"] > 0


def test_wide_narrow_and_cropped_cameras_are_accepted() -> None:
    check_intrinsics(CameraIntrinsics(512, 512, 120.0, 120.0, 255.5, 255.5))  # 130 degrees
    check_intrinsics(CameraIntrinsics(640, 480, 2e4, 2e4, 319.5, 239.5))  # 2 degrees
    check_intrinsics(CameraIntrinsics(100, 100, 640.0, 640.0, -540.0, -260.0))  # the corner of a larger image


@pytest.mark.parametrize("factor", [1e-3, 1e-6, 1e-30, 1e-44, 1e3])
def test_depth_in_a_wrong_unit_is_survived_while_an_object_is_followed(frames: list[DepthFrame], factor: float) -> None:
    perception = with_object(frames)
    for k, frame in enumerate(frames[5:7]):
        around = frame.depth.copy()
        around[110:115, 150:155] = np.nan  # as a shadow: how far it reaches depends on the depth
        around[60:] *= np.float32(factor)
        for n, depth in enumerate((np.asarray(frame.depth * np.float32(factor)), around)):
            try:
                perception.observe(replace(frame, depth=depth, stamp=2.0 + k + 0.3 * n))
            except (FrameError, PerceptionError):
                continue
    for n in range(8):
        observation = perception.observe(replace(frames[n], stamp=10.0 + 0.3 * n))
    assert observation.why_no_pose() == ""


def test_a_camera_that_changes_its_resolution_or_focal_length_begins_the_rest_anew(frames: list[DepthFrame]) -> None:
    half = CameraIntrinsics(160, 120, 150.0, 150.0, 79.75, 59.75)
    for changed in (DepthFrame(0.6, frames[2].depth[::2, ::2], half), replace(frames[2], intrinsics=replace(SMALL, fx=301.0))):
        perception = Perception(CAMERA, PerceptionSettings(rest_frames=3))
        sequence = [*frames[:2], changed, *frames[3:6]]
        assert [bool(perception.observe(frame).new_shapes) for frame in sequence] == [False] * 5 + [True]


def test_a_noisy_first_frame_does_not_hide_the_low_parts_of_an_object(frames: list[DepthFrame]) -> None:
    """A plane fitted to it allows no object lower than 24 mm: the handle of the hammer has 25 mm, with noise."""
    rng = np.random.default_rng(1)
    noise = 0.006 * rng.standard_normal(frames[0].depth.shape, dtype=np.float32)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=3))
    perception.observe(replace(frames[0], depth=frames[0].depth + noise))
    assert perception.plane is not None and perception.plane.least_height > 0.015
    shapes = [shape for frame in frames[1:] for shape in perception.observe(frame).new_shapes.values()]
    assert perception.plane.least_height < 0.009
    assert len(shapes) == 1 and np.ptp(shapes[0].outline, axis=0).max() > 0.17


def test_a_table_that_was_far_from_its_place_in_the_first_frame_is_found_in_its_place(frames: list[DepthFrame]) -> None:
    """Tilted by nearly as much as extrinsics may be wrong, and the other way round after that: more from one to the other."""
    turned = [cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0] for angle in (0.05, -0.05)]
    cameras = []
    for rotation in turned:
        camera = CAMERA.copy()
        camera[:3, :3], camera[:3, 3] = rotation @ CAMERA[:3, :3], rotation @ CAMERA[:3, 3]
        cameras.append(camera)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=3))
    for number, camera in enumerate([cameras[0], cameras[1], cameras[1]]):
        perception.observe(render([], camera, rng=np.random.default_rng(number), stamp=1.1 * number, intrinsics=SMALL))
    np.testing.assert_allclose(perception.camera_in_table[:3, :3], cameras[1][:3, :3], atol=0.003)


@pytest.mark.parametrize("depth", [1e-30, 1e-6])
def test_surfaces_at_no_distance_are_divided_in_bounded_time(depth: float) -> None:
    image = np.full((40, 50), depth, dtype=np.float32)
    divided = split_surfaces(image, np.ones(image.shape, dtype=bool), 600.0, 0.02)
    assert divided.shape == image.shape and divided.min() >= 0
