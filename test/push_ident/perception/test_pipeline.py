"""Perception against an exact renderer with sensor noise: what comes out is compared with the scene that went in."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER, HAMMER_OUTLINE, INTRINSICS, Prism, circle, rectangle, render
from push_ident.errors import FrameError, InputError, PerceptionError
from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.perception.frame.depth_image import depth_from_buffer
from push_ident.perception.frame.occupancy import FREE, OCCUPIED, UNOBSERVED, top_down
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.frame.table import fit_table
from push_ident.perception.frame.view import FrameView, median_frame, points_in_table
from push_ident.perception.known_object import SegmentedView, Template, TrackStatus
from push_ident.perception.outline.edges import fuse_views
from push_ident.perception.outline.tracing import trace_object
from push_ident.perception.pipeline import Perception
from push_ident.perception.recording import observe_offline
from push_ident.perception.search.segments import find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking.pose_fit import fit_pose, relocate
from push_ident.types import CameraIntrinsics, DepthFrame

SETTINGS = PerceptionSettings()
FIRST = np.array([0.03, -0.02, 0.4])
RADIUS = 0.018


def hammer(pose):
    return [prism.at(pose) for prism in HAMMER]


def trace_hammer(pose, rng, n_frames=10):
    """The hammer traced from frames at rest, and the camera corrected by the table."""
    frames = [render(hammer(pose), rng=rng, stamp=0.03 * i) for i in range(n_frames)]
    plane = fit_table(points_in_table(frames[0], CAMERA), SETTINGS)
    camera = plane.correct(CAMERA)
    segments, _ = find_segments(FrameView(frames[0], camera))
    median = FrameView(median_frame(frames), camera, noise=plane.noise / np.sqrt(n_frames))
    traced = trace_object([SegmentedView(median, segments[0])], min_height=0.008, cell_count=80)
    return fuse_views(traced, [(median, traced.pose)], pose_known=True), camera


@pytest.fixture(scope="module")
def known():
    """Template of the hammer, corrected camera, and the pose of its object frame in the frame of HAMMER_OUTLINE."""
    traced, camera = trace_hammer(FIRST, np.random.default_rng(1))
    return Template(traced), camera, compose(inverse(FIRST), traced.pose)


def errors_of(known, truths, rng, *, obstacles=lambda pose: [], robot=lambda pose: ()):
    """Errors (mm, mm, deg) of the fits that claim to be tracked, the fits, and the errors in standard deviations squared."""
    template, camera, offset = known
    errors, fits, squares = [], [], []
    for truth in truths:
        expected = compose(truth, offset)
        start = expected + rng.normal(size=3) * [0.004, 0.004, 0.03]
        fit = fit_pose(template, FrameView(render(hammer(truth) + obstacles(truth), rng=rng), camera, robot(truth)), start)
        fits.append(fit)
        if fit.status is TrackStatus.TRACKED:
            error = fit.pose - expected
            error[2] = wrap_angle(error[2])
            errors.append(error * [1e3, 1e3, np.degrees(1.0)])
            squares.append(error @ np.linalg.solve(fit.covariance, error))
    return np.array(errors), fits, np.array(squares)


def random_poses(rng, n):
    return [np.array([*rng.uniform(-0.1, 0.1, size=2), rng.uniform(-np.pi, np.pi)]) for _ in range(n)]


# Depth images


def test_millimetres_become_metres_and_zero_becomes_unknown():
    raw = np.array([[1234, 0, 999], [40, 65535, 1]], dtype="<u2")
    depth = depth_from_buffer("16UC1", 2, 3, 6, False, raw.tobytes())
    np.testing.assert_allclose(depth, [[1.234, np.nan, 0.999], [0.04, 65.535, 0.001]], rtol=1e-6)
    assert np.array_equal(depth, depth_from_buffer("16UC1", 2, 3, 6, True, raw.astype(">u2").tobytes()), equal_nan=True)


def test_metres_keep_their_value_and_impossible_ones_become_unknown():
    raw = np.array([[0.7, np.nan, np.inf, -np.inf, 0.0, -1.0]], dtype="<f4")
    np.testing.assert_array_equal(np.isfinite(depth_from_buffer("32FC1", 1, 6, 24, False, raw.tobytes())), [[True] + [False] * 5])


def test_padding_at_the_end_of_rows_is_left_out():
    raw = np.array([[1000, 2000, 7777], [3000, 4000, 7777]], dtype="<u2")
    np.testing.assert_allclose(depth_from_buffer("16UC1", 2, 2, 6, False, raw.tobytes()), [[1.0, 2.0], [3.0, 4.0]])


@pytest.mark.parametrize(
    ("encoding", "height", "width", "step", "n_bytes", "text"),
    [
        ("rgb8", 2, 2, 6, 12, "'rgb8', expected one of 16UC1, 32FC1"),
        ("mono16", 2, 2, 4, 8, "'mono16'"),
        ("16UC1", 2, 2, 4, 7, "7 bytes, expected step \\* height = 8"),
        ("16UC1", 2, 2, 3, 6, "step is 3"),
        ("32FC1", 2, 2, 4, 8, "step is 4 bytes, expected at least 8"),
        ("16UC1", 0, 2, 4, 0, "2 x 0 pixels"),
        ("16UC1", 2**31, 2**31, 2**32, 8, "pixels, expected"),
    ],
)
def test_images_that_lie_about_themselves_are_refused(encoding, height, width, step, n_bytes, text):
    with pytest.raises(FrameError, match=text):
        depth_from_buffer(encoding, height, width, step, False, bytes(n_bytes))


def test_frame_and_intrinsics_of_different_sizes_are_refused():
    with pytest.raises(FrameError, match=r"\(4, 4\), its camera info \(480, 640\)"):
        points_in_table(DepthFrame(0.0, np.ones((4, 4), np.float32), INTRINSICS), CAMERA)
    with pytest.raises(FrameError, match="focal lengths > 0"):
        points_in_table(DepthFrame(0.0, np.ones((4, 4), np.float32), CameraIntrinsics(4, 4, 0.0, 1.0, 2.0, 2.0)), CAMERA)


# Table


def test_tilted_extrinsics_are_corrected_to_the_true_plane():
    tilt, shift = 0.02, 0.008
    wrong = np.eye(4)
    wrong[:3, :3] = [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    wrong[2, 3] = shift
    frame = render(hammer(FIRST), rng=np.random.default_rng(0))
    plane = fit_table(points_in_table(frame, wrong @ CAMERA), SETTINGS)
    assert plane.slope == pytest.approx((-np.tan(tilt), 0.0), abs=5e-4)
    assert plane.height(0.0, 0.0) == pytest.approx(shift, abs=3e-4)
    assert plane.noise == pytest.approx(0.0016, abs=0.0004)
    np.testing.assert_allclose(plane.correct(wrong @ CAMERA)[:3, :3], CAMERA[:3, :3], atol=1e-3)
    assert plane.correct(wrong @ CAMERA)[2, 3] == pytest.approx(CAMERA[2, 3], abs=1e-3)


def test_no_table_is_an_error_that_counts_the_valid_points():
    empty = np.full((480, 640), np.nan, np.float32)
    with pytest.raises(PerceptionError, match="0 valid of 307200"):
        fit_table(points_in_table(DepthFrame(0.0, empty, INTRINSICS), CAMERA), SETTINGS)
    lifted = CAMERA.copy()
    lifted[2, 3] += 0.2
    with pytest.raises(PerceptionError, match="check the extrinsics"):
        fit_table(points_in_table(render([]), lifted), SETTINGS)


# Labels, top-down grid, segments


def test_top_down_grid_shows_the_object_and_keeps_its_shadow_unknown():
    box = Prism(rectangle(-0.05, -0.1, 0.05, 0.1), 0.06)
    grid = top_down(FrameView(render([box], rng=np.random.default_rng(0)), CAMERA))

    def cells(x0, y0, x1, y1):
        low = np.array(grid.origin)
        (i0, j0), (i1, j1) = ((np.array(corner) - low) / grid.resolution for corner in ((x0, y0), (x1, y1)))
        return grid.occupancy[int(j0) : int(j1), int(i0) : int(i1)]

    assert grid.occupancy.shape == (400, 400)
    assert np.mean(cells(-0.045, -0.095, 0.045, 0.095) == OCCUPIED) > 0.99
    assert np.mean(cells(-0.08, -0.09, -0.06, 0.09) == UNOBSERVED) > 0.99
    assert np.mean(cells(0.06, -0.2, 0.2, 0.2) == FREE) > 0.99
    assert np.nanmedian(grid.height[grid.occupancy == OCCUPIED]) == pytest.approx(0.06, abs=0.004)


# Shape


@pytest.mark.parametrize("yaw", [0.0, 0.8, 1.57, -2.0])
def test_outline_is_exact_on_all_sides_the_hidden_one_included(yaw):
    truth = np.array([0.03, -0.02, yaw])
    traced, _ = trace_hammer(truth, np.random.default_rng(2))
    outline = traced.shape.outline + traced.pose[:2]
    share = np.linspace(0, 1, 50, endpoint=False)[:, None]
    edge = np.roll(outline, -1, axis=0) - outline
    points = (outline[:, None] + share * edge[:, None]).reshape(-1, 2)
    weight = np.repeat(np.linalg.norm(edge, axis=1), 50)
    distance = signed_distance(points, transform_points(truth, HAMMER_OUTLINE))
    assert np.sqrt(np.average(distance**2, weights=weight)) < 0.0010
    assert abs(np.average(distance, weights=weight)) < 0.0006
    # Behind the middle, as seen from the camera. No bias towards the shadow.
    behind = points[:, 0] < traced.pose[0]
    assert abs(np.average(distance[behind], weights=weight[behind])) < 0.0006
    assert polygon_area(outline) == pytest.approx(abs(polygon_area(HAMMER_OUTLINE)), rel=0.05)
    assert 60 <= len(traced.shape.cells) <= 100
    # Handle and head are of different height.
    assert np.quantile(traced.top, 0.02) == pytest.approx(0.025, abs=0.002)
    assert np.quantile(traced.top, 0.98) == pytest.approx(0.035, abs=0.002)


# Tracking


def test_static_pose_is_found_to_a_quarter_of_a_millimetre(known):
    errors, fits, squares = errors_of(known, random_poses(np.random.default_rng(3), 10), np.random.default_rng(4))
    assert all(fit.status is TrackStatus.TRACKED for fit in fits)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < [0.25, 0.25, 0.2])
    assert 1.0 < squares.mean() < 4.0  # chi squared with 3 degrees of freedom, ten draws
    assert all(np.linalg.eigvalsh(fit.covariance)[0] > 0 for fit in fits)


def test_an_arm_in_front_of_the_object_does_not_pull_its_pose(known):
    def arm(pose):
        middle = np.add(compose(pose, [-0.07, 0.0, 0.0])[:2], (0.10, 0.0))
        return [Prism(rectangle(-0.045, -0.045, 0.045, 0.045) + middle, 0.4, 0.13)]

    poses = [np.array([x, y, yaw]) for x, y, yaw in ((0.0, 0.0, 0.3), (-0.05, 0.05, 1.2), (0.05, -0.05, -1.9), (0.0, 0.05, 1.9))]
    errors, fits, squares = errors_of(known, poses, np.random.default_rng(5), obstacles=arm)
    assert all(fit.status is TrackStatus.TRACKED for fit in fits)
    assert all(0.3 < fit.share_visible < 0.9 for fit in fits)
    assert np.all(np.abs(errors) < [0.6, 0.6, 0.4])
    assert squares.mean() < 6.0


def test_a_touching_pusher_does_not_pull_the_pose(known):
    def at(pose):
        return compose(pose, [-0.03, 0.011 + RADIUS, 0.0])[:2]

    errors, fits, _ = errors_of(
        known,
        random_poses(np.random.default_rng(6), 8),
        np.random.default_rng(7),
        obstacles=lambda pose: [Prism(circle(RADIUS) + at(pose), 0.11, 0.002)],
        robot=lambda pose: (Cylinder(*at(pose), RADIUS, 0.0),),
    )
    assert all(fit.status is TrackStatus.TRACKED for fit in fits)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < [0.3, 0.3, 0.25])


def test_nothing_visible_is_a_status_and_never_a_frozen_pose(known):
    template, camera, offset = known
    start = compose(FIRST, offset)
    gone = fit_pose(template, FrameView(render([], rng=np.random.default_rng(0)), camera), start)
    assert gone.status is TrackStatus.POOR_FIT
    roof = Prism(rectangle(-0.2, -0.2, 0.3, 0.2), 0.3, 0.28)
    assert fit_pose(template, FrameView(render([*hammer(FIRST), roof]), camera), start).status is TrackStatus.HIDDEN
    blind = DepthFrame(0.0, np.full((480, 640), np.nan, np.float32), INTRINSICS)
    assert fit_pose(template, FrameView(blind, camera), start).status is TrackStatus.HIDDEN
    assert fit_pose(template, FrameView(blind, camera), [3.0, 0.0, 0.0]).status is TrackStatus.OUT_OF_VIEW


def test_a_lost_object_is_found_again_at_any_yaw(known):
    template, camera, offset = known
    for truth in (np.array([-0.1, 0.1, 2.7]), np.array([0.1, -0.1, -1.2])):
        expected = compose(truth, offset)
        fit = relocate(
            template, FrameView(render(hammer(truth), rng=np.random.default_rng(8)), camera), np.add(expected[:2], (0.006, -0.005))
        )
        assert fit.status is TrackStatus.TRACKED
        error = fit.pose - expected
        assert np.hypot(*error[:2]) < 0.0005 and abs(wrap_angle(error[2])) < 0.005


# Everything together


def push_frames(n_frames, rng, *, start=0.4, period=1 / 15, tool=True):
    """The hammer at rest until `start`, then pushed by a cylinder at about 0.1 m/s while it turns."""

    def pose(stamp):
        moved = max(0.0, stamp - start)
        return np.array([0.03 + 0.05 * moved, -0.05 + 0.08 * moved, 0.4 + 0.8 * moved])

    def robot(stamp):
        at = compose(pose(stamp), [-0.03, -0.029 if stamp > start else -0.10, 0.0])
        return (Cylinder(float(at[0]), float(at[1]), RADIUS, 0.003),)

    frames = []
    for stamp in period * np.arange(n_frames):
        at = robot(stamp)[0]
        obstacles = [Prism(np.add(circle(RADIUS), (at.x, at.y)), 0.11, 0.003)] if tool else []
        frames.append(render(hammer(pose(stamp)) + obstacles, rng=rng, stamp=float(stamp)))
    return frames, pose, robot


def test_a_push_is_followed_offline_within_a_millimetre():
    frames, pose, robot = push_frames(18, np.random.default_rng(9))
    found = observe_offline(frames, CAMERA, robot_at=robot, settings=PerceptionSettings(rest_frames=4))
    assert list(found) == ["o1"]
    _, track = found["o1"]
    assert len(track.time) == len(frames)
    offset = compose(inverse(pose(0.0)), track.pose[:4].mean(axis=0))
    expected = np.array([compose(pose(stamp), offset) for stamp in track.time])
    errors = (track.pose - expected) * [1e3, 1e3, np.degrees(1.0)]
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < [0.3, 0.3, 0.3])
    assert track.pose[-1, 2] - track.pose[0, 2] > 0.4


def test_two_objects_keep_their_ids_and_the_occupancy_comes_at_its_own_rate():
    rng = np.random.default_rng(10)
    box = Prism(rectangle(-0.2, 0.1, -0.1, 0.18), 0.05)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=2, occupancy_period=0.15))
    observations = [perception.observe(render([*hammer(FIRST), box], rng=rng, stamp=0.1 * i)) for i in range(5)]
    assert list(observations[1].new_shapes) == ["o1", "o2"]
    assert [len(observation.objects) for observation in observations] == [0, 0, 2, 2, 2]
    assert [observation.occupancy is not None for observation in observations] == [True, False, True, False, True]
    areas = [polygon_area(shape.outline) for shape in observations[1].new_shapes.values()]
    assert areas == pytest.approx([0.008, 0.00712], rel=0.05)
    assert observations[0].why_no_pose() == "2 segments: not at rest yet"
    assert observations[-1].why_no_pose() == ""


def test_a_moving_object_is_not_registered():
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=3))
    rng = np.random.default_rng(11)
    for i in range(5):
        observation = perception.observe(render(hammer(np.add(FIRST, (0.006 * i, 0.0, 0.0))), rng=rng, stamp=0.1 * i))
        assert not observation.new_shapes and not observation.objects


def test_an_object_moved_by_hand_is_reported_lost_and_then_found_under_its_id():
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=2))
    rng = np.random.default_rng(12)
    scenes = [hammer(FIRST)] * 3 + [[]] + [hammer([-0.12, 0.12, -1.0])] * 2
    observations = [perception.observe(render(scene, rng=rng, stamp=0.1 * i)) for i, scene in enumerate(scenes)]
    assert observations[2].objects[0].status is TrackStatus.TRACKED
    assert observations[3].objects[0].status is TrackStatus.POOR_FIT and observations[3].objects[0].pose is None
    assert "object o1" in observations[3].why_no_pose()
    assert [known.object_id for known in observations[5].objects] == ["o1"]
    moved = compose(observations[5].objects[0].pose, inverse(observations[2].objects[0].pose))
    assert wrap_angle(moved[2]) == pytest.approx(-1.4, abs=0.01)


def test_time_going_back_drops_what_was_known():
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=1))
    frame = render(hammer(FIRST), rng=np.random.default_rng(13), stamp=5.0)
    assert perception.observe(frame).new_shapes
    with pytest.raises(FrameError, match="repeats the stamp 5.000000"):
        perception.observe(frame)
    again = perception.observe(DepthFrame(1.0, frame.depth, INTRINSICS))
    assert again.restarted and list(again.new_shapes) == ["o1"]


def test_poses_go_on_while_the_robot_covers_the_table():
    rng = np.random.default_rng(15)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=1, occupancy_period=0.1))
    perception.observe(render(hammer(FIRST), rng=rng))
    covers = [Prism(rectangle(-0.5, y, 0.3, y + 0.35), 0.2, 0.15) for y in (-0.5, 0.12)]
    observation = perception.observe(
        render([*hammer(FIRST), *covers, Prism(rectangle(0.12, -0.5, 0.4, 0.5), 0.2, 0.15)], rng=rng, stamp=0.1)
    )
    assert observation.counts["table_hidden"] == 1
    assert observation.objects[0].status is TrackStatus.TRACKED


def test_reasons_are_given_when_nothing_comes_out():
    rng = np.random.default_rng(14)
    perception = Perception(CAMERA)
    assert "higher than min_object_height" in perception.observe(render([], rng=rng)).why_no_pose()
    with pytest.raises(PerceptionError, match="0 valid of 307200"):
        perception.observe(DepthFrame(1.0, np.full((480, 640), np.nan, np.float32), INTRINSICS))
    with pytest.raises(PerceptionError, match="No object was found in 2 depth frames: nothing on the table"):
        observe_offline([render([], rng=rng, stamp=0.1 * i) for i in range(2)], CAMERA)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"workspace_low": (0.1, 0.1), "workspace_high": (0.0, 0.2)}, "low must be below high"),
        ({"min_object_height": 0.6}, "0 < min < max"),
        ({"tool_reach": (0.09, 0.01)}, "tool_reach"),
        ({"min_step": 0.0}, "min_step"),
        ({"rest_frames": 0}, "at least 1"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(wrong, text):
    with pytest.raises(InputError, match=text):
        PerceptionSettings(**wrong)
