"""Choice of pushes - random ones, those that a goal asks for, those that bring an object back - and the arm's motion through one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.pushing.motion import ArmPlan, MotionSettings, plan_push, plan_retreat
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.sampling import is_near_edge, push_from_goal, recentring_pushes, sample_push
from push_ident.types import CellGrid, Float64Array, ObjectShape
from push_ident_sim.cell.robot import HOME
from push_ident_sim.objects import make_object

SETTINGS = PushSettings(workspace=(-0.2, 0.2, -0.25, 0.25))
BAR = np.array([[-0.08, -0.02], [0.08, -0.02], [0.08, 0.02], [-0.08, 0.02]])
SLOTTED = np.array(
    [[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [0.013, 0.05], [0.013, -0.02], [-0.013, -0.02], [-0.013, 0.05], [-0.05, 0.05]]
)
"""A slot 26 mm wide, too narrow for the pusher of 36 mm."""


def shape_of(outline: np.ndarray) -> ObjectShape:
    return ObjectShape(CellGrid(np.zeros((1, 2)), 0.01), outline)


def test_random_contacts_are_uniform_over_the_length_of_the_outline() -> None:
    rng = np.random.default_rng(0)
    contacts = np.array([sample_push(shape_of(BAR), [0, 0, 0], rng, SETTINGS).contact_point for _ in range(600)])
    on_long_side = np.abs(np.abs(contacts[:, 1]) - 0.02) < 1e-9
    # 0.16 of every 0.20 m; three standard deviations of the share are 0.05.
    assert np.mean(on_long_side) == pytest.approx(0.8, abs=0.05)
    along = contacts[on_long_side, 0]
    assert (np.mean(along), np.std(along)) == pytest.approx((0.0, 0.16 / np.sqrt(12)), abs=0.01)


def test_random_pushes_keep_cone_and_ranges_and_touch_where_they_say() -> None:
    rng = np.random.default_rng(1)
    tool = make_object("wrench")
    shape, pose = ObjectShape(CellGrid(tool.cells, tool.cell_size), tool.outline), np.array([0.01, -0.03, 0.8])
    outline = transform_points(pose, shape.outline)
    for _ in range(100):
        push = sample_push(shape, pose, rng, SETTINGS)
        inward = (push.contact_point - push.tool_at_contact) / SETTINGS.pusher_radius
        assert inward @ push.heading >= np.cos(SETTINGS.cone) - 1e-9
        assert 0.04 <= push.distance <= 0.10 and 0.1 <= push.speed <= 0.2
        assert signed_distance(push.contact_point[None], outline)[0] == pytest.approx(0.0, abs=1e-9)
        approach = push.tool_at_contact - np.linspace(SETTINGS.clearance, 2e-4, 300)[:, None] * push.heading
        assert np.min(signed_distance(approach, outline)) > SETTINGS.pusher_radius - 2e-4


def test_random_pushes_never_go_into_a_slot_and_bring_an_object_at_the_edge_back_in() -> None:
    rng = np.random.default_rng(2)
    for _ in range(100):
        x, y = sample_push(shape_of(SLOTTED), [0, 0, 0], rng, SETTINGS).contact_point
        assert not (abs(x) < 0.0131 and -0.021 < y < 0.0499)
        push = sample_push(shape_of(BAR), [0.1, 0.14, 0.0], rng, SETTINGS)
        assert np.all([0.18, 0.16] + push.distance * push.heading <= [0.2 + 1e-9, 0.25 + 1e-9])
    with pytest.raises(PlanningError, match="leave the workspace") as error:
        sample_push(shape_of(BAR), [1.0, 0.0, 0.0], rng, SETTINGS)
    assert error.value.code == PushCode.UNREACHABLE


@pytest.mark.parametrize(
    ("pose", "asked", "direction", "contact", "outward"),
    [
        ([0.02, 0.0, np.pi / 2], [0.06, 0.01], np.pi, [0.04, 0.01], [1.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.09, -0.03], np.pi / 2 + 0.2, [0.08, -0.02], [0.0, -1.0]),
    ],
    ids=["beside a face", "at a corner"],
)
def test_goal_is_moved_to_the_nearest_point_of_the_side_that_faces_the_push(
    pose: list[float], asked: list[float], direction: float, contact: list[float], outward: list[float]
) -> None:
    push = push_from_goal(shape_of(BAR), pose, asked, direction, 0.05, 0.1, SETTINGS)
    assert push.contact_point == pytest.approx(contact)
    assert push.tool_at_contact == pytest.approx(np.add(contact, SETTINGS.pusher_radius * np.array(outward)))


@pytest.mark.parametrize(
    ("contact", "direction", "distance", "speed", "code", "text"),
    [
        ([0, -0.02], -np.pi / 2, 0.05, 0.1, PushCode.INVALID_GOAL, "does not push into"),
        ([np.nan, 0], 0.0, 0.05, 0.1, PushCode.INVALID_GOAL, "contact_point"),
        ([0, -0.02], np.inf, 0.05, 0.1, PushCode.INVALID_GOAL, "direction"),
        ([0, -0.02], np.pi / 2, -0.05, 0.1, PushCode.INVALID_GOAL, "distance is -0.050"),
        ([0, -0.02], np.pi / 2, 0.05, 3.0, PushCode.INVALID_GOAL, "speed is 3.000"),
        ([0, -0.02], np.pi / 2, 0.25, 0.1, PushCode.LIMIT, "start|end"),
    ],
)
def test_impossible_goal_is_refused_with_its_code(
    contact: list[float], direction: float, distance: float, speed: float, code: PushCode, text: str
) -> None:
    settings = PushSettings(workspace=(-0.2, 0.2, -0.15, 0.15))
    with pytest.raises(PlanningError, match=text) as error:
        push_from_goal(shape_of(BAR), [0, 0, 0], contact, direction, distance, speed, settings)
    assert error.value.code == code


def test_goal_inside_a_slot_and_goal_behind_another_object_are_unreachable() -> None:
    with pytest.raises(PlanningError, match=r"be lowered|would touch") as error:
        push_from_goal(shape_of(SLOTTED), [0, 0, 0], [0, -0.02], -np.pi / 2, 0.05, 0.1, SETTINGS)
    assert error.value.code == PushCode.UNREACHABLE
    beyond = BAR + np.array([0.0, 0.06])
    with pytest.raises(PlanningError, match="would touch"):
        push_from_goal(shape_of(BAR[:, ::-1].copy()), [0, 0, 0], [0, -0.08], np.pi / 2, 0.15, 0.1, SETTINGS, obstacles=[beyond])


@pytest.mark.parametrize("name", ["hammer", "crimp"])
def test_object_at_the_edge_has_a_push_that_brings_it_back_and_one_in_the_middle_needs_none(name: str) -> None:
    tool = make_object(name)
    shape = ObjectShape(CellGrid(tool.cells, tool.cell_size), tool.outline)
    assert not is_near_edge(shape, [0.0, 0.0, 0.4], SETTINGS)
    rng = np.random.default_rng(4)
    for edge in ([0.2, 0.0], [-0.2, 0.05], [0.0, 0.25], [0.05, -0.25]):
        yaw = rng.uniform(-3, 3)
        # Moved out until the outline is 1 cm from the edge, on that side.
        outward = np.sign(edge) * (np.abs(edge) >= 0.2)
        reach = np.max(transform_points([0, 0, yaw], shape.outline) @ outward)
        pose = np.array([*(np.array(edge) * (outward == 0) + outward * (np.abs(edge) @ np.abs(outward) - 0.01 - reach)), yaw])
        if np.linalg.norm(pose[:2]) < SETTINGS.distance_range[0]:
            continue  # as long as the workspace is wide: it is in the middle
        assert is_near_edge(shape, pose, SETTINGS)
        push = next(recentring_pushes(shape, pose, SETTINGS))
        before, after = np.linalg.norm(pose[:2]), np.linalg.norm(pose[:2] + push.distance * push.heading)
        assert after < before - 0.01
        assert push.heading @ -pose[:2] > 0.5 * before


# --- motion of the arm

PARKED = (1.4, *HOME[1:])  # turned aside, out of the camera's view
MOTION = MotionSettings(home=PARKED)


@pytest.fixture(scope="module")
def push() -> PushPlan2D:
    return push_from_goal(shape_of(BAR), [0.03, 0.05, 0.4], [0.05, -0.1], 1.7, 0.08, 0.15, SETTINGS)


@pytest.fixture(scope="module")
def plan(kinematics: ArmKinematics, push: PushPlan2D) -> ArmPlan:
    return plan_push(kinematics, PARKED, push, MOTION)


def tip_of(kinematics: ArmKinematics, plan: ArmPlan, time: float) -> Float64Array:
    return kinematics.forward(plan.trajectory.follow(np.array([time]))[0][0])[:3, 3]


def test_tool_goes_through_the_contact_at_constant_speed_and_stops_at_the_end(
    kinematics: ArmKinematics, plan: ArmPlan, push: PushPlan2D
) -> None:
    tip = lambda time: tip_of(kinematics, plan, time)  # noqa: E731
    assert tip(plan.contact) == pytest.approx([*push.tool_at_contact, MOTION.push_height], abs=1e-4)
    assert tip(plan.stop) == pytest.approx([*push.tool_end, MOTION.push_height], abs=1e-5)
    assert tip(plan.rested) == pytest.approx(tip(plan.stop), abs=1e-9)
    times = np.linspace(plan.contact - 0.05, plan.stop - 0.1, 20)
    travel = [(tip(time)[:2] - push.tool_at_contact) @ push.heading for time in times]
    assert travel == pytest.approx(push.speed * (times - plan.contact), abs=1e-4)
    path_time, path = plan.tool_path
    assert path_time[[0, -1]] == pytest.approx([0.0, plan.stop - plan.departure], abs=1e-9)
    assert path[[0, -1], :2] == pytest.approx(np.array([push.tool_start(MOTION.clearance), push.tool_end]), abs=1e-4)


def test_plan_starts_where_the_arm_is_ends_at_home_and_never_jumps(kinematics: ArmKinematics, plan: ArmPlan) -> None:
    trajectory = plan.trajectory
    assert trajectory.position[0] == pytest.approx(PARKED) and trajectory.position[-1] == pytest.approx(PARKED)
    assert not np.any(trajectory.velocity[[0, -1]])
    steps = np.diff(trajectory.time)
    assert np.all(steps > 0) and np.max(steps) <= 0.01 + 1e-9
    mean_velocity = np.diff(trajectory.position, axis=0) / steps[:, None]
    assert mean_velocity == pytest.approx(0.5 * (trajectory.velocity[1:] + trajectory.velocity[:-1]), abs=0.02)
    assert np.max(np.abs(trajectory.velocity)) <= MOTION.max_joint_velocity + 1e-3
    # Before the arm has started to move, it has no deviation.
    assert plan.deviation(plan.tip[0], -0.07, -0.05) == pytest.approx(0.0, abs=1e-9)
    assert plan.deviation(plan.tip[0] + [0.0, 0.03, 0.0], -0.07, -0.05) == pytest.approx(0.03, abs=1e-9)


def test_lowered_tool_moves_only_along_the_push_line(plan: ArmPlan, push: PushPlan2D) -> None:
    low = plan.tip[:, 2] < MOTION.free_height
    deviation = (plan.tip[low, :2] - push.tool_at_contact) @ np.array([-push.heading[1], push.heading[0]])
    assert np.max(np.abs(deviation)) < 5e-4
    assert np.min(plan.tip[:, 2]) >= MOTION.push_height - 1e-4
    going_down = plan.trajectory.time < plan.lowered
    assert plan.tip[low & going_down, :2] == pytest.approx(np.tile(push.tool_start(0.03), (np.sum(low & going_down), 1)), abs=5e-4)


def test_tool_does_not_spin_while_it_pushes(kinematics: ArmKinematics, plan: ArmPlan) -> None:
    # A face that turns drags the object sideways, up to several millimetres over a push.
    during = (plan.trajectory.time >= plan.departure) & (plan.trajectory.time <= plan.stop)
    headings = np.array([np.arctan2(*kinematics.forward(q)[[1, 0], 0]) for q in plan.trajectory.position[during]])
    assert np.ptp(np.unwrap(headings)) < 1e-3


def test_arm_left_low_beside_the_object_first_goes_straight_up(kinematics: ArmKinematics, push: PushPlan2D) -> None:
    q_low, _ = kinematics.inverse([0.1, -0.1, 0.012], HOME)
    plan = plan_push(kinematics, q_low, push, MOTION)
    high = int(np.argmax(plan.tip[:, 2] > MOTION.safe_height - 2e-3))
    assert plan.tip[:high, :2] == pytest.approx(np.tile([0.1, -0.1], (high, 1)), abs=5e-4)
    travelling = np.linalg.norm(plan.tip[high:, :2] - push.tool_start(MOTION.clearance), axis=1) > 1e-3
    travelling &= plan.trajectory.time[high:] < plan.lowered
    assert np.count_nonzero(travelling) > 100
    assert np.min(plan.tip[high:, 2][travelling]) >= MOTION.free_height


def test_joints_accelerate_no_more_than_allowed_on_the_push_and_beside_it(plan: ArmPlan) -> None:
    acceleration, time = np.abs(plan.trajectory.acceleration), plan.trajectory.time
    pushing = (time[:-1] >= plan.departure - 1e-9) & (time[1:] <= plan.stop + 1e-9)
    assert np.max(acceleration[pushing]) <= 10.0
    assert np.max(acceleration[~pushing]) <= MOTION.max_joint_acceleration + 1e-3
    # Not for want of motion: the ramps of 2 m/s^2 are felt in the joints.
    assert np.max(acceleration[pushing]) > 2.0


def test_ramps_too_steep_for_a_joint_are_longer_as_far_as_the_way_to_the_object_allows(
    kinematics: ArmKinematics, push: PushPlan2D, plan: ArmPlan
) -> None:
    tight = replace(MOTION, joint_acceleration_limits=(1.5, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0))
    gentle = plan_push(kinematics, PARKED, push, tight)
    # Approach and retreat took the time that the joint needs, too.
    assert np.max(np.abs(gentle.trajectory.acceleration[:, 0])) <= 1.5 * (1.0 + 1e-3)
    assert plan.stop - plan.departure < gentle.stop - gentle.departure < plan.stop - plan.departure + 0.3
    # At its speed before the contact, which is when the plan says.
    tips = [tip_of(kinematics, gentle, gentle.contact + late)[:2] for late in (0.0, 0.1)]
    assert tips[0] == pytest.approx(push.tool_at_contact, abs=1e-4)
    assert tips[1] - tips[0] == pytest.approx(0.1 * push.speed * push.heading, abs=1e-4)
    # No longer than that.
    tighter = replace(tight, joint_acceleration_limits=(0.3, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0))
    with pytest.raises(PlanningError, match=r"joint_1 would accelerate at .* rad/s\^2, limit 0\.28 .*; push slower") as error:
        plan_push(kinematics, PARKED, push, tighter)
    assert error.value.code == PushCode.LIMIT
    plan_push(kinematics, PARKED, replace(push, speed=0.03), tighter)
    for limits, text in (((5.0, 5.0), "has 2 numbers, expected 1 or 7"), ((), "over 0"), ((-1.0,), "over 0")):
        with pytest.raises(InputError, match=text):
            plan_push(kinematics, PARKED, push, replace(MOTION, joint_acceleration_limits=limits))


FAR = PushPlan2D(np.array([0.5, 0.0]), np.array([0.48, 0.0]), 0.0, 0.05, 0.1)
LOW = [0.0, 0.0, 0.0, -2.5, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("start", "far", "changes", "code", "text"),
    [
        (PARKED, False, {"max_joint_velocity": 0.1}, PushCode.LIMIT, r"lbr_iiwa_joint_\d would turn at .* rad/s, limit 0.100"),
        (PARKED, True, {}, PushCode.UNREACHABLE, r"cannot reach \(0.450, 0.000, .* mm away"),
        (LOW, False, {}, PushCode.LIMIT, r"lbr_iiwa_joint_4 would be at -2\.500 rad"),
        (PARKED, False, {"link_height": 0.5}, PushCode.LIMIT, r"lbr_iiwa_joint_\d would be 0\.\d+ m above the table, limit 0\.500"),
    ],
    ids=["too fast", "out of reach", "start beyond a limit", "link near the table"],
)
def test_impossible_motion_is_refused_by_joint_or_point(
    kinematics: ArmKinematics, push: PushPlan2D, start: list[float], far: bool, changes: dict[str, float], code: PushCode, text: str
) -> None:
    with pytest.raises(PlanningError, match=text) as error:
        plan_push(kinematics, start, FAR if far else push, replace(MOTION, **changes))
    assert error.value.code == code


def test_retreat_backs_off_before_it_rises_and_ends_at_home(kinematics: ArmKinematics, plan: ArmPlan, push: PushPlan2D) -> None:
    stopped = plan.trajectory.follow(np.array([0.5 * (plan.contact + plan.stop)]))[0][0]
    retreat = plan_retreat(kinematics, stopped, push.heading, MOTION)
    assert retreat.trajectory.position[0] == pytest.approx(stopped) and retreat.trajectory.position[-1] == pytest.approx(PARKED)
    start = kinematics.forward(stopped)[:3, 3]
    back = (retreat.tip[:, :2] - start[:2]) @ push.heading
    low = retreat.tip[:, 2] < start[2] + 0.002
    assert back[low].min() == pytest.approx(-MOTION.back_off, abs=1e-3) and back[low].max() < 1e-3
    rising = ~low & (retreat.tip[:, 2] < MOTION.free_height)
    assert np.ptp(back[rising]) < 1e-3
    at_home = plan_retreat(kinematics, PARKED, push.heading, MOTION)
    assert np.all(at_home.trajectory.position == np.array(PARKED))
