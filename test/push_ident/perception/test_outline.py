"""Outlines: how well the position of an edge is known, for every sensor model; straight edges, sharp corners, and round ones."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from helpers.depth_scene import rectangle
from push_ident.geometry.outline import edge_normals, signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.geometry.shape_check import crossing_edges
from push_ident.perception.frame.view import FrameView
from push_ident.perception.outline.edges import (
    EdgeLines,
    dense,
    depth_jumps,
    displacement,
    edge_std,
    moved_apart,
    with_edges_moved,
    without_reversed,
)
from push_ident.perception.outline.tracing import straighten
from push_ident.perception.pipeline import Perception
from push_ident.types import CameraIntrinsics, DepthFrame
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import SENSORS, suitable_pose
from push_ident_sim.objects import make_object

SQUARE = np.array([(-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05)])


def lines_of(scatter, n=20000, seed=0):
    """Lines of sight near the first edge of a square whose position scatters [m]."""
    rng = np.random.default_rng(seed)
    distance = rng.uniform(-0.005, 0.005, n)
    expected = 1.0 / (1.0 + np.exp(distance / 0.0015))
    stopped = distance < scatter * rng.standard_normal(n)
    return EdgeLines(np.zeros(n, dtype=np.int64), expected * (1.0 - expected) / 0.0015, stopped - expected, np.zeros((n, 2)))


def look_down(height):
    """Pose of a camera above the middle of the table that looks straight down, shape (4, 4)."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = height
    return pose


@pytest.mark.parametrize("scatter", [0.0, 5e-4, 2e-3])
def test_deviation_of_an_edge_follows_its_scatter(scatter):
    hidden, seen = (edge_std(SQUARE, [lines_of(scatter)], np.array([[0.0, y, 4.0]]), 8e-4) for y in (0.5, -0.5))
    assert hidden[0] == pytest.approx(np.hypot(scatter, 8e-4), abs=3e-4)  # ragged, and displaced
    assert seen[0] == pytest.approx(scatter, abs=2.5e-4)
    assert np.all(hidden[1:] > 9e-4)  # no line of sight passes the others: the prior of 1 mm


def test_depth_jumps_where_a_wall_is_hidden_or_narrower_in_the_image_than_half_a_window():
    sees = 4.0  # half of a window is filled where the camera is 25 cm in front of an edge
    assert depth_jumps(SQUARE, np.array([[0.0, -0.5, sees]])).tolist() == [0.0, 1.0, 1.0, 1.0]
    assert depth_jumps(SQUARE, np.array([[0.0, -0.5, sees], [0.4, 0.0, sees]])).tolist() == [0.0, 0.0, 1.0, 1.0]
    assert depth_jumps(SQUARE, np.array([[0.0, -0.175, sees]]))[0] == pytest.approx(0.5)


@pytest.mark.parametrize(("window", "expected"), [(1, 0.0), (4, 5 / 6), (8, 11 / 12)])
def test_pixels_share_the_noise_of_a_window(window, expected):
    """The camera displaces edges in proportion."""
    intrinsics, rng = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5), np.random.default_rng(0)
    noise = window * cv2.blur(rng.standard_normal((240, 320)), (window, window))  # of one deviation
    view = FrameView(DepthFrame(0.0, (1.0 + 1e-3 * noise).astype(np.float32), intrinsics), look_down(1.0))
    assert view.shared_noise == pytest.approx(expected, abs=0.03)
    mean, std = displacement([(view, np.zeros(3))])
    assert mean == pytest.approx(1.25 * expected / 300.0, abs=2e-4) and std == pytest.approx(0.4 * mean)


@pytest.mark.parametrize(("sensor", "least", "most"), [("ideal", 0.0, 0.0), ("phoxi", 0.0, 0.1), ("kinect_v1", 0.7, 0.9)])
def test_whole_units_of_depth_are_no_noise_that_pixels_share(sensor, least, most):
    """The ideal camera rounds to a millimetre, the Kinect to steps of disparity."""
    unit, reported = Sensor(sensor, 0), suitable_pose(sensor)
    seen = unit.look(unit.camera(make_object("book", 0), reported), np.array([0.0, 0.0, 0.3]), {})
    frame = DepthFrame(0.0, unit.read(seen, np.random.default_rng(0)), unit.intrinsics)
    perception = Perception(reported)
    perception.observe(frame)
    assert least <= FrameView(frame, perception.camera_in_table).shared_noise <= most


@pytest.mark.parametrize("sensor", ["realsense_d435_640x480", pytest.param("realsense_d415_1280x720", marks=pytest.mark.long), "phoxi"])
def test_far_edges_are_no_further_out_than_near_ones(sensor):
    """A matcher widens them by a pixel, 1.1 to 1.7 mm here; a sensor that decodes each pixel does not. Extrinsics are exact."""
    model, reported = replace(SENSORS[sensor], rotation_std=0.0, translation_std=0.0, distortion=0.0), suitable_pose(sensor)
    errors = []
    for name, yaw in (("book", 0.4), ("crimp", -2.0)):
        thing, unit, rng, perception = make_object(name, 101), Sensor(model, 101), np.random.default_rng(7), Perception(reported)
        seen = unit.look(unit.camera(thing, reported), np.array([0.0, 0.0, yaw]), {})
        found = {}
        for i in range(10):
            found |= perception.observe(DepthFrame(i / 30, unit.read(seen, rng), unit.intrinsics)).new_shapes
        outline = dense(transform_points(perception.first_pose("o1"), found["o1"].outline), 1e-3)
        truth = transform_points((0.0, 0.0, yaw), thing.outline)
        away = (outline - reported[:2, 3]) / np.linalg.norm(outline - reported[:2, 3], axis=1, keepdims=True)
        is_far = np.sum(edge_normals(outline) * away, axis=1) > 0.7
        errors.append(np.mean(signed_distance(outline[is_far], truth)))
    assert abs(np.mean(errors)) < 5e-4


@pytest.mark.parametrize(
    "sensor", ["plain", "kinect_v1", *(pytest.param(name, marks=pytest.mark.long) for name in ("realsense_d435_848x480", "phoxi"))]
)
def test_edges_are_where_their_deviations_say(sensor):
    """Longer edges of the book, with exact extrinsics: a rigid motion would spread what displaces the hidden edges over all of them."""
    thing, unit, reported = make_object("book", 101), Sensor(sensor, 101), suitable_pose(sensor)
    exact = reported @ SENSORS[sensor].extrinsics_error(101) if sensor in SENSORS else reported
    rng, pose = np.random.default_rng(7), np.array([0.03, -0.02, 0.4])
    perception = Perception(exact)
    seen = unit.look(unit.camera(thing, reported), pose, {})
    found = {}
    for i in range(10):
        found |= perception.observe(DepthFrame(i / 30, unit.read(seen, rng), unit.intrinsics)).new_shapes
    shape = found["o1"]
    outline, truth = transform_points(perception.first_pose("o1"), shape.outline), transform_points(pose, thing.outline)
    end = np.roll(outline, -1, axis=0)
    long, share = np.linalg.norm(end - outline, axis=1) > 0.03, np.linspace(0.2, 0.8, 9)[:, None]
    error = np.array([signed_distance(a + share * (b - a), truth).mean() for a, b in zip(outline, end, strict=True)])
    assert 0.05 < np.sqrt(np.mean((error[long] / shape.outline_std[long]) ** 2)) < 2.5 and shape.outline_error < 4e-3


SEEDS = range(5)


def straightened(polygon: np.ndarray, seed: int) -> np.ndarray:
    """Outline of a polygon as tracing gives it: a point each quarter of a millimetre, corners rounded, wavering by 0.3 mm."""
    rounded = gaussian_filter1d(dense(np.array(polygon)), 5, axis=0, mode="wrap")
    waver = gaussian_filter1d(np.random.default_rng(seed).normal(size=rounded.shape), 12, axis=0, mode="wrap")
    return straighten(np.asarray(rounded + 3e-4 * waver / waver.std()))


def test_hammer_gets_its_eight_edges_back() -> None:
    x0, x1, x2, h, w = -0.14, 0.02, 0.06, 0.011, 0.055
    hammer = np.array([[x1, -h], [x1, -w], [x2, -w], [x2, w], [x1, w], [x1, h], [x0, h], [x0, -h]])
    for seed in SEEDS:
        outline = straightened(hammer, seed)
        assert np.max(np.abs(signed_distance(outline, hammer))) < 1e-3
        edge = np.roll(outline, -1, axis=0) - outline
        length = np.linalg.norm(edge, axis=1)
        off_axis = np.abs((np.degrees(np.arctan2(edge[:, 1], edge[:, 0])) + 45) % 90 - 45)
        assert length[off_axis < 2].sum() > 0.85 * length.sum()  # Nearly all of the outline points where it should.


def test_disc_stays_round() -> None:
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    outline = straightened(0.05 * np.column_stack([np.cos(angle), np.sin(angle)]), 0)
    assert np.max(np.abs(np.linalg.norm(dense(outline), axis=1) - 0.05)) < 1.6e-3


def test_edge_traced_in_two_parts_at_an_angle_has_no_dent() -> None:
    side = [[0.0, -6e-4], [0.038, 1e-3], [0.0437, -7e-4], [0.056, -4e-4]]  # As a camera saw a side of the crimp.
    plate = np.array([*side, [0.056, 0.03], [0.0, 0.03]])
    for orientation in (1, -1):
        outline = straightened(plate[::orientation], 3)
        assert len(outline) == 4 and np.max(np.abs(signed_distance(outline, rectangle(0.0, 0.0, 0.056, 0.03)))) < 1.2e-3


def test_side_that_bulges_does_not_become_straight() -> None:
    x = np.linspace(0.0, 0.06, 40)
    bulging = np.vstack([np.column_stack([x, -0.0016 * (1.0 - (2.0 * x / 0.06 - 1.0) ** 2)]), [[0.06, 0.03], [0.0, 0.03]]])
    assert np.min(straightened(bulging, 4)[:, 1]) < -1e-3


def test_no_edge_of_a_ragged_contour_has_no_length() -> None:
    for seed in SEEDS:
        rough = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((200, 200)), (0, 0), 1.5)
        contours, _ = cv2.findContours((rough > -0.02).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        # Turned, so that ends of stretches that are one point differ by rounding.
        outline = straighten(transform_points([0.0, 0.0, 0.3], max(contours, key=cv2.contourArea)[:, 0] * 2.5e-4))
        assert len(outline) >= 3 and np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1).min() > 1e-6


def test_edges_that_would_cross_move_less_far() -> None:
    """A slot of 2 mm whose sides are pushed into each other by 3 mm each stays open."""
    slot = np.array([(0, 0), (30, 0), (30, 20), (16, 20), (16, 5), (14, 5), (14, 22), (0, 22)], dtype=float) * 1e-3
    step = np.zeros(8)
    step[[3, 5]] = 3e-3
    outline, moved = moved_apart(slot, np.zeros(8), step)
    assert crossing_edges(outline) is None and 0.0 <= moved.max() < 1.5e-3
    assert crossing_edges(without_reversed(slot, with_edges_moved(slot, step), step)[0]) is not None
