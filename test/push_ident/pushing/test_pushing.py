"""Kinematics, choice of pushes and planning of the arm's motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.pushing.hand import HandState
from push_ident.pushing.motion import ArmPlan, MotionSettings, plan_push, plan_retreat
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.sampling import is_near_edge, push_from_goal, recentring_pushes, sample_push
from push_ident.types import CellGrid, ObjectShape
from push_ident_sim.cell.robot import HOME, PUSHER_RADIUS, robot_description
from push_ident_sim.objects import make_object

SETTINGS = PushSettings(workspace=(-0.2, 0.2, -0.25, 0.25))
PARKED = (1.4, *HOME[1:])  # turned aside, out of the camera's view
MOTION = MotionSettings(home=PARKED)
BAR = np.array([[-0.08, -0.02], [0.08, -0.02], [0.08, 0.02], [-0.08, 0.02]])
# A slot 26 mm wide, too narrow for the pusher of 36 mm.
SLOTTED = np.array(
    [[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [0.013, 0.05], [0.013, -0.02], [-0.013, -0.02], [-0.013, 0.05], [-0.05, 0.05]]
)


def shape_of(outline: np.ndarray) -> ObjectShape:
    return ObjectShape(CellGrid(np.zeros((1, 2)), 0.01), outline)


@pytest.fixture(scope="module")
def arm() -> ArmKinematics:
    return ArmKinematics(robot_description(), neutral=HOME)


@pytest.fixture(scope="module")
def push() -> PushPlan2D:
    return push_from_goal(shape_of(BAR), [0.03, 0.05, 0.4], [0.05, -0.1], 1.7, 0.08, 0.15, SETTINGS)


@pytest.fixture(scope="module")
def plan(arm: ArmKinematics, push: PushPlan2D) -> ArmPlan:
    return plan_push(arm, PARKED, push, MOTION)


# Kinematics


def test_forward_of_the_upright_arm_adds_up_the_lengths_of_its_links(arm: ArmKinematics) -> None:
    # Pedestal 0.43, iiwa from base to joint 7 1.261, flange 0.045, palm 0.1, fist 0.04, finger tips 0.08 m.
    pose = arm.forward(np.zeros(7))
    assert pose[:3, 3] == pytest.approx([-0.44, 0.0, 0.43 + 1.261 + 0.045 + 0.1 + 0.04 + 0.08], abs=1e-6)
    assert pose[:3, 2] == pytest.approx([0, 0, 1], abs=1e-6)
    assert arm.root_frame == "table"


def test_jacobian_matches_finite_differences(arm: ArmKinematics) -> None:
    q = np.array([0.3, 0.4, -0.2, -1.3, 0.5, 0.9, -0.7])
    jacobian = arm.jacobian(q)
    for j in range(7):
        step = 1e-6 * np.eye(7)[j]
        before, after = arm.forward(q - step), arm.forward(q + step)
        spin = (after[:3, :3] - before[:3, :3]) / 2e-6 @ arm.forward(q)[:3, :3].T
        assert jacobian[:3, j] == pytest.approx((after[:3, 3] - before[:3, 3]) / 2e-6, abs=1e-6)
        assert jacobian[3:, j] == pytest.approx([spin[2, 1], spin[0, 2], spin[1, 0]], abs=1e-6)


def test_inverse_puts_the_tip_down_on_every_point_of_the_workspace(arm: ArmKinematics) -> None:
    for x in (-0.15, 0.0, 0.15):
        for y in (-0.25, 0.0, 0.25):
            q, converged = arm.inverse([x, y, 0.012], HOME)
            pose = arm.forward(q)
            assert converged
            assert pose[:3, 3] == pytest.approx([x, y, 0.012], abs=2e-6)
            assert pose[:3, 2] == pytest.approx([0, 0, -1], abs=1e-5)


def test_inverse_keeps_a_given_axis_and_leaves_the_spin_about_it_free(arm: ArmKinematics) -> None:
    axis = np.array([0.3, 0.0, -1.0]) / np.hypot(0.3, 1.0)
    first, ok_first = arm.inverse([0.0, 0.1, 0.1], HOME, axis=axis)
    turned = first + np.array([0, 0, 0, 0, 0, 0, 1.0])
    second, ok_second = arm.inverse([0.0, 0.1, 0.1], turned, axis=axis, posture_gain=0.0)
    assert ok_first and ok_second
    assert arm.forward(first)[:3, 2] == pytest.approx(axis, abs=1e-5)
    assert second == pytest.approx(turned, abs=1e-5)


def test_freedom_left_by_the_task_is_used_to_return_to_neutral(arm: ArmKinematics) -> None:
    q, _ = arm.inverse([0.0, 0.0, 0.1], HOME)
    twisted = np.array([0.0, 0.3, 0.9, -1.5, 0.6, 1.2, 1.5])
    kept, ok_kept = arm.inverse([0.0, 0.0, 0.1], twisted, posture_gain=0.0)
    drifted, ok_drifted = arm.inverse([0.0, 0.0, 0.1], twisted, posture_gain=0.3)
    assert ok_kept and ok_drifted
    assert np.linalg.norm(drifted - q) < 0.5 * np.linalg.norm(kept - q)


@pytest.mark.parametrize("target", [[0.6, 0.0, 0.1], [-0.44, 0.0, 0.1], [0.0, 2.0, 0.0]])
def test_inverse_reports_a_point_out_of_reach_and_stays_within_the_joint_limits(arm: ArmKinematics, target: list[float]) -> None:
    q, converged = arm.inverse(target, HOME)
    assert not converged
    assert np.all((q >= arm.position_lower) & (q <= arm.position_upper))


def test_description_without_tip_or_not_xml_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="no link `gripper`"):
        ArmKinematics(robot_description(), "gripper")
    with pytest.raises(InputError, match="not a valid URDF"):
        ArmKinematics("<robot name='a'>")


# Choice of pushes


def test_default_pusher_radius_is_that_of_the_simulated_hand() -> None:
    assert PushSettings().pusher_radius == PUSHER_RADIUS


def test_random_contacts_are_uniform_over_the_length_of_the_outline() -> None:
    rng = np.random.default_rng(0)
    contacts = np.array([sample_push(shape_of(BAR), [0, 0, 0], rng, SETTINGS).contact_point for _ in range(600)])
    on_long_side = np.abs(np.abs(contacts[:, 1]) - 0.02) < 1e-9
    # 0.16 of every 0.20 m; three standard deviations of the share are 0.05.
    assert np.mean(on_long_side) == pytest.approx(0.8, abs=0.05)
    along = contacts[on_long_side, 0]
    assert np.mean(along) == pytest.approx(0.0, abs=0.01)
    assert np.std(along) == pytest.approx(0.16 / np.sqrt(12), rel=0.1)


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
        way = push.tool_at_contact - np.linspace(SETTINGS.clearance, 2e-4, 300)[:, None] * push.heading
        assert np.min(signed_distance(way, outline)) > SETTINGS.pusher_radius - 2e-4


def test_random_push_is_reproduced_by_its_seed() -> None:
    first, again, other = (sample_push(shape_of(BAR), [0, 0, 0.3], np.random.default_rng(seed), SETTINGS) for seed in (7, 7, 8))
    assert np.array_equal(first.contact_point, again.contact_point) and first.direction == again.direction
    assert first.direction != other.direction


def test_random_pushes_never_go_into_a_slot_narrower_than_the_pusher() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        x, y = sample_push(shape_of(SLOTTED), [0, 0, 0], rng, SETTINGS).contact_point
        assert not (abs(x) < 0.0131 and -0.021 < y < 0.0499)


def test_random_pushes_bring_an_object_at_the_edge_back_in() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        push = sample_push(shape_of(BAR), [0.1, 0.14, 0.0], rng, SETTINGS)
        assert 0.1 + 0.08 + push.distance * push.heading[0] <= 0.2 + 1e-9
        assert 0.14 + 0.02 + push.distance * push.heading[1] <= 0.25 + 1e-9


def test_object_out_of_the_workspace_gives_no_random_push_and_the_reason() -> None:
    with pytest.raises(PlanningError, match="leave the workspace") as error:
        sample_push(shape_of(BAR), [1.0, 0.0, 0.0], np.random.default_rng(0), SETTINGS)
    assert error.value.code == PushCode.UNREACHABLE


def test_goal_is_moved_to_the_nearest_outline_point() -> None:
    push = push_from_goal(shape_of(BAR), [0.02, 0.0, np.pi / 2], [0.06, 0.01], np.pi, 0.05, 0.1, SETTINGS)
    assert push.contact_point == pytest.approx([0.04, 0.01])
    assert push.tool_at_contact == pytest.approx([0.04 + SETTINGS.pusher_radius, 0.01])


def test_goal_at_a_corner_takes_the_side_that_faces_the_push() -> None:
    push = push_from_goal(shape_of(BAR), [0, 0, 0], [0.09, -0.03], np.pi / 2 + 0.2, 0.05, 0.1, SETTINGS)
    assert push.contact_point == pytest.approx([0.08, -0.02])
    assert push.tool_at_contact == pytest.approx([0.08, -0.02 - SETTINGS.pusher_radius])


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


@pytest.mark.parametrize("name", ["hammer", "wrench", "crimp", "toolbox", "book"])
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


def test_push_back_to_the_middle_prefers_to_carry_the_object_straight_there() -> None:
    push = next(recentring_pushes(shape_of(BAR), [0.0, 0.17, 0.0], SETTINGS))
    assert push.heading == pytest.approx([0.0, -1.0], abs=1e-9) and abs(push.contact_point[0]) < 0.002
    assert push.distance == pytest.approx(0.17)


# Hand

FIST = HandState(activated=True, mode=0, going=True, readiness=3, motion=2, fault=0, request=255)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({}, ""),
        ({"motion": 3}, ""),
        ({"motion": 0}, "moving"),
        ({"fault": 0x0D}, "0x0D"),
        ({"activated": False}, "not activated"),
        ({"readiness": 1}, "not activated"),
        ({"mode": 1}, "mode 1"),
        ({"request": 120}, "open"),
        ({"going": False}, "open"),
    ],
)
def test_hand_is_a_fist_only_when_closed_still_and_without_fault(change: dict[str, int], text: str) -> None:
    reason = replace(FIST, **change).why_no_fist
    assert text in reason and bool(reason) == bool(text)


# Motion


def test_tool_goes_through_the_contact_at_constant_speed_and_stops_at_the_end(arm: ArmKinematics, plan: ArmPlan, push: PushPlan2D) -> None:
    tip = lambda time: arm.forward(plan.trajectory.at(time))[:3, 3]  # noqa: E731
    assert tip(plan.contact) == pytest.approx([*push.tool_at_contact, MOTION.push_height], abs=1e-4)
    assert tip(plan.stop) == pytest.approx([*push.tool_end, MOTION.push_height], abs=1e-5)
    assert tip(plan.rested) == pytest.approx(tip(plan.stop), abs=1e-9)
    times = np.linspace(plan.contact - 0.05, plan.stop - 0.1, 20)
    travel = [(tip(time)[:2] - push.tool_at_contact) @ push.heading for time in times]
    assert travel == pytest.approx(push.speed * (times - plan.contact), abs=1e-4)


def test_plan_starts_where_the_arm_is_ends_at_home_and_never_jumps(arm: ArmKinematics, plan: ArmPlan) -> None:
    trajectory = plan.trajectory
    assert trajectory.position[0] == pytest.approx(PARKED) and trajectory.position[-1] == pytest.approx(PARKED)
    assert not np.any(trajectory.velocity[[0, -1]])
    steps = np.diff(trajectory.time)
    assert np.all(steps > 0) and np.max(steps) <= 0.01 + 1e-9
    mean_velocity = np.diff(trajectory.position, axis=0) / steps[:, None]
    assert mean_velocity == pytest.approx(0.5 * (trajectory.velocity[1:] + trajectory.velocity[:-1]), abs=0.02)
    assert np.max(np.abs(trajectory.velocity)) <= MOTION.max_joint_velocity + 1e-3


def test_lowered_tool_moves_only_along_the_push_line(plan: ArmPlan, push: PushPlan2D) -> None:
    low = plan.tip[:, 2] < MOTION.free_height
    off = (plan.tip[low, :2] - push.tool_at_contact) @ np.array([-push.heading[1], push.heading[0]])
    assert np.max(np.abs(off)) < 5e-4
    assert np.min(plan.tip[:, 2]) >= MOTION.push_height - 1e-4
    going_down = plan.trajectory.time < plan.lowered
    assert plan.tip[low & going_down, :2] == pytest.approx(np.tile(push.tool_start(0.03), (np.sum(low & going_down), 1)), abs=5e-4)


def test_arm_that_has_not_started_to_move_has_no_deviation(plan: ArmPlan) -> None:
    assert plan.deviation(plan.tip[0], -0.05, 0.02) == pytest.approx(0.0, abs=1e-9)
    assert plan.deviation(plan.tip[0] + [0.0, 0.03, 0.0], -0.05, 0.02) == pytest.approx(0.03, abs=1e-9)


def test_tool_does_not_spin_while_it_pushes(arm: ArmKinematics, plan: ArmPlan) -> None:
    # A face that turns drags the object sideways, up to several millimetres over a push.
    during = (plan.trajectory.time >= plan.departure) & (plan.trajectory.time <= plan.stop)
    headings = np.array([np.arctan2(*arm.forward(q)[[1, 0], 0]) for q in plan.trajectory.position[during]])
    assert np.ptp(np.unwrap(headings)) < 1e-3


def test_tool_path_is_the_pushing_part_from_zero(plan: ArmPlan, push: PushPlan2D) -> None:
    time, tip = plan.tool_path
    assert time[0] == pytest.approx(0.0, abs=1e-9) and time[-1] == pytest.approx(plan.stop - plan.departure)
    assert tip[0, :2] == pytest.approx(push.tool_start(MOTION.clearance), abs=1e-4)
    assert tip[-1, :2] == pytest.approx(push.tool_end, abs=1e-4)


def test_arm_left_low_beside_the_object_first_goes_straight_up(arm: ArmKinematics, push: PushPlan2D) -> None:
    q_low, _ = arm.inverse([0.1, -0.1, 0.012], HOME)
    plan = plan_push(arm, q_low, push, MOTION)
    high = int(np.argmax(plan.tip[:, 2] > MOTION.safe_height - 2e-3))
    assert plan.tip[:high, :2] == pytest.approx(np.tile([0.1, -0.1], (high, 1)), abs=5e-4)
    travelling = np.linalg.norm(plan.tip[high:, :2] - push.tool_start(MOTION.clearance), axis=1) > 1e-3
    travelling &= plan.trajectory.time[high:] < plan.lowered
    assert np.count_nonzero(travelling) > 100
    assert np.min(plan.tip[high:, 2][travelling]) >= MOTION.free_height


def test_push_too_fast_for_a_joint_is_refused_by_its_name(arm: ArmKinematics, push: PushPlan2D) -> None:
    with pytest.raises(PlanningError, match=r"lbr_iiwa_joint_\d would turn at .* rad/s, limit 0.100") as error:
        plan_push(arm, PARKED, push, MotionSettings(home=PARKED, max_joint_velocity=0.1))
    assert error.value.code == PushCode.LIMIT


def test_joints_accelerate_no_more_than_allowed_on_the_push_and_beside_it(plan: ArmPlan) -> None:
    acceleration, time = np.abs(plan.trajectory.acceleration), plan.trajectory.time
    pushing = (time[:-1] >= plan.departure - 1e-9) & (time[1:] <= plan.stop + 1e-9)
    assert np.max(acceleration[pushing]) <= 10.0
    assert np.max(acceleration[~pushing]) <= MOTION.max_joint_acceleration + 1e-3
    # Not for want of motion: the ramps of 2 m/s^2 are felt in the joints.
    assert np.max(acceleration[pushing]) > 2.0


def test_ramps_too_steep_for_a_joint_are_refused_by_its_name_and_gentler_ones_are_not(arm: ArmKinematics, push: PushPlan2D) -> None:
    tight = replace(MOTION, joint_acceleration_limits=(1.5, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0))
    with pytest.raises(
        PlanningError, match=r"joint_1 would accelerate at .* rad/s\^2, limit 1\.50 .* lower `acceleration` .*, 2\.00"
    ) as error:
        plan_push(arm, PARKED, push, tight)
    assert error.value.code == PushCode.LIMIT
    gentle = plan_push(arm, PARKED, push, replace(tight, acceleration=0.5))
    # Approach and retreat took the time that the joint needs.
    assert np.max(np.abs(gentle.trajectory.acceleration[:, 0])) <= 1.5 + 1e-3


@pytest.mark.parametrize(("limits", "text"), [((5.0, 5.0), "has 2 numbers, expected 1 or 7"), ((), "over 0"), ((-1.0,), "over 0")])
def test_acceleration_limits_that_fit_no_joint_are_refused(
    arm: ArmKinematics, push: PushPlan2D, limits: tuple[float, ...], text: str
) -> None:
    with pytest.raises(InputError, match=text):
        plan_push(arm, PARKED, push, replace(MOTION, joint_acceleration_limits=limits))


def test_push_out_of_reach_is_refused_with_the_point_and_the_miss(arm: ArmKinematics) -> None:
    far = PushPlan2D(np.array([0.5, 0.0]), np.array([0.48, 0.0]), 0.0, 0.05, 0.1)
    with pytest.raises(PlanningError, match=r"cannot reach \(0.450, 0.000, .* mm away") as error:
        plan_push(arm, PARKED, far, MOTION)
    assert error.value.code == PushCode.UNREACHABLE


def test_start_beyond_a_joint_limit_is_refused_by_its_name(arm: ArmKinematics, push: PushPlan2D) -> None:
    with pytest.raises(PlanningError, match=r"lbr_iiwa_joint_4 would be at -2\.500 rad") as error:
        plan_push(arm, [0, 0, 0, -2.5, 0, 0, 0], push, MOTION)
    assert error.value.code == PushCode.LIMIT


def test_link_that_would_come_near_the_table_is_refused_by_its_name(arm: ArmKinematics, push: PushPlan2D) -> None:
    with pytest.raises(PlanningError, match=r"lbr_iiwa_joint_\d would be 0\.\d+ m above the table, limit 0\.500") as error:
        plan_push(arm, PARKED, push, replace(MOTION, link_height=0.5))
    assert error.value.code == PushCode.LIMIT


def test_retreat_backs_off_before_it_rises_and_ends_at_home(arm: ArmKinematics, plan: ArmPlan, push: PushPlan2D) -> None:
    stopped = plan.trajectory.at(0.5 * (plan.contact + plan.stop))
    retreat = plan_retreat(arm, stopped, push.heading, MOTION)
    assert retreat.trajectory.position[0] == pytest.approx(stopped) and retreat.trajectory.position[-1] == pytest.approx(PARKED)
    start = arm.forward(stopped)[:3, 3]
    back = (retreat.tip[:, :2] - start[:2]) @ push.heading
    low = retreat.tip[:, 2] < start[2] + 0.002
    assert back[low].min() == pytest.approx(-MOTION.back_off, abs=1e-3) and back[low].max() < 1e-3
    rising = ~low & (retreat.tip[:, 2] < MOTION.free_height)
    assert np.ptp(back[rising]) < 1e-3
    at_home = plan_retreat(arm, PARKED, push.heading, MOTION)
    assert np.all(at_home.trajectory.position == np.array(PARKED))


def test_every_random_push_of_every_object_can_be_planned(arm: ArmKinematics) -> None:
    rng = np.random.default_rng(5)
    for name in ("hammer", "wrench", "crimp", "toolbox", "book"):
        tool = make_object(name)
        shape, pose = ObjectShape(CellGrid(tool.cells, tool.cell_size), tool.outline), [*rng.uniform(-0.04, 0.04, 2), rng.uniform(-3, 3)]
        for _ in range(4):
            push = sample_push(shape, pose, rng, PushSettings())
            plan = plan_push(arm, PARKED, push, MOTION)
            assert plan.duration < 10.0
