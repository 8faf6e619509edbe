"""The compiled loops of perception against their definitions, and the input that they must never get."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, INTRINSICS
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.rod import Rod
from push_ident.perception.frame.occupancy import top_down
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.frame.view import OBJECT, ROBOT, TABLE, UNKNOWN, FrameView, in_robot, median_frame
from push_ident.perception.kernels import (
    Grid,
    compare_lines,
    edges_nearest,
    grow_surfaces,
    interpolate,
    mark_folds,
    mark_jumps,
    nearest_values,
    outline_distances,
)
from push_ident.perception.known_object import Template, TracedObject
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import CameraIntrinsics, CellGrid, DepthFrame, ObjectShape

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


def test_labels_follow_the_height_inside_the_workspace():
    # A camera 1 m above the table that looks straight down; columns from 50 on lie outside the workspace.
    down = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
    settings = PerceptionSettings(workspace_low=(-2, -2), workspace_high=(1, 2))
    columns = {0: (0.0, TABLE), 10: (0.05, OBJECT), 20: (0.7, ROBOT), 30: (np.nan, UNKNOWN), 40: (-0.5, UNKNOWN), 50: (0.05, TABLE)}
    depth = np.empty((4, 60), np.float32)
    for first, (height, _) in columns.items():
        depth[:, first : first + 10] = 1.0 - height
    labels = FrameView(DepthFrame(0.0, depth, CameraIntrinsics(60, 4, 20.0, 20.0, 29.5, 1.5)), down, settings=settings).labels
    assert [labels[2, first + 5] for first in columns] == [label for _, label in columns.values()]


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
    depth = np.ones((1, 5), np.float32)
    view = FrameView(DepthFrame(0.0, depth, CameraIntrinsics(5, 1, 20.0, 20.0, 2.0, 0.0)), CAMERA)
    grid = top_down(view.with_pixels(depth, points, labels))
    assert np.nanmax(grid.height) == pytest.approx(0.05)
    assert np.count_nonzero(np.isfinite(grid.height)) == 1


# Loops that replace arrays, against those arrays: equal to the last bit


def star(n=40, seed=2):
    """A polygon with corners that point inwards, edges of many lengths and one vertical and one horizontal edge."""
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0.0, 2 * np.pi, n))
    outline = rng.uniform(0.02, 0.1, n)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outline[5, 0], outline[9, 1] = outline[6, 0], outline[10, 1]
    return outline


def shifted(image, rows, columns):
    """The image moved by so many pixels; NaN where nothing moved to."""
    height, width = image.shape
    padded = np.pad(image.astype(np.float32), 9, constant_values=np.nan)
    return padded[9 - rows : 9 - rows + height, 9 - columns : 9 - columns + width]


@pytest.fixture(scope="module")
def steps():
    """Depth with steps and noise, and a mask with holes, shape (60, 70)."""
    rng = np.random.default_rng(4)
    depth = 0.8 + 0.03 * (rng.random((6, 7)) < 0.5).repeat(10, axis=0).repeat(10, axis=1) + rng.normal(scale=0.004, size=(60, 70))
    return depth.astype(np.float32), rng.random((60, 70)) < 0.9


@pytest.mark.parametrize("turned", [1, -1])
def test_distances_to_an_outline_are_those_of_geometry(turned):
    outline = np.ascontiguousarray(star()[::turned])
    points = np.vstack([np.random.default_rng(3).uniform(-0.12, 0.12, size=(3000, 2)), outline, 0.5 * (outline[:-1] + outline[1:])])
    assert np.array_equal(outline_distances(points, outline), signed_distance(points, outline))
    assert np.isnan(outline_distances(np.array([[np.nan, 0.0]]), outline)).all()


def test_the_nearest_edge_is_the_first_of_the_nearest():
    outline = star()
    points = np.vstack([np.random.default_rng(3).uniform(-0.12, 0.12, size=(3000, 2)), outline])
    edge = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(edge, axis=1)
    from_start = points[:, None] - outline
    along = np.sum(from_start * edge, axis=2) / length
    foot = np.clip(along, 0.0, length)
    nearest = np.argmin(np.linalg.norm(from_start - foot[..., None] * (edge / length[:, None]), axis=2), axis=1)
    index, position = edges_nearest(points, outline)
    assert np.array_equal(index, nearest)
    assert np.array_equal(position, along[np.arange(len(points)), nearest])


def test_jumps_are_marked_on_both_sides_at_both_distances(steps):
    depth, mask = steps
    masked = np.where(mask, depth, np.float32(np.nan))
    expected = np.zeros(mask.shape, dtype=bool)
    for rows in (-2, -1, 0, 1, 2):
        for columns in (-2, -1, 0, 1, 2):
            if abs(rows) == abs(columns) or 0 in (rows, columns):
                expected |= np.abs(shifted(masked, rows, columns) - masked) > 0.02
    assert np.array_equal(mark_jumps(depth, mask, 0.02), expected)
    assert 0 < np.count_nonzero(expected) < expected.size


def test_folds_lie_behind_a_chord_of_one_patch(steps):
    depth, mask = steps
    patches = np.where(mask, 1 + (np.arange(70) > 30), 0).astype(np.int32)
    inverse = np.where(mask, 1 / depth, np.float32(np.nan))
    legs = ((0, 3), (3, 0), (2, 2), (2, -2))
    expected = np.zeros(mask.shape, dtype=bool)
    for rows, columns in legs:
        chord = 2 / (shifted(inverse, rows, columns) + shifted(inverse, -rows, -columns))
        same = (shifted(patches, rows, columns) == patches) & (shifted(patches, -rows, -columns) == patches)
        expected |= same & (1 / inverse - chord > 0.01)
    assert np.array_equal(mark_folds(inverse, patches, legs, 0.01), expected)
    assert 0 < np.count_nonzero(expected) < np.count_nonzero(patches)


def test_surfaces_grow_by_rings_to_the_neighbour_nearest_in_depth(steps):
    depth, mask = np.round(steps[0] * 512) / np.float32(512), steps[1]  # so that neighbours are equally near
    seeds = np.zeros(mask.shape, dtype=np.int32)
    seeds[10:14, 8:12], seeds[10:14, 20:24], seeds[40:44, 40:44] = 1, 2, 3
    seeds[~mask] = 0
    expected = seeds.copy()
    while True:
        best, joined = np.full(mask.shape, 0.008, dtype=np.float32), np.zeros(mask.shape, dtype=np.int32)
        for rows, columns in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            number = np.nan_to_num(shifted(expected, rows, columns)).astype(np.int32)
            difference = np.abs(shifted(depth, rows, columns) - depth)
            nearer = mask & (expected == 0) & (number > 0) & (difference < best)
            best[nearer], joined[nearer] = difference[nearer], number[nearer]
        if not joined.any():
            break
        expected[joined > 0] = joined[joined > 0]
    assert np.array_equal(grow_surfaces(seeds, depth, mask, 0.008), expected)
    assert np.count_nonzero(expected) > 3 * np.count_nonzero(seeds)


@pytest.mark.parametrize("n_frames", [1, 2, 5, 10])
def test_the_median_of_frames_is_that_of_the_measured_values(n_frames):
    rng = np.random.default_rng(n_frames)
    depth = rng.uniform(0.5, 1.0, (n_frames, INTRINSICS.height, INTRINSICS.width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.4] = np.nan
    rare = 2 * np.count_nonzero(np.isfinite(depth), axis=0) < n_frames
    with np.errstate(invalid="ignore"):
        expected = np.nanmedian(np.where(rare, np.float32(0.0), depth), axis=0)
    median = median_frame([DepthFrame(0.0, image, INTRINSICS) for image in depth])
    assert np.array_equal(median.depth, np.where(rare, np.float32(np.nan), expected), equal_nan=True)


def test_the_field_of_a_template_is_exact_near_the_outline_and_linear_between_every_fourth_node_further_out():
    outline = star()
    traced = TracedObject(
        ObjectShape(CellGrid(np.zeros((1, 2)), 0.03), outline), np.zeros(3), np.full((3, 3), 0.03, np.float32), outline[0], 0.1
    )
    field = Template(traced).field
    rows, columns = field.values.shape
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    exact = signed_distance((field.origin + field.step * np.stack([x, y], axis=-1)).reshape(-1, 2), outline).reshape(rows, columns)
    along_x = np.array([np.interp(np.arange(columns), np.arange(0, columns, 4), row) for row in exact[::4, ::4]])
    linear = np.array([np.interp(np.arange(rows), np.arange(0, rows, 4), column) for column in along_x.T]).T
    assert np.array_equal(field.values, np.where(np.abs(linear) < 0.012, exact, linear))
