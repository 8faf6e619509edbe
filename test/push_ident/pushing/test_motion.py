"""Planning of the arm's motion through a push."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.motion import ArmPlan, MotionSettings, plan_push, plan_retreat
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.sampling import push_from_goal
from push_ident.types import CellGrid, Float64Array, ObjectShape
from push_ident_sim.cell.robot import HOME

PARKED = (1.4, *HOME[1:])  # turned aside, out of the camera's view
MOTION = MotionSettings(home=PARKED)
BAR = np.array([[-0.08, -0.02], [0.08, -0.02], [0.08, 0.02], [-0.08, 0.02]])


@pytest.fixture(scope="module")
def push() -> PushPlan2D:
    shape = ObjectShape(CellGrid(np.zeros((1, 2)), 0.01), BAR)
    return push_from_goal(shape, [0.03, 0.05, 0.4], [0.05, -0.1], 1.7, 0.08, 0.15, PushSettings(workspace=(-0.2, 0.2, -0.25, 0.25)))


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
