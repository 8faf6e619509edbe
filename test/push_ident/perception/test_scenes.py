"""Several objects, several views, the robot in the picture: what belongs to which object, and what to none."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER_OUTLINE, Prism, box, circle, hammer, look_at, rectangle, render
from push_ident.errors import InputError
from push_ident.geometry.arm_shape import ArmShape
from push_ident.geometry.outline import dense, signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points
from push_ident.perception.frame.robot import Cylinder, RobotHistory
from push_ident.perception.frame.view import OBJECT, ROBOT, FrameView, height_inside, in_robot
from push_ident.perception.pipeline import Perception
from push_ident.perception.refusals import Reason
from push_ident.perception.search.segments import find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident_sim.cell.robot import HOME, robot_description

FIRST = np.array([0.03, -0.02, 0.4])
TALL = PerceptionSettings(max_object_height=0.3)


def noisy_view(prisms, settings=TALL, seed=0):
    return FrameView(render(prisms, rng=np.random.default_rng(seed)), CAMERA, settings=settings)


# Objects that touch


@pytest.mark.parametrize(
    ("prisms", "n_whole"),
    [
        ([box(0.0, 0.0, 0.06, 0.2, 0.20), box(0.07, 0.02, 0.08, 0.1, 0.08)], 1),
        ([box(0.0, 0.0, 0.2, 0.15, 0.06), box(-0.02, 0.01, 0.08, 0.08, 0.05, 0.5, bottom=0.06)], 0),
        ([box(-0.03, -0.1, 0.12, 0.12, 0.05), Prism(circle(0.04), 0.12).at((-0.03, 0.0, 0.0))], 0),
    ],
    ids=["a box before a taller one", "a box on a box", "a cup beside a box"],
)
def test_touching_objects_are_separated_by_steps_and_folds(prisms, n_whole):
    segments, counts = find_segments(noisy_view(prisms))
    assert counts["segments"] == 2
    # The one in the way of the other is whole; of the other some may be hidden.
    assert sum(segment.whole for segment in segments) >= n_whole
    assert (Reason.STACKED in [segment.fault for segment in segments]) == (prisms[1].bottom > 0)
    for segment in segments:
        assert min(np.linalg.norm(segment.centre - prism.polygon.mean(axis=0)) for prism in prisms) < 0.06


@pytest.mark.parametrize(("head", "n_segments"), [(0.032, 1), (0.06, 2)])
def test_the_shadow_of_a_step_of_an_object_does_not_divide_it(head, n_segments):
    """Nothing is measured on the handle beside the head, which a projector on the other side does not light."""
    view = noisy_view([box(0.0, 0.0, 0.2, 0.03, 0.02), box(0.12, 0.0, 0.04, 0.1, head)])
    depth, points = view.frame.depth.copy(), view.points
    depth[(points[..., 0] > 0.095) & (points[..., 0] < 0.1) & (points[..., 2] > 0.012)] = np.nan
    shadowed = replace(view, frame=replace(view.frame, depth=depth))
    segments, counts = find_segments(shadowed)
    assert counts["segments"] == n_segments
    assert n_segments == 2 or np.ptp(segments[0].points_in(shadowed.points)[:, 0]) > 0.23


# Several views


def outline_error(traced, truth):
    points = dense(transform_points(traced.pose, traced.shape.outline))
    return float(np.sqrt(np.mean(signed_distance(points, transform_points(truth, HAMMER_OUTLINE)) ** 2)))


SIDE = look_at((0.0, -0.6, 0.8), (0.0, 0.0, 0.0))
N_REST = 4


def rest(camera, yaw, seed):
    """Frames of the hammer at rest."""
    rng = np.random.default_rng(seed)
    return [render(hammer((0.03, -0.02, yaw)), camera, rng=rng, stamp=i / 30) for i in range(N_REST)]


def registered(main, side, side_camera=SIDE, robot=()):
    """Shape and pose of the hammer, and why the second camera was left out."""
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=N_REST))
    for frame in side:
        perception.add_further_view("side", frame, side_camera, robot)
    for frame in main:
        observation = perception.observe(frame)
    return SimpleNamespace(shape=observation.new_shapes["o1"], pose=perception.first_pose("o1")), observation.further_views


def moved(shift=(0.0, 0.0, 0.0), yaw=0.0):
    camera = np.eye(4)
    camera[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    camera[:3, 3] = shift
    return camera @ SIDE


@pytest.fixture(scope="module")
def two_cameras():
    """Frames of both, the outline from the main one alone, and from both."""
    main, side = rest(CAMERA, 0.4, 7), rest(SIDE, 0.4, 8)
    return SimpleNamespace(main=main, side=side, single=registered(main, []), both=registered(main, side))


def test_a_further_camera_shows_what_a_taller_part_hides_from_the_main_one():
    errors = []
    for yaw in (0.0, 1.6, 3.2, 4.8):
        main, side = rest(CAMERA, yaw, 1), rest(SIDE, yaw, 2)
        (single, nothing), (both, left_out) = registered(main, []), registered(main, side)
        assert nothing == {} and left_out == {"side": ""}
        errors.append([outline_error(traced, np.array([0.03, -0.02, yaw])) for traced in (single, both)])
    single_m, both_m = np.sqrt(np.mean(np.square(errors), axis=0))
    assert both_m < 0.9 * single_m and both_m < 0.0003, errors


def test_extrinsics_of_a_further_camera_may_have_errors_of_millimetres(two_cameras):
    both, left_out = registered(two_cameras.main, two_cameras.side, moved((0.003, -0.002, 0.008)))
    assert left_out == {"side": ""}
    assert outline_error(both, FIRST) == pytest.approx(outline_error(two_cameras.both[0], FIRST), abs=5e-5)


@pytest.mark.parametrize(
    ("camera", "change", "robot", "why"),
    [
        (moved((0.008, 0.0, 0.0)), {}, (), "8.. mm and 0.. degrees from its pose in the main camera"),
        (moved((0.0, 0.1, 0.0)), {}, (), "None of 1 segments lies where"),
        (moved((0.0, 0.0, 0.04)), {}, (), "40 mm from its place in the extrinsics"),
        (SIDE, {"focal": 0.97}, (), "farthest edge of the object is"),
        (SIDE, {"delay": 3.0}, (), "0 depth frames show .* the latest is from 3.00 s before"),
        (SIDE, {"depth": np.nan}, (), "0 valid"),
        (SIDE, {}, (Cylinder(0.09, 0.0, 0.02),), "beside the robot"),
    ],
)
def test_a_further_camera_that_disagrees_is_left_out_with_the_reason(two_cameras, camera, change, robot, why):
    factor, side = change.get("focal", 1.0), []
    for frame in two_cameras.side:
        intrinsics = replace(frame.intrinsics, fx=factor * frame.intrinsics.fx, fy=factor * frame.intrinsics.fy)
        stamp, depth = frame.stamp - change.get("delay", 0.0), frame.depth * np.float32(change.get("depth", 1.0))
        side.append(replace(frame, stamp=stamp, depth=depth, intrinsics=intrinsics))
    traced, left_out = registered(two_cameras.main, side, camera, robot)
    assert re.search(why, left_out["side"]), left_out
    np.testing.assert_array_equal(traced.shape.outline, two_cameras.single[0].shape.outline)


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


def test_links_are_where_the_joint_states_put_them_and_a_low_one_is_robot_and_no_object():
    base, upper, finger = ArmShape(ARM, link_radius=0.03).at({"turn": 0.0, "bend": np.pi / 2, "other": 1.0})
    assert base.radius == pytest.approx(0.05 * np.sqrt(2)) and base.lowest < 0
    np.testing.assert_allclose([upper.start, upper.end], [[-0.53, 0, 0.1], [-0.07, 0, 0.1]], atol=1e-9)
    np.testing.assert_allclose(sorted([finger.start[1], finger.end[1]]), [0.0, 0.2], atol=1e-7)
    np.testing.assert_allclose([finger.start[0], finger.start[2]], [-0.1, 0.06], atol=1e-7)
    inside = in_robot(np.array([[-0.1, 0.1, 0.06], [-0.1, 0.1, 0.08], [-0.1, 0.22, 0.06], [-0.1, 0.19, 0.07]], np.float32), [finger], 0.002)
    assert inside.tolist() == [True, False, False, True]
    # The finger is 40 mm over the table.
    blind = noisy_view([*hammer(FIRST), Prism(rectangle(-0.115, 0.0, -0.085, 0.2), 0.075, 0.045)])
    masked, points = replace(blind, robot=(base, upper, finger)), blind.points
    over = (np.abs(points[..., 0] + 0.1) < 0.012) & (np.abs(points[..., 1] - 0.1) < 0.09) & (points[..., 2] > 0.05)
    assert np.count_nonzero(over) > 200
    assert np.mean(blind.labels[over] == OBJECT) > 0.95 and np.mean(masked.labels[over] == ROBOT) > 0.95


@pytest.mark.parametrize(("urdf", "why"), [(ARM.replace('"table"', '"world"'), "no link `table`"), ("<robot", "not a valid URDF")])
def test_a_description_that_is_not_rooted_in_the_table_is_refused(urdf, why):
    with pytest.raises(InputError, match=why):
        ArmShape(urdf)


# Following


def followed(**settings):
    """Perception of a hammer at rest, what observes the next scene, and the offset of its object frame."""
    rng, perception, stamp = np.random.default_rng(6), Perception(CAMERA, PerceptionSettings(rest_frames=2, **settings)), 0.0

    def observe(prisms, step=0.1):
        nonlocal stamp
        stamp += step
        return next(iter(perception.observe(render(prisms, rng=rng, stamp=stamp)).objects), None)

    for _ in range(3):
        known = observe(hammer(FIRST))
    return observe, compose(inverse(FIRST), known.pose)


def distance(known, pose):
    return np.linalg.norm((known.pose - pose)[:2])


def test_behind_the_arm_a_pose_is_right_or_not_reported():
    """An arm across the table passes over an object that slides and turns: in some of the frames too much of it is hidden."""
    rng, (observe, offset), n_poses = np.random.default_rng(10), followed(), 0
    velocity, angle, width = rng.uniform(-1, 1, 3) * (0.004, 0.004, 0.04), rng.uniform(0, np.pi), rng.uniform(0.06, 0.2)
    begin, speed = rng.uniform(-0.15, 0.15), rng.uniform(-0.02, 0.02)
    for i in range(22):
        pose = FIRST + (i + 1) * velocity
        middle = compose(FIRST, (-0.02, 0, 0))[:2] + (0.09, 0) + (begin + speed * i) * np.array([-np.sin(angle), np.cos(angle)])
        known = observe([*hammer(pose), box(*middle, 0.8, width, 0.1, angle, bottom=0.15)], 1 / 15)
        if known.pose is not None:
            n_poses += 1
            assert distance(known, compose(pose, offset)) < 0.0015 and abs(known.pose[2] - compose(pose, offset)[2]) < 0.02
    assert 0 < n_poses < 22


@pytest.mark.parametrize("along", [-0.08, 0.03])
def test_an_object_put_elsewhere_half_hidden_has_the_right_pose_or_none_and_the_right_one_once_uncovered(along):
    observe, offset = followed(search_period=0.0)
    moved = np.array([-0.05, 0.1, 2.2])
    shelf = Prism(rectangle(-0.09, -0.06, 0.09, 0.06) + compose(moved, (along, 0.0, 0.0))[:2] + (0.08, 0.0), 0.22, 0.2)
    for _ in range(3):
        known = observe([*hammer(moved), shelf])
        assert known.pose is None or distance(known, compose(moved, offset)) < 0.003
    for _ in range(2):
        known = observe(hammer(moved))
    assert known.pose is not None and distance(known, compose(moved, offset)) < 0.001


def test_height_inside_an_outline_is_that_of_its_points_alone() -> None:
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 81), np.linspace(-0.2, 0.2, 81))
    points = np.stack([x, y, np.where((np.abs(x) < 0.06) & (np.abs(y) < 0.04), 0.05, 0.0)], axis=-1).astype(np.float32)
    points[:10] = np.nan
    outline = rectangle(-0.05, -0.03, 0.05, 0.03)
    assert height_inside(points, outline) == pytest.approx(0.05)
    assert height_inside(points, outline + 0.12) == 0.0 and height_inside(points, outline + 1.0) is None


NAMES = [f"lbr_iiwa_joint_{number}" for number in range(1, 8)]


@pytest.fixture
def history() -> RobotHistory:
    return RobotHistory(tool_radius=0.018, tool_length=0.08)


def test_tool_and_hand_are_interpolated_between_poses_and_held_outside(history: RobotHistory) -> None:
    assert history.tool_at(1.0, 0.09) == () and history.tool_age(1.0) is None
    history.add_tool(1.0, np.array([0.1, 0.2, 0.3]))
    history.add_tool(2.0, np.array([0.2, 0.0, 0.1]))
    tool, hand = history.tool_at(1.25, 0.09)
    assert isinstance(tool, Cylinder) and isinstance(hand, Cylinder)
    assert (tool.x, tool.y, tool.z_min, tool.radius) == pytest.approx((0.125, 0.15, 0.25, 0.018))
    assert (hand.x, hand.y, hand.z_min, hand.radius) == pytest.approx((0.125, 0.15, 0.33, 0.09))
    assert history.tool_at(9.0, 0.09)[0].x == 0.2 and history.tool_at(0.0, 0.09)[0].x == 0.1 and history.tool_age(2.5) == 0.5
    history.add_tool(0.5, np.ones(3))  # time set back
    assert history.tool_age(0.5) == 0.0 and history.tool_at(5.0, 0.1)[0].x == 1.0


def test_joints_are_interpolated_between_states_and_held_outside(history: RobotHistory) -> None:
    assert history.joints_at(1.0) == {} and history.joints_age(1.0) is None
    for stamp, value in ((1.0, 0.0), (2.0, 1.0), (3.0, 0.0)):
        history.add_joints(stamp, ["a", "b"], np.array([value, -value]))
        assert history.joints_at(9.0) == {"a": value, "b": -value}
    for stamp, value in ((0.0, 0.0), (1.75, 0.75), (2.0, 1.0), (2.25, 0.75)):
        assert history.joints_at(stamp) == pytest.approx({"a": value, "b": -value})
    history.add_joints(4.0, ["finger"], np.ones(1))  # of a gripper, in turn with the arm
    assert history.joints_at(2.0) == {"a": 1.0, "b": -1.0, "finger": 1.0} and history.joints_age(5.0) == 2.0
    history.add_joints(2.0, ["a", "b"], np.zeros(2))  # time set back
    for position in ([0.0], [0.0, np.nan]):
        with pytest.raises(InputError, match="positions for 2 joints"):
            history.add_joints(1.0, ["a", "b"], np.array(position))
    assert history.joints_at(9.0) == {"a": 0.0, "b": 0.0, "finger": 1.0}


CHAIN = """<robot name="r"><link name="table"/>{links}
<joint name="turn" type="{kind}"><parent link="table"/><child link="a"/><origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>{limit}</joint>
<joint name="bend" type="{kind}"><parent link="a"/><child link="b"/><origin xyz="0.5 0 0"/><axis xyz="0 0 1"/>{limit}{mimic}</joint>
</robot>"""
LINK = """<link name="{}"><collision><origin xyz="0.25 0 0" rpy="0 1.570796 0"/><geometry><cylinder radius="0.05" length="0.5"/></geometry>
</collision></link>"""
LIMIT = '<limit lower="-3" upper="3" velocity="1" effort="10"/>'


def test_links_behind_a_joint_without_a_state_are_not_placed_and_named() -> None:
    links = LINK.format("a") + LINK.format("b")
    for kind, limit in (("revolute", LIMIT), ("continuous", "")):
        shape = ArmShape(CHAIN.format(links=links, kind=kind, limit=limit, mimic=""))
        assert shape.at({}) == [] and shape.joints_without({}) == ["turn", "bend"]
        (first,) = shape.at({"turn": np.pi / 2, "finger": 1.0})
        np.testing.assert_allclose([first.start, first.end], [[0, 0, 0.1], [0, 0.5, 0.1]], atol=1e-4)
        assert shape.joints_without({"turn": 0.0}) == ["bend"]
        _, second = shape.at({"turn": np.pi / 2, "bend": np.pi / 2})
        np.testing.assert_allclose([second.start, second.end], [[0, 0.5, 0.1], [-0.5, 0.5, 0.1]], atol=1e-4)
    floating = ArmShape(CHAIN.format(links=links, kind="floating", limit="", mimic=""))
    assert floating.at({"turn": 1.0, "bend": 1.0}) == [] and floating.joints_without({"turn": 1.0, "bend": 1.0}) == ["turn", "bend"]
    with pytest.raises(InputError, match="not a valid URDF"):
        ArmShape(CHAIN.format(links=links, kind="revolute", limit=LIMIT, mimic='<mimic joint="turn" multiplier="half"/>'))
    mimic = '<mimic joint="turn" multiplier="-1" offset="0.5"/>'
    follows = ArmShape(CHAIN.format(links=links, kind="revolute", limit=LIMIT, mimic=mimic))
    _, second = follows.at({"turn": 0.5})
    np.testing.assert_allclose(second.end - second.start, [0.5 * np.cos(0.5), 0.5 * np.sin(0.5), 0.0], atol=1e-4)


def test_links_of_the_arm_follow_the_joints_and_those_above_every_object_are_left_out(history: RobotHistory) -> None:
    assert history.arm_at(1.0, 10.0) == ()
    history.arm_shape = shape = ArmShape(robot_description())
    history.add_joints(1.0, NAMES, np.array(HOME))
    history.add_joints(2.0, NAMES, np.array([0.5, *HOME[1:]]))
    everything, expected = history.arm_at(1.5, 10.0), shape.at(dict(zip(NAMES, [0.25, *HOME[1:]], strict=True)))
    assert len(everything) == len(expected) > 3
    for rod, other in zip(everything, expected, strict=True):
        assert rod.start == pytest.approx(other.start) and rod.end == pytest.approx(other.end)
    assert history.unknown_joints == []
    history.add_joints(1.6, ["finger_joint"], np.zeros(1))
    assert len(history.arm_at(1.5, 10.0)) == len(expected)
    low = history.arm_at(1.5, 0.12)
    assert 0 < len(low) < len(everything) and all(rod.lowest < 0.12 for rod in low)
