"""The compiled loops of perception against their definitions, and the input that they must never get."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.depth_scene import INTRINSICS
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.rod import Rod
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.frame.view import OBJECT, ROBOT, TABLE, UNKNOWN, FrameView, in_robot, median_frame
from push_ident.perception.kernels import Grid, compare_lines, interpolate, nearest_values, outline_distances
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import CameraIntrinsics, DepthFrame

POSE = np.array([0.02, -0.03, 0.6])
STEP = 0.001


@pytest.fixture(scope="module")
def field():
    """Distance to a circle of 30 mm, bilinear on a grid."""
    x, y = np.meshgrid(np.arange(-60, 61) * STEP, np.arange(-50, 51) * STEP)
    return Grid(np.hypot(x, y) - 0.03, np.array([-0.06, -0.05]), STEP)


def test_values_of_a_grid_are_those_of_the_field_inside_and_of_the_border_outside(field):
    points = np.random.default_rng(1).uniform(-0.045, 0.045, size=(200, 2))
    radius = np.linalg.norm(points, axis=1)
    points, radius = points[radius > 0.01], radius[radius > 0.01]
    value, gradient = interpolate(field, points)
    assert np.abs(value - (radius - 0.03)).max() < 2e-5 and np.abs(gradient - points / radius[:, None]).max() < 0.1
    outside = np.array([[9.0, 9.0], [-9.0, -9.0], [np.inf, -np.inf]])
    assert nearest_values(field, outside) == pytest.approx(field.values[[-1, 0, 0], [-1, 0, -1]])
    assert np.isfinite(nearest_values(field, np.array([[np.nan, 0.0]]))).all()
    assert interpolate(field, np.array([[9.0, 0.0]]))[0] == pytest.approx([0.03], abs=1e-4)


@pytest.mark.parametrize("displaced", [0.0, 2e-3])
def test_gradient_is_the_derivative_of_the_sum_of_squares(field, displaced):
    rng = np.random.default_rng(0)
    ends, stopped = POSE[:2] + rng.uniform(-0.03, 0.03, size=(400, 2)), (rng.random(400) < 0.5).astype(np.float64)

    def compared(pose):  # both ends of a line at one position: where the other end comes to decide there is a jump
        _, gradient, mean_square, *_ = compare_lines(
            field, ends, ends.copy(), stopped, pose, (0.006, 0.018, 0.003), np.array([0.5, 0.2, displaced, 1e9])
        )
        return gradient, 0.5 * len(ends) * mean_square

    pose, h = POSE + np.array([0.002, -0.001, 0.01]), 1e-7
    by_difference = [(compared(pose + h * axis)[1] - compared(pose - h * axis)[1]) / (2 * h) for axis in np.eye(3)]
    assert -compared(pose)[0] == pytest.approx(by_difference, rel=1e-3, abs=1e-2)


def test_labels_follow_the_height_inside_the_workspace():
    # A camera 1 m above the table that looks straight down; columns from 50 on lie outside the workspace.
    down = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
    settings = PerceptionSettings(workspace_low=(-2, -2), workspace_high=(1, 2))
    strips = [(0.0, TABLE), (0.05, OBJECT), (0.7, ROBOT), (np.nan, UNKNOWN), (-0.5, UNKNOWN), (0.05, TABLE)]
    depth = np.tile(1.0 - np.repeat([height for height, _ in strips], 10), (4, 1)).astype(np.float32)
    labels = FrameView(DepthFrame(0.0, depth, CameraIntrinsics(60, 4, 20.0, 20.0, 29.5, 1.5)), down, settings=settings).labels
    assert labels[2, 5::10].tolist() == [label for _, label in strips]


def test_a_cylinder_is_open_upwards_and_a_rod_ends_on_both_sides():
    robot = [Rod(np.array([0.0, 0.0, 0.1]), np.array([0.2, 0.0, 0.1]), 0.03), Cylinder(1.0, 1.0, 0.02, 0.05)]
    inside = [[0.1, 0.029, 0.1], [0.1, 0.0, 0.135], [0.204, 0.0, 0.1], [1.0, 1.025, 9.0], [1.0, 1.0, 0.045]]
    outside = [[0.1, 0.0, 0.14], [0.22, 0.0, 0.1], [np.nan] * 3, [1.0, 1.027, 9.0], [1.0, 1.0, 0.04]]
    assert in_robot(np.array([inside, outside], dtype=np.float32), robot, 0.006).tolist() == [[True] * 5, [False] * 5]


# Loops that replace arrays, against those arrays: equal to the last bit


@pytest.mark.parametrize("turned", [1, -1])
def test_distances_to_an_outline_are_those_of_geometry(turned):
    """A polygon with corners that point inwards, edges of many lengths and one vertical and one horizontal edge."""
    rng = np.random.default_rng(2)
    angle = np.sort(rng.uniform(0.0, 2 * np.pi, 40))
    star = rng.uniform(0.02, 0.1, 40)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    star[5, 0], star[9, 1] = star[6, 0], star[10, 1]
    outline = np.ascontiguousarray(star[::turned])
    points = np.vstack([rng.uniform(-0.12, 0.12, size=(3000, 2)), outline, 0.5 * (outline[:-1] + outline[1:])])
    assert np.array_equal(outline_distances(points, outline), signed_distance(points, outline))
    assert np.isnan(outline_distances(np.array([[np.nan, 0.0]]), outline)).all()


@pytest.mark.parametrize("n_frames", [2, 5])
def test_the_median_of_frames_is_that_of_the_measured_values(n_frames):
    rng = np.random.default_rng(n_frames)
    depth = rng.uniform(0.5, 1.0, (n_frames, INTRINSICS.height, INTRINSICS.width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.4] = np.nan
    rare = 2 * np.count_nonzero(np.isfinite(depth), axis=0) < n_frames
    expected = np.where(rare, np.float32(np.nan), np.nanmedian(np.where(rare, np.float32(0.0), depth), axis=0))
    median = median_frame([DepthFrame(0.0, image, INTRINSICS) for image in depth])
    assert np.array_equal(median.depth, expected, equal_nan=True)
