"""Several objects, several views, the robot in the picture: what belongs to which object, and what to none."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER, HAMMER_OUTLINE, Prism, circle, look_at, rectangle, render
from push_ident.errors import InputError, PerceptionError
from push_ident.geometry.arm_shape import ArmShape
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.frame.view import OBJECT, ROBOT, FrameView, height_inside, in_robot, median_frame, points_in_table
from push_ident.perception.known_object import SegmentedView, TrackStatus
from push_ident.perception.outline.edges import fuse_views
from push_ident.perception.outline.tracing import trace_object
from push_ident.perception.pipeline import Perception
from push_ident.perception.refusals import Reason
from push_ident.perception.search.segments import find_segments
from push_ident.perception.settings import PerceptionSettings

FIRST = np.array([0.03, -0.02, 0.4])
TALL = PerceptionSettings(max_object_height=0.3)


def segments_of(prisms, *, settings=TALL, seed=0, camera=CAMERA):
    return find_segments(FrameView(render(prisms, camera, rng=np.random.default_rng(seed)), camera, settings=settings))


def box(x, y, width, depth, height, yaw=0.0, bottom=0.0):
    return Prism(rectangle(-width / 2, -depth / 2, width / 2, depth / 2), bottom + height, bottom).at((x, y, yaw))


# Objects that touch


@pytest.mark.parametrize(
    ("name", "prisms", "n_whole"),
    [
        ("a box before a taller one", [box(0.0, 0.0, 0.06, 0.2, 0.20), box(0.07, 0.02, 0.08, 0.1, 0.08)], 1),
        ("a box on a box", [box(0.0, 0.0, 0.2, 0.15, 0.06), box(-0.02, 0.01, 0.08, 0.08, 0.05, 0.5, bottom=0.06)], 0),
        ("a cup beside a box", [box(-0.03, -0.1, 0.12, 0.12, 0.05), Prism(circle(0.04), 0.12).at((-0.03, 0.0, 0.0))], 0),
    ],
)
def test_touching_objects_are_separated_by_steps_and_folds(name, prisms, n_whole):
    segments, counts = segments_of(prisms)
    assert counts["segments"] == 2, name
    # The one in the way of the other is whole; of the other some may be hidden.
    assert sum(segment.whole for segment in segments) >= n_whole
    assert (Reason.STACKED in [segment.fault for segment in segments]) == (name == "a box on a box")
    for segment in segments:
        centres = [prism.polygon.mean(axis=0) for prism in prisms]
        assert min(np.linalg.norm(segment.centre - centre) for centre in centres) < 0.06


@pytest.mark.parametrize("yaw", np.arange(8) * 0.8)
def test_a_step_lower_than_min_step_is_part_of_one_object(yaw):
    _, counts = segments_of([prism.at((0.02, 0.01, yaw)) for prism in HAMMER], settings=PerceptionSettings())
    assert counts["segments"] == 1


@pytest.mark.parametrize(("head", "n_segments"), [(0.032, 1), (0.06, 2)])
@pytest.mark.parametrize("shadow", [0.002, 0.005])
def test_the_shadow_of_a_step_of_an_object_does_not_divide_it(head, n_segments, shadow):
    """Nothing is measured on the handle beside the head, which a projector on the other side does not light."""
    frame = render([box(0.0, 0.0, 0.2, 0.03, 0.02), box(0.12, 0.0, 0.04, 0.1, head)], CAMERA, rng=np.random.default_rng(0))
    points = points_in_table(frame, CAMERA)
    depth = frame.depth.copy()
    depth[(points[..., 0] > 0.1 - shadow) & (points[..., 0] < 0.1) & (points[..., 2] > 0.012)] = np.nan
    shadowed = FrameView(replace(frame, depth=depth), CAMERA, settings=TALL)
    segments, counts = find_segments(shadowed)
    assert counts["segments"] == n_segments
    if n_segments == 1:
        assert np.ptp(segments[0].points_in(shadowed.points)[:, 0]) > 0.23


# Several views


def outline_error(traced, truth):
    outline = transform_points(traced.pose, traced.shape.outline)
    share = np.linspace(0, 1, 40, endpoint=False)[:, None]
    edge = np.roll(outline, -1, axis=0) - outline
    points = (outline[:, None] + share * edge[:, None]).reshape(-1, 2)
    weight = np.repeat(np.linalg.norm(edge, axis=1), 40)
    return float(np.sqrt(np.average(signed_distance(points, transform_points(truth, HAMMER_OUTLINE)) ** 2, weights=weight)))


def median_view(pose, camera, rng, n=4):
    frames = [render([prism.at(pose) for prism in HAMMER], camera, rng=rng) for _ in range(n)]
    return FrameView(median_frame(frames), camera, noise=0.0006)


def first_sight(rng):
    view = median_view(FIRST, CAMERA, rng)
    segments, _ = find_segments(view)
    traced = trace_object([SegmentedView(view, segments[0])], min_height=0.008, cell_count=80)
    return traced, (view, traced.pose)


def test_a_second_camera_and_other_poses_make_the_outline_better():
    rng = np.random.default_rng(1)
    traced, first = first_sight(rng)
    single = fuse_views(traced, [first], pose_known=True)
    other_side = look_at((-0.35, 0.45, 0.8), (0.0, 0.0, 0.0))
    views = [first, (median_view(FIRST, other_side, rng), traced.pose)]
    for change in ((0.05, 0.03, 0.9), (-0.06, 0.02, 2.0)):
        moved = compose(FIRST, change)
        near = compose(moved, compose(inverse(FIRST), traced.pose)) + rng.normal(size=3) * (0.003, 0.003, 0.03)
        views.append((median_view(moved, CAMERA, rng), near))
    together = fuse_views(traced, views, pose_known=True)
    errors = [outline_error(found, FIRST) for found in (traced, single, together)]
    assert errors[1] < errors[0] and errors[2] < errors[0]
    assert errors[1] < 0.0005 and errors[2] < 0.0005
    assert len(together.shape.outline) <= 12


def test_views_are_needed_and_must_show_the_object():
    traced, first = first_sight(np.random.default_rng(4))
    with pytest.raises(InputError, match="no views"):
        fuse_views(traced, [])
    with pytest.raises(PerceptionError, match="in none of 1 views"):
        fuse_views(traced, [(first[0], np.array([0.2, 0.2, 0.0]))])


SIDE = look_at((0.0, -0.6, 0.8), (0.0, 0.0, 0.0))
N_REST = 4


def rest(camera, yaw, seed, *things):
    """Frames of the hammer at rest, and of other things."""
    rng = np.random.default_rng(seed)
    pose = np.array([0.03, -0.02, yaw])
    return [render([*(prism.at(pose) for prism in HAMMER), *things], camera, rng=rng, stamp=i / 30) for i in range(N_REST)]


@pytest.fixture(scope="module")
def from_main():
    return rest(CAMERA, 0.4, 7)


@pytest.fixture(scope="module")
def from_side():
    return rest(SIDE, 0.4, 8)


def registered(main, side, side_camera=SIDE, robot=()):
    """Shape and pose of the hammer, and why the second camera was left out."""
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=N_REST))
    for frame in side:
        perception.add_further_view("side", frame, side_camera, robot)
    for frame in main:
        observation = perception.observe(frame)
    return SimpleNamespace(shape=observation.new_shapes["o1"], pose=perception.first_pose("o1")), observation.further_views


def test_a_further_camera_shows_what_a_taller_part_hides_from_the_main_one():
    errors = []
    for yaw in (0.0, 1.6, 3.2, 4.8):
        main, side = rest(CAMERA, yaw, 1), rest(SIDE, yaw, 2)
        (single, nothing), (both, left_out) = registered(main, []), registered(main, side)
        assert nothing == {} and left_out == {"side": ""}
        errors.append([outline_error(traced, np.array([0.03, -0.02, yaw])) for traced in (single, both)])
    single_m, both_m = np.sqrt(np.mean(np.square(errors), axis=0))
    assert both_m < 0.8 * single_m and both_m < 0.0003, errors


def test_extrinsics_of_a_further_camera_may_have_errors_of_millimetres(from_main, from_side):
    error = np.array([0.003, -0.002, 0.008])
    camera = SIDE.copy()
    camera[:3, 3] += error
    (both, left_out), (exact, _) = registered(from_main, from_side, camera), registered(from_main, from_side)
    assert left_out == {"side": ""}
    assert outline_error(both, FIRST) == pytest.approx(outline_error(exact, FIRST), abs=5e-5)


def moved(shift=(0.0, 0.0, 0.0), yaw=0.0):
    camera = np.eye(4)
    camera[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    camera[:3, 3] = shift
    return camera @ SIDE


def another_focal_length(frame):
    return replace(frame, intrinsics=replace(frame.intrinsics, fx=0.97 * frame.intrinsics.fx, fy=0.97 * frame.intrinsics.fy))


@pytest.mark.parametrize(
    ("camera", "change", "robot", "why"),
    [
        (moved((0.008, 0.0, 0.0)), None, (), "8.. mm and 0.. degrees from its pose in the main camera"),
        (moved((0.0, 0.1, 0.0)), None, (), "None of 1 segments lies where"),
        (moved(yaw=1.5), None, (), "None of 1 segments lies where"),
        (moved((0.0, 0.0, 0.04)), None, (), "40 mm from its place in the extrinsics"),
        (SIDE, another_focal_length, (), "farthest edge of the object is"),
        (SIDE, lambda frame: replace(frame, stamp=frame.stamp - 3.0), (), "0 depth frames show .* the latest is from 3.00 s before"),
        (SIDE, lambda frame: replace(frame, depth=np.full_like(frame.depth, np.nan)), (), "0 valid"),
        (SIDE, None, (Cylinder(0.09, 0.0, 0.02),), "beside the robot"),
    ],
)
def test_a_further_camera_that_disagrees_is_left_out_with_the_reason(from_main, from_side, camera, change, robot, why):
    traced, left_out = registered(from_main, from_side if change is None else [change(frame) for frame in from_side], camera, robot)
    assert re.search(why, left_out["side"]), left_out
    single, _ = registered(from_main, [])
    np.testing.assert_array_equal(traced.shape.outline, single.shape.outline)


# The arm


ARM = """<robot name="arm">
  <link name="table"/>
  <link name="base"><collision><origin xyz="0 0 0.05"/><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <joint name="fixed" type="fixed"><parent link="table"/><child link="base"/><origin xyz="-0.5 0 0"/></joint>
  <link name="upper"><collision><geometry><mesh filename="package://nowhere/upper.stl"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
  <link name="finger"><collision><origin xyz="0.1 0 -0.04" rpy="0 1.5707963 0"/><geometry><cylinder radius="0.015" length="0.2"/></geometry>
    </collision></link>
  <joint name="bend" type="revolute"><parent link="upper"/><child link="finger"/><origin xyz="0.4 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
</robot>"""


def test_links_are_where_the_joint_states_put_them():
    rods = ArmShape(ARM, link_radius=0.03).at({"turn": 0.0, "bend": np.pi / 2, "other": 1.0})
    assert len(rods) == 3
    base, upper, finger = rods
    assert base.radius == pytest.approx(0.05 * np.sqrt(2)) and base.lowest < 0
    np.testing.assert_allclose([upper.start, upper.end], [[-0.53, 0, 0.1], [-0.07, 0, 0.1]], atol=1e-9)
    np.testing.assert_allclose(sorted([finger.start[1], finger.end[1]]), [0.0, 0.2], atol=1e-7)
    np.testing.assert_allclose([finger.start[0], finger.start[2]], [-0.1, 0.06], atol=1e-7)
    inside = in_robot(np.array([[-0.1, 0.1, 0.06], [-0.1, 0.1, 0.08], [-0.1, 0.22, 0.06], [-0.1, 0.19, 0.07]], np.float32), [finger], 0.002)
    assert inside.tolist() == [True, False, False, True]


def test_a_description_that_is_not_rooted_in_the_table_is_refused():
    with pytest.raises(InputError, match="no link `table`"):
        ArmShape(ARM.replace('"table"', '"world"'))
    with pytest.raises(InputError, match="not a valid URDF"):
        ArmShape("<robot")


def test_a_low_link_is_robot_and_not_an_object():
    # A finger of 40 mm height over the table, as the arm's description has it.
    rods = ArmShape(ARM, link_radius=0.03).at({"bend": np.pi / 2})
    finger = Prism(rectangle(-0.115, 0.0, -0.085, 0.2), 0.075, 0.045)
    frame = render([*(prism.at(FIRST) for prism in HAMMER), finger], rng=np.random.default_rng(0))
    points = points_in_table(frame, CAMERA)
    blind, masked = (FrameView(frame, CAMERA, robot).labels for robot in ((), rods))
    over = (np.abs(points[..., 0] + 0.1) < 0.012) & (np.abs(points[..., 1] - 0.1) < 0.09) & (points[..., 2] > 0.05)
    assert np.count_nonzero(over) > 200
    assert np.mean(blind[over] == OBJECT) > 0.95 and np.mean(masked[over] == ROBOT) > 0.95


# Following


def test_dropped_frames_and_a_passing_arm_do_not_lose_the_object():
    rng = np.random.default_rng(5)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=3))
    statuses = []
    for i in range(16):
        # The object slides at 6 cm/s; every third frame is missing, and a forearm passes over it.
        pose = FIRST + np.array([0.002 * max(0, i - 4), 0.0, 0.01 * max(0, i - 4)])
        if i > 4 and i % 3 == 0:
            continue
        arm = [box(0.25 - 0.02 * i, 0.0, 0.06, 0.6, 0.1, bottom=0.2)] if i > 4 else []
        observation = perception.observe(render([*(p.at(pose) for p in HAMMER), *arm], rng=rng, stamp=i / 30))
        statuses += [known.status for known in observation.objects]
    assert statuses.count(TrackStatus.TRACKED) == len(statuses) >= 8


@pytest.mark.parametrize("along", [-0.08, -0.02, 0.03, 0.07])
def test_an_object_put_elsewhere_half_hidden_has_the_right_pose_or_none_and_the_right_one_once_uncovered(along):
    rng = np.random.default_rng(6)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=2, search_period=0.0))
    for i in range(3):
        observation = perception.observe(render([p.at(FIRST) for p in HAMMER], rng=rng, stamp=0.1 * i))
    assert observation.objects[0].pose is not None
    offset = compose(inverse(FIRST), observation.objects[0].pose)
    moved = np.array([-0.05, 0.1, 2.2])
    shelf = Prism(rectangle(-0.09, -0.06, 0.09, 0.06) + compose(moved, (along, 0.0, 0.0))[:2] + (0.08, 0.0), 0.22, 0.2)
    for i in range(3, 6):
        observation = perception.observe(render([*(p.at(moved) for p in HAMMER), shelf], rng=rng, stamp=0.1 * i))
        pose = observation.objects[0].pose
        assert pose is None or np.linalg.norm((pose - compose(moved, offset))[:2]) < 0.003
    for i in range(6, 8):
        observation = perception.observe(render([p.at(moved) for p in HAMMER], rng=rng, stamp=0.1 * i))
    pose = observation.objects[0].pose
    assert pose is not None and np.linalg.norm((pose - compose(moved, offset))[:2]) < 0.001


def test_height_inside_an_outline_is_that_of_its_points_alone() -> None:
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 81), np.linspace(-0.2, 0.2, 81))
    points = np.stack([x, y, np.where((np.abs(x) < 0.06) & (np.abs(y) < 0.04), 0.05, 0.0)], axis=-1).astype(np.float32)
    points[:10] = np.nan
    box = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    assert height_inside(points, box) == pytest.approx(0.05)
    assert height_inside(points, box + 0.12) == 0.0
    assert height_inside(points, box + 1.0) is None
