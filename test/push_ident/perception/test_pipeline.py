"""Perception against an exact renderer with sensor noise: poses and shapes of the scene that went in; what a frame does when."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER_OUTLINE, INTRINSICS, Prism, box, circle, hammer, rectangle, render
from push_ident.errors import FrameError, InputError, PerceptionError
from push_ident.geometry.outline import dense, polygon_area, signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.perception.frame import occupancy, table
from push_ident.perception.frame.occupancy import FREE, OCCUPIED, UNOBSERVED, top_down
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.frame.table import fit_table
from push_ident.perception.frame.view import FrameView, median_frame, points_in_table
from push_ident.perception.known_object import PoseFit, SegmentedView, Template, TrackStatus
from push_ident.perception.outline.edges import fuse_views
from push_ident.perception.outline.tracing import trace_object
from push_ident.perception.pipeline import Perception
from push_ident.perception.recording import observe_offline
from push_ident.perception.search import search
from push_ident.perception.search.segments import find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking import tracker
from push_ident.perception.tracking.pose_fit import fit_pose, keeps_heading
from push_ident.types import DepthFrame

SETTINGS = PerceptionSettings(rest_frames=3)
FIRST = np.array([0.03, -0.02, 0.4])
RADIUS = 0.018
IN_MM_AND_DEGREES = np.array([1e3, 1e3, np.degrees(1.0)])
BLIND = DepthFrame(0.0, np.full((480, 640), np.nan, np.float32), INTRINSICS)


def trace_hammer(pose, rng, n_frames=10):
    """The hammer traced from frames at rest, and the camera corrected by the table."""
    frames = [render(hammer(pose), rng=rng, stamp=0.03 * i) for i in range(n_frames)]
    plane = fit_table(points_in_table(frames[0], CAMERA), SETTINGS)
    camera = plane.correct(CAMERA)
    segments, _ = find_segments(FrameView(frames[0], camera))
    median = FrameView(median_frame(frames), camera, noise=plane.noise / np.sqrt(n_frames))
    traced = trace_object([SegmentedView(median, segments[0])], min_height=0.008, cell_count=80)
    return fuse_views(traced, [(median, traced.pose)]), camera


@pytest.fixture(scope="module")
def known():
    """Template of the hammer, corrected camera, and the pose of its object frame in the frame of HAMMER_OUTLINE."""
    traced, camera = trace_hammer(FIRST, np.random.default_rng(1))
    return Template(traced), camera, compose(inverse(FIRST), traced.pose)


def error_of(pose, expected):
    error = pose - expected
    error[2] = wrap_angle(error[2])
    return error


def errors_of(known, truths, rng):
    """Errors (mm, mm, deg) of the fits, all of which are tracked, the fits, and the errors in standard deviations squared."""
    template, camera, offset = known
    errors, fits = [], []
    for truth in truths:
        start = compose(truth, offset) + rng.normal(size=3) * [0.004, 0.004, 0.03]
        fits.append(fit_pose(template, FrameView(render(hammer(truth), rng=rng), camera), start))
        errors.append(error_of(fits[-1].pose, compose(truth, offset)))
    assert all(fit.status is TrackStatus.TRACKED for fit in fits)
    squares = [error @ np.linalg.solve(fit.covariance, error) for error, fit in zip(errors, fits, strict=True)]
    return np.array(errors) * IN_MM_AND_DEGREES, fits, np.array(squares)


def test_a_wall_that_is_seen_below_a_step_of_the_upper_side_contradicts_no_pose():
    """Points of the wall towards the camera make such steps at the edge, where the height beside a line of sight alternates."""
    tall = Prism(rectangle(-0.05, -0.10, 0.05, 0.10), 0.15)
    view = FrameView(render([tall], rng=np.random.default_rng(3)), CAMERA)
    traced = trace_object([SegmentedView(view, find_segments(view)[0][0])], min_height=0.008, cell_count=80)
    top, towards_camera = traced.top.copy(), traced.top_origin[0] + traced.top_resolution * np.arange(traced.top.shape[1]) > 0.04
    top[:, towards_camera] *= 0.4
    for upper_side in (traced.top, top):
        fit = fit_pose(Template(replace(traced, top=upper_side)), view, traced.pose)
        assert fit.status is TrackStatus.TRACKED and fit.share_contradicting < 0.001


def test_a_round_thing_has_no_heading_and_keeps_its_place():
    rng, perception, poses = np.random.default_rng(0), Perception(CAMERA, SETTINGS), []
    for i in range(60):
        x = np.clip(0.002 * (i - 20), 0.0, 0.03)  # pushed along x
        seen = perception.observe(render([Prism(circle(0.04, 48), 0.06).at((x, 0.01, 0.1 * i))], rng=rng, stamp=i / 30))
        for known in seen.objects:
            assert known.status is TrackStatus.TRACKED
            poses.append(known.pose)
            assert known.covariance[2, 2] == pytest.approx(np.pi**2 / 3) and not known.covariance[2, :2].any()
    assert len(poses) > 50 and np.ptp(poses, axis=0) == pytest.approx((0.03, 0.0, 0.0), abs=0.003)
    elsewhere = [Prism(circle(0.04, 48), 0.06).at((-0.1, 0.12, 0.0))]
    for i in range(60, 80):
        seen = perception.observe(render(elsewhere, rng=rng, stamp=i / 30))
    assert [(known.object_id, known.status) for known in seen.objects] == [("o1", TrackStatus.TRACKED)]


@pytest.mark.parametrize(("outline", "kept"), [(circle(0.04, 48), False), (rectangle(-0.05, -0.03, 0.05, 0.03), True)])
def test_a_heading_is_kept_where_fits_from_both_sides_meet(outline, kept):
    view = FrameView(render([Prism(outline, 0.06)], rng=np.random.default_rng(0)), CAMERA)
    traced = trace_object([SegmentedView(view, find_segments(view)[0][0])], min_height=0.008, cell_count=80)
    assert keeps_heading(Template(traced), view, traced.pose) == kept
    assert not Template(replace(traced, keeps_heading=False)).has_heading


@pytest.mark.parametrize("outline", [rectangle(-0.03, -0.03, 0.03, 0.03), circle(0.04, 6), HAMMER_OUTLINE])
def test_a_thing_with_corners_has_a_heading(outline):
    perception = Perception(CAMERA, SETTINGS)
    for i in range(6):
        perception.observe(render([Prism(outline, 0.05).at(FIRST)], rng=np.random.default_rng(i), stamp=i / 30))
    assert Template(perception.known("o1").traced).has_heading


def test_tilted_extrinsics_are_corrected_to_the_true_plane():
    tilt, shift, wrong = 0.02, 0.008, np.eye(4)
    wrong[:3, :3] = [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    wrong[2, 3] = shift
    plane = fit_table(points_in_table(render(hammer(FIRST), rng=np.random.default_rng(0)), wrong @ CAMERA), SETTINGS)
    assert plane.slope == pytest.approx((-np.tan(tilt), 0.0), abs=5e-4)
    assert plane.height(0.0, 0.0) == pytest.approx(shift, abs=3e-4) and plane.noise == pytest.approx(0.0016, abs=0.0004)
    np.testing.assert_allclose(plane.correct(wrong @ CAMERA)[[0, 1, 2, 2], [0, 1, 2, 3]], CAMERA[[0, 1, 2, 2], [0, 1, 2, 3]], atol=1e-3)
    lifted = CAMERA.copy()
    lifted[2, 3] += 0.2
    for frame, camera, why in ((BLIND, CAMERA, "0 valid of 307200"), (render([]), lifted, "200 mm from its place")):
        with pytest.raises(PerceptionError, match=why):
            fit_table(points_in_table(frame, camera), SETTINGS)


def test_top_down_grid_shows_the_object_and_keeps_its_shadow_unknown():
    box = Prism(rectangle(-0.05, -0.1, 0.05, 0.1), 0.06)
    grid = top_down(FrameView(render([box], rng=np.random.default_rng(0)), CAMERA))
    assert grid.occupancy.shape == (400, 400) and grid.origin == (-0.4, -0.4)

    def share(state, x0, y0, x1, y1):
        i0, j0, i1, j1 = (int((at + 0.4) / grid.resolution) for at in (x0, y0, x1, y1))
        return np.mean(grid.occupancy[j0:j1, i0:i1] == state)

    assert share(OCCUPIED, -0.045, -0.095, 0.045, 0.095) > 0.99
    assert share(UNOBSERVED, -0.08, -0.09, -0.06, 0.09) > 0.99
    assert share(FREE, 0.06, -0.2, 0.2, 0.2) > 0.99
    assert np.nanmedian(grid.height[grid.occupancy == OCCUPIED]) == pytest.approx(0.06, abs=0.004)


@pytest.mark.parametrize("yaw", [0.8, 1.57])
def test_outline_is_exact_on_all_sides_the_hidden_one_included(yaw):
    truth = np.array([0.03, -0.02, yaw])
    traced, _ = trace_hammer(truth, np.random.default_rng(2))
    outline = traced.shape.outline + traced.pose[:2]
    points = dense(outline)
    distance = signed_distance(points, transform_points(truth, HAMMER_OUTLINE))
    assert np.sqrt(np.mean(distance**2)) < 0.0010 and abs(np.mean(distance)) < 0.0006
    # Behind the middle, as seen from the camera. No bias towards the shadow.
    assert abs(np.mean(distance[points[:, 0] < traced.pose[0]])) < 0.00065
    assert polygon_area(outline) == pytest.approx(abs(polygon_area(HAMMER_OUTLINE)), rel=0.05)
    assert 60 <= len(traced.shape.cells) <= 100
    assert np.quantile(traced.top, [0.02, 0.98]) == pytest.approx([0.025, 0.035], abs=0.002)  # handle and head


def test_static_pose_is_found_to_a_quarter_of_a_millimetre(known):
    poses = np.random.default_rng(3).uniform([-0.1, -0.1, -np.pi], [0.1, 0.1, np.pi], (10, 3))
    errors, fits, squares = errors_of(known, poses, np.random.default_rng(4))
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < [0.25, 0.25, 0.2])
    assert 1.0 < squares.mean() < 4.0  # chi squared with 3 degrees of freedom, ten draws
    assert all(np.linalg.eigvalsh(fit.covariance)[0] > 0 for fit in fits)


def test_nothing_visible_is_a_status_and_never_a_frozen_pose(known):
    template, camera, offset = known
    at, roof = compose(FIRST, offset), Prism(rectangle(-0.2, -0.2, 0.3, 0.2), 0.3, 0.28)
    for frame, start, status in (
        (render([], rng=np.random.default_rng(0)), at, TrackStatus.POOR_FIT),
        (render([*hammer(FIRST), roof]), at, TrackStatus.HIDDEN),
        (BLIND, at, TrackStatus.HIDDEN),
        (BLIND, [3.0, 0.0, 0.0], TrackStatus.OUT_OF_VIEW),
    ):
        assert fit_pose(template, FrameView(frame, camera), start).status is status


def test_a_push_is_followed_offline_within_a_millimetre():
    def pose(stamp):
        moved = max(0.0, stamp - 0.4)
        return np.array([0.03 + 0.05 * moved, -0.05 + 0.08 * moved, 0.4 + 0.8 * moved])

    def robot(stamp):
        at = compose(pose(stamp), [-0.03, -0.029 if stamp > 0.4 else -0.10, 0.0])
        return (Cylinder(float(at[0]), float(at[1]), RADIUS, 0.003),)

    rng, frames = np.random.default_rng(9), []
    for stamp in np.arange(18) / 15:
        tool = Prism(np.add(circle(RADIUS), (robot(stamp)[0].x, robot(stamp)[0].y)), 0.11, 0.003)
        frames.append(render([*hammer(pose(stamp)), tool], rng=rng, stamp=float(stamp)))
    found = observe_offline(frames, CAMERA, robot_at=robot, settings=PerceptionSettings(rest_frames=4))
    assert list(found) == ["o1"]
    _, track = found["o1"]
    offset = compose(inverse(pose(0.0)), track.pose[:4].mean(axis=0))
    errors = (track.pose - [compose(pose(stamp), offset) for stamp in track.time]) * IN_MM_AND_DEGREES
    assert len(errors) == len(frames) and np.all(np.sqrt(np.mean(errors**2, axis=0)) < 0.3)
    assert track.pose[-1, 2] - track.pose[0, 2] > 0.4


def observed(scenes, seed=10, period=0.1, **settings):
    """Perception after scenes, each of them in one frame, and its observations."""
    rng, perception = np.random.default_rng(seed), Perception(CAMERA, PerceptionSettings(**settings))
    return perception, [perception.observe(render(scene, rng=rng, stamp=period * i)) for i, scene in enumerate(scenes)]


def test_two_objects_keep_their_ids_and_the_occupancy_comes_at_its_own_rate():
    _, seen = observed([[*hammer(FIRST), Prism(rectangle(-0.2, 0.1, -0.1, 0.18), 0.05)]] * 5, rest_frames=2, occupancy_period=0.15)
    assert list(seen[1].new_shapes) == ["o1", "o2"]
    assert [len(one.objects) for one in seen] == [0, 0, 2, 2, 2]
    assert [one.occupancy is not None for one in seen] == [True, False, True, False, True]
    assert [polygon_area(shape.outline) for shape in seen[1].new_shapes.values()] == pytest.approx([0.008, 0.00712], rel=0.05)
    assert seen[0].counts["not_at_rest"] == 2 and seen[-1].why_no_pose() == ""


def test_a_moving_object_is_not_registered():
    _, seen = observed([hammer(np.add(FIRST, (0.006 * i, 0.0, 0.0))) for i in range(5)], rest_frames=3)
    assert not any(one.new_shapes or one.objects for one in seen)


def test_an_object_moved_by_hand_is_reported_lost_and_then_found_under_its_id_at_any_yaw():
    for there in ([-0.12, 0.12, -1.0], [-0.1, 0.1, 2.7]):
        _, seen = observed([hammer(FIRST)] * 3 + [[]] + [hammer(there)] * 2, rest_frames=2)
        before, lost, found = (seen[i].objects[0] for i in (2, 3, 5))
        assert before.status is TrackStatus.TRACKED and lost.status is TrackStatus.POOR_FIT and lost.pose is None
        assert "object o1" in seen[3].why_no_pose() and found.object_id == "o1"
        expected = compose(there, compose(inverse(FIRST), before.pose))
        assert np.all(np.abs(error_of(found.pose, expected)) < [1e-3, 1e-3, 1e-2])


@pytest.mark.parametrize(
    ("turn", "places", "found"),
    [
        (0.3, [(0.02, 0.0)], 0),
        (1.5, [(0.02, 0.0)], None),  # or by 1.64 the other way round
        (0.0, [(0.03, 0.01), (0.0, 0.16)], 0),
        (0.0, [(0.0, -0.14), (0.0, 0.15)], None),
    ],
    ids=["turned a little", "a quarter turn", "one near and one far", "two as far"],
)
def test_a_lost_symmetric_object_is_found_only_where_place_and_heading_are_certain(turn, places, found):
    there = [box(FIRST[0] + x, FIRST[1] + y, 0.12, 0.06, 0.05, FIRST[2] + turn) for x, y in places]
    _, seen = observed([[box(*FIRST[:2], 0.12, 0.06, 0.05, FIRST[2])]] * 4 + [[]] + [there] * 3, rest_frames=3)
    known = seen[7].objects[0]
    assert (known.pose is None) == (found is None)
    if found is not None:
        moved = np.array([*places[found], turn])
        assert np.all(np.abs(error_of(known.pose, seen[3].objects[0].pose + moved)) < [2e-3, 2e-3, 3e-2])


def test_a_lost_object_that_is_beside_two_segments_is_in_one_place():
    """A rod, as an arm, passes over it: both its segment and that of the rod lead to it."""
    parts = (0.12, 0.06, 0.05, 0.0, 0.0), (0.4, 0.012, 0.01, np.pi / 2, 0.15)
    there, rod = (box(0.06, -0.05, *size, FIRST[2] + turn, bottom) for *size, turn, bottom in parts)
    _, seen = observed([[box(*FIRST[:2], 0.12, 0.06, 0.05, FIRST[2])]] * 4 + [[]] + [[there, rod]] * 3, rest_frames=3)
    moved = seen[7].objects[0].pose - seen[3].objects[0].pose
    assert np.all(np.abs(moved - (0.03, -0.03, 0.0)) < [2e-3, 2e-3, 1e-2])


def test_a_lost_object_is_not_looked_for_elsewhere_while_something_is_at_its_place():
    """Another one like it is there as well; when its place is empty, that is where it went."""
    first, elsewhere = box(*FIRST[:2], 0.12, 0.06, 0.05, FIRST[2]), box(FIRST[0], FIRST[1] + 0.16, 0.12, 0.06, 0.05, FIRST[2])
    tipped = box(*FIRST[:2], 0.07, 0.06, 0.12, FIRST[2])
    _, seen = observed([[first]] * 4 + [[tipped, elsewhere]] * 3 + [[elsewhere]] * 3, rest_frames=3)
    assert seen[3].objects[0].pose is not None
    assert all(one.objects[0].pose is None for one in seen[4:7]) and seen[-1].objects[0].pose is not None


def test_noise_of_poses_is_no_velocity():
    """A prediction along it would start each fit from somewhere else."""
    known = tracker.TrackedObject(None, 0.01, np.zeros(3), 0.0)
    fit = PoseFit(TrackStatus.TRACKED, np.array([1e-3, 1e-3, 0.1]), np.eye(3), 999, 1.0, 0.0, np.diag(np.square([1e-4, 8e-4, 0.05])))
    known.accept(fit, 0.1)
    assert known.velocity == pytest.approx((0.0098, 0.0, 0.5))


def test_a_thing_of_another_height_is_not_the_lost_object():
    there = [box(FIRST[0], FIRST[1] + 0.1, 0.12, 0.06, 0.08, FIRST[2])]
    _, seen = observed([[box(*FIRST[:2], 0.12, 0.06, 0.05, FIRST[2])]] * 4 + [[]] + [there] * 2, rest_frames=3)
    assert seen[3].objects[0].pose is not None and seen[6].objects[0].pose is None


def test_an_object_at_rest_of_which_a_part_is_missing_is_not_taken_for_one_that_was_turned():
    """Turned by half a turn it would fit: a missing part and an outline that was wrong look alike."""
    notched = np.array([(-0.06, -0.04), (0.06, -0.04), (0.06, 0.01), (0.03, 0.01), (0.03, 0.04), (-0.06, 0.04)])
    _, seen = observed([[Prism(notched, 0.05)]] * 4 + [[Prism(-notched, 0.05)]] * 4, rest_frames=3)
    assert seen[3].objects[0].pose is not None
    assert all(one.objects[0].status is TrackStatus.PART_MISSING for one in seen[5:])


def test_time_going_back_drops_what_was_known():
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=1))
    frame = render(hammer(FIRST), rng=np.random.default_rng(13), stamp=5.0)
    assert perception.observe(frame).new_shapes
    with pytest.raises(FrameError, match="repeats the stamp 5.000000"):
        perception.observe(frame)
    again = perception.observe(DepthFrame(1.0, frame.depth, INTRINSICS))
    assert again.restarted and list(again.new_shapes) == ["o1"]


def test_poses_go_on_while_the_robot_covers_the_table():
    covers = [Prism(rectangle(-0.5, y, 0.3, y + 0.35), 0.2, 0.15) for y in (-0.5, 0.12)]
    covers.append(Prism(rectangle(0.12, -0.5, 0.4, 0.5), 0.2, 0.15))
    _, seen = observed([hammer(FIRST), [*hammer(FIRST), *covers]], rest_frames=1, occupancy_period=0.1)
    assert seen[1].counts["table_hidden"] == 1 and seen[1].objects[0].status is TrackStatus.TRACKED


def test_reasons_are_given_when_nothing_comes_out():
    perception, (seen,) = observed([[]])
    assert "higher than min_object_height" in seen.why_no_pose()
    with pytest.raises(PerceptionError, match="0 valid of 307200"):
        perception.observe(DepthFrame(1.0, BLIND.depth, INTRINSICS))
    with pytest.raises(PerceptionError, match="No object was found in 2 depth frames: nothing on the table"):
        observe_offline([render([], stamp=0.1 * i) for i in range(2)], CAMERA)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"workspace_low": (0.1, 0.1), "workspace_high": (0.0, 0.2)}, "low must be below high"),
        ({"min_object_height": 0.6}, "0 < min < max"),
        ({"tool_reach": (0.09, 0.01)}, "tool_reach"),
        ({"rest_frames": 0}, "at least 1"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(wrong, why):
    with pytest.raises(InputError, match=why):
        PerceptionSettings(**wrong)


HAMMER_AT = np.array([0.1, 0.1, 0.4])
BOX = Prism(rectangle(-0.15, -0.15, -0.07, -0.09), 0.05)
NEW = Prism(rectangle(-0.15, 0.05, -0.07, 0.12), 0.05)


@pytest.fixture
def calls(monkeypatch):
    """How often each frame calls what is slow, by function; the entry of a frame is added by who observes it."""
    counted = [Counter()]

    def count_calls(owner, name):
        function = getattr(owner, name)

        def call(*args):
            counted[-1][name] += 1
            return function(*args)

        monkeypatch.setattr(owner, name, call)

    for owner, name in ((search, "cover_hollows"), (search, "find_segments"), (tracker, "compare_upper_side"), (occupancy, "top_down")):
        count_calls(owner, name)
    count_calls(table.TableCamera, "check_plane")
    return counted


def test_no_frame_of_a_usual_camera_does_two_slow_things_and_a_new_thing_is_seen_soon(calls):
    perception, rng, stamps = Perception(CAMERA, SETTINGS), np.random.default_rng(3), count(1)

    def see(*more):
        calls.append(Counter())
        return perception.observe(render([*hammer(HAMMER_AT), BOX, *more], rng=rng, stamp=next(stamps) / 30))

    while not see().new_shapes:
        assert len(calls) < 10
    assert len(see().objects) == 2
    calls.clear()
    assert not any(see().refused for _ in range(45))
    slow = ("cover_hollows", "find_segments", "top_down", "check_plane")
    assert max(sum(of_frame[name] for name in slow) for of_frame in calls) == 1
    assert max(of_frame["compare_upper_side"] for of_frame in calls) == 1
    total = sum(calls, Counter())
    assert all(total[name] >= least for name, least in zip(slow, (4, 4, 1, 1), strict=True))
    checked = [n for n, of_frame in enumerate(calls) if of_frame["compare_upper_side"]]
    assert len(checked) >= 2 * 4 and max(np.diff(checked)) * 1000 / 30 <= 2 * 250  # two objects, each about four times a second
    calls.clear()
    latest = 0.25 + 5 / 30  # a search period and what a search takes [s]
    while not see(NEW).refused:
        assert len(calls) / 30 <= latest
    while not see(NEW).new_shapes:
        assert len(calls) / 30 <= (SETTINGS.rest_frames + 1) * latest + 1 / 30
