"""The compiled loops of perception against their definitions, and the input that they must never get."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER, INTRINSICS, render
from push_ident.errors import FrameError
from push_ident.geometry.arm_shape import Rod
from push_ident.perception.depth import points_in_table, rays_in_table
from push_ident.perception.kernels import Grid, compare_lines, interpolate, nearest_values
from push_ident.perception.labels import OBJECT, ROBOT, TABLE, UNKNOWN, Cylinder, in_robot, label_pixels
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.shape import TracedObject
from push_ident.perception.topdown import top_down
from push_ident.perception.tracking import Scene, Template, fit_pose
from push_ident.types import CellGrid, DepthFrame, ObjectShape

SETTINGS = PerceptionSettings()
POSE = np.array([0.02, -0.03, 0.6])
STEP = 0.001


@pytest.fixture(scope="module")
def field():
    """Distance to a circle of 30 mm, bilinear on a grid."""
    x, y = np.meshgrid(np.arange(-60, 61) * STEP, np.arange(-50, 51) * STEP)
    return Grid(np.hypot(x, y) - 0.03, np.array([-0.06, -0.05]), STEP)


@pytest.fixture(scope="module")
def lines():
    """Ends of lines of sight near the outline at POSE, and whether they are stopped."""
    rng = np.random.default_rng(0)
    upper = POSE[:2] + rng.uniform(-0.03, 0.03, size=(400, 2))
    return upper, upper + rng.normal(scale=0.002, size=upper.shape), (rng.random(400) < 0.5).astype(np.float64)


def test_distances_and_their_gradients_are_those_of_the_field(field):
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.045, 0.045, size=(200, 2))
    points = points[np.linalg.norm(points, axis=1) > 0.01]
    value, gradient = interpolate(field, points)
    assert np.abs(value - (np.linalg.norm(points, axis=1) - 0.03)).max() < 2e-5
    assert np.abs(gradient - points / np.linalg.norm(points, axis=1)[:, None]).max() < 0.1


def test_places_outside_a_grid_take_the_value_of_its_border(field):
    values = field.values
    outside = np.array([[9.0, 9.0], [-9.0, -9.0], [np.inf, -np.inf]])
    assert nearest_values(field, outside) == pytest.approx([values[-1, -1], values[0, 0], values[0, -1]])
    assert np.isfinite(nearest_values(field, np.array([[np.nan, 0.0]]))).all()
    at_border, _ = interpolate(field, np.array([[9.0, 0.0]]))
    assert at_border == pytest.approx([0.03], abs=1e-4)


def test_gradient_is_the_derivative_of_the_sum_of_squares(field, lines):
    def half_sum_of_squares(pose):
        return 0.5 * len(lines[0]) * compare_lines(field, *lines, pose, (0.006, 0.018, 0.003))[2]

    # Where the other end comes to decide there is a jump: both ends at one place.
    lines = (lines[0], lines[0].copy(), lines[2])
    pose = POSE + np.array([0.002, -0.001, 0.01])
    _, gradient, *_ = compare_lines(field, *lines, pose, (0.006, 0.018, 0.003))
    h = 1e-7
    by_difference = [(half_sum_of_squares(pose + h * axis) - half_sum_of_squares(pose - h * axis)) / (2 * h) for axis in np.eye(3)]
    assert -gradient == pytest.approx(by_difference, rel=1e-3, abs=1e-2)


def test_normal_matrix_and_shares_are_sums_over_the_lines(field, lines):
    upper, lower, stopped = lines
    whole = compare_lines(field, *lines, POSE, (0.006, 0.018, 0.003))
    parts = [compare_lines(field, upper[s], lower[s], stopped[s], POSE, (0.006, 0.018, 0.003)) for s in (slice(0, 150), slice(150, 400))]
    assert whole[0] == pytest.approx(parts[0][0] + parts[1][0])
    assert whole[1] == pytest.approx(parts[0][1] + parts[1][1])
    assert whole[2] == pytest.approx((150 * parts[0][2] + 250 * parts[1][2]) / 400)
    assert np.array_equal(whole[0], whole[0].T)
    nothing = compare_lines(field, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), POSE, (0.006, 0.018, 0.003))
    assert nothing[3:] == (1.0, 1.0)


def test_points_are_the_camera_centre_plus_depth_times_ray():
    frame = render([prism.at(POSE) for prism in HAMMER], rng=np.random.default_rng(0))
    centre, rays = rays_in_table(INTRINSICS, CAMERA)
    expected = centre.astype(np.float32) + rays * frame.depth[..., None]
    assert np.allclose(points_in_table(frame, CAMERA), expected, atol=1e-6, equal_nan=True)


def test_labels_follow_the_height_inside_the_workspace():
    settings = PerceptionSettings(workspace_low=(-1, -1), workspace_high=(1, 1), max_object_height=1)
    points = np.zeros((4, 60, 3), dtype=np.float32)
    columns = {0: (0.0, 0.0, TABLE), 10: (0.0, 0.05, OBJECT), 20: (0.0, 1.5, ROBOT), 30: (2.0, 0.05, TABLE), 40: (0.0, np.nan, UNKNOWN)}
    for first, (x, z, _) in columns.items():
        points[:, first : first + 10] = (x, 0.0, z)
    points[:, 50:] = (0.0, 0.0, -0.5)
    labels = label_pixels(points, (), settings)
    assert [labels[2, first + 5] for first in (*columns, 50)] == [*(label for *_, label in columns.values()), UNKNOWN]


def test_a_cylinder_is_open_upwards_and_a_rod_ends_on_both_sides():
    rod = Rod(np.array([0.0, 0.0, 0.1]), np.array([0.2, 0.0, 0.1]), 0.03)
    points = np.array(
        [[0.1, 0.029, 0.1], [0.1, 0.0, 0.135], [0.1, 0.0, 0.14], [0.204, 0.0, 0.1], [0.22, 0.0, 0.1], [np.nan] * 3], dtype=np.float32
    )
    assert in_robot(points, [rod], 0.006).tolist() == [True, True, False, True, False, False]
    tool = Cylinder(1.0, 1.0, 0.02, 0.05)
    points = np.array([[1.0, 1.025, 9.0], [1.0, 1.027, 9.0], [1.0, 1.0, 0.045], [1.0, 1.0, 0.04]], dtype=np.float32)
    assert in_robot(points.reshape(2, 2, 3), [rod, tool], 0.006).tolist() == [[True, False], [True, False]]
    assert not in_robot(points, [], 0.006).any()


def test_the_grid_holds_the_highest_point_of_the_object_and_leaves_out_what_is_beside_it():
    points = np.array([[[0.001, 0.001, 0.02], [0.0011, 0.001, 0.05], [0.001, 0.0012, 0.001], [5.0, 0.0, 0.3], [np.nan] * 3]], np.float32)
    labels = np.array([[OBJECT, OBJECT, TABLE, OBJECT, OBJECT]], dtype=np.int8)
    grid = top_down(points, labels, SETTINGS)
    assert np.nanmax(grid.height) == pytest.approx(0.05)
    assert np.count_nonzero(np.isfinite(grid.height)) == 1


def test_images_of_another_size_than_their_camera_are_refused_before_any_loop_over_pixels():
    square = 0.015 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    shape = ObjectShape(CellGrid(np.zeros((1, 2)), 0.03), square)
    traced = TracedObject(shape, np.zeros(3), np.full((3, 3), 0.03, np.float32), np.array([-0.01, -0.01]), 0.01)
    small = DepthFrame(0.0, np.ones((4, 4), np.float32), INTRINSICS)
    with pytest.raises(FrameError, match=r"shape \(4, 4\)"):
        fit_pose(Template(traced), Scene(small, CAMERA), np.zeros(3))
    with pytest.raises(FrameError, match="one image"):
        top_down(points_in_table(render([]), CAMERA), np.zeros((2, 2), np.int8), SETTINGS)
