"""Whatever frames come, perception gives what keeps its promises or refuses, and is as before once frames are right again."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import example, given

from helpers.depth_scene import CAMERA, HAMMER, look_at, rectangle, render
from helpers.depth_scene import Prism as Thing
from helpers.fuzzing import fuzzed
from helpers.fuzzing.frames import Step, changed, sequences
from push_ident.errors import PushIdentError
from push_ident.geometry.shape_check import check_shape
from push_ident.limits import LIMITS
from push_ident.perception.observation import Observation
from push_ident.perception.pipeline import Perception
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import CameraIntrinsics, DepthFrame, Float64Array

SMALL = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
SETTINGS = PerceptionSettings(rest_frames=3)
"""Fewer frames at rest than a cell has, so that changed frames come before, during and after an object is taken in."""
AT_REST = (0.0, -0.05, 0.4)
N_RIGHT = 12
"""Right frames at the end, 0.3 s apart: the plane is checked three times, and what is lost is searched for in each other frame."""
SAME_PLACE = 0.02
"""An object that is found again lies this near to where it is without changed frames [m]: about half its width."""
SAME_PLANE = 0.004
"""The table is as near to where it is without them, at a corner of the workspace [m]; perception replaces it from 1.5 mm on."""


@cache
def views() -> tuple[np.ndarray, ...]:
    """Depth images [m]: four of a hammer at rest, of the hammer on its way, and of it from a camera that was touched."""
    rng = np.random.default_rng(0)
    poses = [AT_REST] * 4 + [(0.02, -0.05, 0.5), (0.06, -0.04, 0.7), (0.1, -0.03, 1.0)]
    images = [render([prism.at(pose) for prism in HAMMER], rng=rng, intrinsics=SMALL).depth for pose in poses]
    at_rest = [prism.at(AT_REST) for prism in HAMMER]
    touched = [look_at(CAMERA[:3, 3] + by, (0.0, 0.0, 0.0)) for by in np.array([(0.03, 0.0, 0.02), (-0.2, 0.3, 0.1)])]
    return (*images, *(render(at_rest, camera, rng=rng, intrinsics=SMALL).depth for camera in touched))


@cache
def another_scene() -> np.ndarray:
    """Depth of the same table with other things on it [m]."""
    box = Thing(rectangle(-0.05, -0.03, 0.05, 0.03), 0.06)
    return render([box.at((0.05, 0.2, 1.0)), *(prism.at((-0.15, 0.0, 2.0)) for prism in HAMMER)], intrinsics=SMALL).depth


def observe_right_frames(perception: Perception, stamp: float) -> list[Observation]:
    return [perception.observe(DepthFrame(stamp + 0.3 * n, views()[n % 4], SMALL)) for n in range(N_RIGHT)]


def places(observation: Observation) -> list[Float64Array]:
    """Of the objects that are tracked [m]."""
    return [known.pose[:2] for known in observation.objects if known.pose is not None]


@cache
def without_changes() -> tuple[Float64Array, list[Float64Array]]:
    """Pose of the camera, and places of the objects, after right frames only."""
    perception = Perception(CAMERA, SETTINGS)
    return perception.camera_in_table, places(observe_right_frames(perception, 0.0)[-1])


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
@fuzzed(25)
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
    for place in expected:
        assert any(np.linalg.norm(place - found) < SAME_PLACE for found in places(last)), places(last)
