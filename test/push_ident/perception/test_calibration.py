"""Extrinsics from the plane of the table and a mark."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.depth_scene import INTRINSICS, Prism, box, frames, look_at, rectangle, render
from push_ident.errors import InputError, PerceptionError
from push_ident.perception.calibration import Mark, calibrate, camera_over_table
from push_ident.types import DepthFrame

TRIANGLE = np.array([(0.0, 0.0), (0.15, 0.0), (0.0, 0.1)])
L_SHAPE = np.array([(0.0, 0.0), (0.14, 0.0), (0.14, 0.04), (0.05, 0.04), (0.05, 0.1), (0.0, 0.1)])
BOX = box(-0.2, 0.2, 0.06, 0.1, 0.05, 0.3)


@pytest.mark.parametrize(
    ("position", "target", "outline", "pose"),
    [
        ((0.3, -0.5, 0.8), (0.02, 0.0, 0.0), TRIANGLE, (-0.1, 0.03, -2.2)),
        ((-0.6, 0.2, 0.6), (0.0, 0.05, 0.0), L_SHAPE, (0.0, 0.1, 1.5)),
        ((0.01, 0.1, 1.1), (0.0, 0.05, 0.0), L_SHAPE, (0.0, 0.0, 3.0)),
    ],
)
def test_the_camera_pose_is_found_from_any_viewpoint(position, target, outline, pose):
    camera = look_at(position, target)
    found = calibrate(frames([Prism(outline, 0.03).at(pose), BOX], camera, 10, seed=1), Mark(outline, 0.03, pose))
    # What a point at the middle of the table seems to move, and the rotation between both frames.
    difference = found.camera_in_table @ np.linalg.inv(camera)
    assert np.linalg.norm(difference[:3, 3]) < 0.001
    assert np.arccos((np.trace(difference[:3, :3]) - 1) / 2) < np.deg2rad(0.4)
    assert found.outline_residual < 0.001 and abs(found.height_error) < 0.001 and found.n_frames == 10
    assert np.linalg.eigvalsh(found.covariance)[0] > 0


def test_the_table_is_found_without_any_guess_and_the_wall_is_not_taken_for_it():
    camera = look_at((0.7, 0.0, 0.5), (0.0, 0.0, 0.0))
    wall = Prism(rectangle(-0.52, -0.8, -0.5, 0.8), 0.5)
    found, noise, share = camera_over_table(render([BOX, wall], camera, rng=np.random.default_rng(0)))
    assert found[2, 3] == pytest.approx(0.5, abs=0.001)
    np.testing.assert_allclose(found[2, :3], camera[2, :3], atol=0.002)
    assert 0.0005 < noise < 0.004 and share > 0.4


@pytest.mark.parametrize(
    ("outline", "height", "why"),
    [
        (rectangle(-0.1, -0.05, 0.1, 0.05), 0.03, "heading is ambiguous"),
        (rectangle(0.0, 0.0, 0.1, 0.1), 0.03, "heading is ambiguous"),
        (TRIANGLE, 0.003, "0.02 m or more"),
        (TRIANGLE[:2], 0.03, "at least three"),
    ],
)
def test_a_mark_that_determines_no_pose_is_refused(outline, height, why):
    with pytest.raises(InputError, match=why):
        Mark(outline, height)


def test_nothing_like_the_mark_is_an_error_with_counts_and_never_a_guess():
    camera, mark = look_at((0.55, 0.0, 0.85), (0.0, 0.0, 0.0)), Mark(TRIANGLE, 0.03)
    same_area, too_high = Prism(rectangle(-0.0375, -0.05, 0.0375, 0.05), 0.03), Prism(TRIANGLE, 0.045)
    for prisms, why in (([], "None of 0 segments"), ([same_area], "differs from it by"), ([too_high], "mm in height")):
        with pytest.raises(PerceptionError, match=why):
            calibrate(frames(prisms, camera, 3, seed=2), mark)
    with pytest.raises(PerceptionError, match="0 valid"):
        camera_over_table(DepthFrame(0.0, np.full((480, 640), np.nan, np.float32), INTRINSICS))
