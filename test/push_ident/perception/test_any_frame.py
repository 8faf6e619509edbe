"""Whatever frames come, perception gives what keeps its promises or refuses, and is as before once frames are right again."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import example, given

from helpers.depth_scene import CAMERA, SMALL, box, hammer, look_at, render
from helpers.fuzzing import fuzzed
from helpers.fuzzing.frames import Step, changed, sequences
from push_ident.errors import FrameError, PushIdentError
from push_ident.geometry.shape_check import check_shape
from push_ident.limits import LIMITS
from push_ident.perception.frame.depth_image import check_intrinsics, depth_from_buffer, usable_frame
from push_ident.perception.observation import Observation
from push_ident.perception.pipeline import Perception
from push_ident.perception.search.segments import split_surfaces
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import CameraIntrinsics, DepthFrame, Float64Array

SETTINGS = PerceptionSettings(rest_frames=3)


@pytest.fixture(scope="module")
def frames() -> list[DepthFrame]:
    rng = np.random.default_rng(0)
    return [render(hammer((0.0, 0.0, 0.3)), CAMERA, rng=rng, stamp=0.3 * k, intrinsics=SMALL) for k in range(8)]


def test_millimetres_become_metres_and_what_is_no_depth_unknown() -> None:
    raw = np.array([[1234, 0, 999], [40, 65535, 1]], dtype="<u2")
    depth = depth_from_buffer("16UC1", 2, 3, 6, False, raw.tobytes())
    np.testing.assert_allclose(depth, [[1.234, np.nan, 0.999], [0.04, 65.535, 0.001]], rtol=1e-6)
    assert np.array_equal(depth, depth_from_buffer("16UC1", 2, 3, 6, True, raw.astype(">u2").tobytes()), equal_nan=True)
    padded = np.hstack([raw, np.full((2, 1), 7777, "<u2")])
    assert np.array_equal(depth, depth_from_buffer("16UC1", 2, 3, 8, False, padded.tobytes()), equal_nan=True)
    metres = np.array([[0.7, np.nan, np.inf, -np.inf, 0.0, -1.0]], dtype="<f4")
    np.testing.assert_array_equal(depth_from_buffer("32FC1", 1, 6, 24, False, metres.tobytes()), np.float32([[0.7] + [np.nan] * 5]))


def test_what_is_no_depth_counts_as_not_measured(frames: list[DepthFrame]) -> None:
    unmeasured, other = frames[0].depth.copy(), frames[0].depth.astype(np.float64)
    for row, value in enumerate((np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300)):
        unmeasured[40 * row : 40 * row + 20], other[40 * row : 40 * row + 20] = np.nan, value
    cleaned = usable_frame(replace(frames[0], depth=np.asfortranarray(other)))
    np.testing.assert_array_equal(cleaned.depth, unmeasured)
    assert cleaned.depth.dtype == np.float32 and cleaned.depth.flags.c_contiguous and usable_frame(frames[0]) is frames[0]
    of_both = [Perception(CAMERA).observe(replace(frames[0], depth=depth)) for depth in (unmeasured, other)]
    assert of_both[0].counts == of_both[1].counts


@pytest.mark.parametrize("wrong", [{"fx": 1e300}, {"fy": 1e9}, {"fx": 1e-9}, {"cx": 1e6}, {"cy": -1e300}, {"fx": 12.0}], ids=str)
def test_intrinsics_of_no_camera_are_refused(frames: list[DepthFrame], wrong: dict[str, float]) -> None:
    perception = Perception(CAMERA)
    with pytest.raises(FrameError, match="calibrate the camera"):
        perception.observe(replace(frames[0], intrinsics=replace(SMALL, **wrong)))
    assert perception.observe(frames[1]).counts["table"] > 0


def test_wide_narrow_and_cropped_cameras_are_accepted() -> None:
    check_intrinsics(CameraIntrinsics(512, 512, 120.0, 120.0, 255.5, 255.5))  # 130 degrees
    check_intrinsics(CameraIntrinsics(640, 480, 2e4, 2e4, 319.5, 239.5))  # 2 degrees
    check_intrinsics(CameraIntrinsics(100, 100, 640.0, 640.0, -540.0, -260.0))  # the corner of a larger image


def test_a_camera_that_changes_its_resolution_or_focal_length_begins_the_rest_anew(frames: list[DepthFrame]) -> None:
    half = CameraIntrinsics(160, 120, 150.0, 150.0, 79.75, 59.75)
    for other in (DepthFrame(0.6, frames[2].depth[::2, ::2], half), replace(frames[2], intrinsics=replace(SMALL, fx=301.0))):
        perception = Perception(CAMERA, SETTINGS)
        sequence = [*frames[:2], other, *frames[3:6]]
        assert [bool(perception.observe(frame).new_shapes) for frame in sequence] == [False] * 5 + [True]


def test_a_noisy_first_frame_does_not_hide_the_low_parts_of_an_object(frames: list[DepthFrame]) -> None:
    """A plane fitted to it allows no object lower than 24 mm: the handle of the hammer has 25 mm, with noise."""
    noise = 0.006 * np.random.default_rng(1).standard_normal(frames[0].depth.shape, dtype=np.float32)
    perception = Perception(CAMERA, SETTINGS)
    perception.observe(replace(frames[0], depth=frames[0].depth + noise))
    assert perception.plane is not None and perception.plane.least_height > 0.015
    shapes = [shape for frame in frames[1:] for shape in perception.observe(frame).new_shapes.values()]
    assert perception.plane.least_height < 0.009 and len(shapes) == 1 and np.ptp(shapes[0].outline, axis=0).max() > 0.17


@pytest.mark.parametrize("depth", [1e-30, 1e-6])
def test_surfaces_at_no_distance_are_divided_in_bounded_time(depth: float) -> None:
    image = np.full((40, 50), depth, dtype=np.float32)
    divided = split_surfaces(image, np.ones(image.shape, dtype=bool), 600.0, 0.02)
    assert divided.shape == image.shape and divided.min() >= 0


AT_REST = (0.0, -0.05, 0.4)
N_RIGHT = 9
"""Right frames at the end, 0.3 s apart: the plane is checked twice, and what is lost is searched for in each other frame."""
SAME_PLACE = 0.02
"""An object that is found again lies this near to where it is without changed frames [m]: about half its width."""
SAME_PLANE = 0.004
"""The table is as near to where it is without them, at a corner of the workspace [m]; perception replaces it from 1.5 mm on."""


@cache
def views() -> tuple[np.ndarray, ...]:
    """Depth images [m]: four of a hammer at rest, of the hammer on its way, and of it from a camera that was touched."""
    rng = np.random.default_rng(0)
    poses = [AT_REST] * 4 + [(0.02, -0.05, 0.5), (0.06, -0.04, 0.7), (0.1, -0.03, 1.0)]
    images = [render(hammer(pose), rng=rng, intrinsics=SMALL).depth for pose in poses]
    touched = [look_at(CAMERA[:3, 3] + by, (0.0, 0.0, 0.0)) for by in np.array([(0.03, 0.0, 0.02), (-0.2, 0.3, 0.1)])]
    return (*images, *(render(hammer(AT_REST), camera, rng=rng, intrinsics=SMALL).depth for camera in touched))


@cache
def another_scene() -> np.ndarray:
    """Depth of the same table with other things on it [m]."""
    return render([box(0.05, 0.2, 0.1, 0.06, 0.06, 1.0), *hammer((-0.15, 0.0, 2.0))], intrinsics=SMALL).depth


def observe_right_frames(perception: Perception, stamp: float) -> list[Observation]:
    return [perception.observe(DepthFrame(stamp + 0.3 * n, views()[n % 4], SMALL)) for n in range(N_RIGHT)]


def positions_in(observation: Observation) -> list[Float64Array]:
    """Of the objects that are tracked [m]."""
    return [known.pose[:2] for known in observation.objects if known.pose is not None]


@cache
def without_changes() -> tuple[Float64Array, list[Float64Array]]:
    """Pose of the camera, and positions of the objects, after right frames only."""
    perception = Perception(CAMERA, SETTINGS)
    return perception.camera_in_table, positions_in(observe_right_frames(perception, 0.0)[-1])


def check_observation(observation: Observation) -> None:
    """Poses, shapes, refusals and the grid are what messages can hold."""
    for known in observation.objects:
        assert (known.pose is None) == (known.covariance is None) == (known.status.name != "TRACKED")
        if known.pose is not None and known.covariance is not None:
            assert np.isfinite(known.pose).all() and np.abs(known.pose[:2]).max() <= LIMITS.COORDINATE.value
            assert np.allclose(known.covariance, known.covariance.T, rtol=1e-9) and np.linalg.eigvalsh(known.covariance)[0] > 0
    for shape in observation.new_shapes.values():
        check_shape(shape)
        assert np.isfinite(shape.outline).all() and np.isfinite(shape.cells.centres).all()
        assert len(shape.outline) <= LIMITS.VERTICES.value and len(shape.cells) <= LIMITS.CELLS.value
    for refusal in observation.refused:
        assert len(refusal.outline) and np.isfinite(refusal.outline).all() and math.isfinite(refusal.height) and refusal.why
    if observation.occupancy is not None:
        grid = observation.occupancy
        assert np.isfinite(grid.origin).all() and grid.occupancy.min() >= -1 and grid.occupancy.max() <= 100
    assert min(observation.counts.values()) >= 0


@pytest.mark.fuzz
@fuzzed(8)
@example([Step(0, 0.3, (("tilt", 305551645), ("size", 32093711)))])  # searched in an image of another size than the plane's
@example([Step(6, 1.1, (("shift", 2079943545),))])  # the table stayed 41 mm from its place
@example([Step(8, 1.1, (("stamp", 1603259711),)), Step(2, 1.1, (("shift", 705272279), ("block", 1343022949)))])  # outline crossed itself
@given(sequences(9))
def test_any_frames_are_taken_or_refused_and_right_ones_are_taken_again(steps: list[Step]) -> None:
    perception, now = Perception(CAMERA, SETTINGS), 1000.0
    for step in steps:
        now += step.gap
        frame = DepthFrame(now, views()[step.view], SMALL)
        for name, seed in step.changes:
            frame = changed(frame, name, seed, another_scene())
        try:
            check_observation(perception.observe(frame))
        except PushIdentError as error:
            assert str(error)
        rotation = perception.camera_in_table[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.isfinite(perception.camera_in_table).all()
    last = observe_right_frames(perception, now + 0.3)[-1]
    camera, expected = without_changes()
    (x0, y0), (x1, y1) = SETTINGS.workspace_low, SETTINGS.workspace_high
    corners = np.array([(x, y, 0.0, 1.0) for x in (x0, x1) for y in (y0, y1)])
    heights = (corners @ (perception.camera_in_table @ np.linalg.inv(camera)).T)[:, 2]
    assert np.abs(heights).max() < SAME_PLANE
    for position in expected:
        assert any(np.linalg.norm(position - found) < SAME_PLACE for found in positions_in(last))
