"""Pushes along a path: the motion that the arm makes of it, what is checked before it begins, and how it is corrected on the way."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from helpers.memory_cell import PARKED, SETTINGS
from push_ident.errors import InputError, PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.motion import PathPlan, plan_path_push
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.steering import CorrectionFault, PathRequest, Steering, ToolCorrection
from push_ident.pushing.tool_path import Corridor, ToolMotion, ToolPath, rounded, stopping
from push_ident.types import Float64Array

MOTION = SETTINGS.motion
LIMITS = PushSettings(workspace=(-0.1, 0.2, -0.25, 0.25))
ANGLE = np.linspace(0.0, 1.2, 30)
BEND = np.vstack([[-0.03, 0.0], np.column_stack([0.12 * np.sin(ANGLE), 0.12 * (1.0 - np.cos(ANGLE))])])
"""Straight for 3 cm, then around a circle."""
SPEED = 0.1
PATH = ToolPath(np.append(0.0, 0.3 + 0.12 * ANGLE / SPEED), BEND)
CORRIDOR = Corridor(BEND, 0.04)
PUSH = PushPlan2D(np.array([0.018, 0.0]), BEND[1], 0.0, 0.1, SPEED)


@pytest.fixture(scope="module")
def plan(kinematics: ArmKinematics) -> PathPlan:
    return plan_path_push(kinematics, PARKED, PUSH, PATH, CORRIDOR, MOTION, LIMITS)


def tips(kinematics: ArmKinematics, postures: Float64Array) -> Float64Array:
    return np.array([kinematics.forward(q)[:3, 3] for q in postures])


def check_motion(kinematics: ArmKinematics, plan: PathPlan) -> None:
    """Joints and tool say the same, and the joints keep their limits and go on without a jump."""
    trajectory = plan.trajectory
    np.testing.assert_allclose(tips(kinematics, trajectory.position[::7]), plan.tip[::7], atol=5e-5)
    assert np.all(np.abs(trajectory.acceleration) <= plan.limits.acceleration * 1.001)
    # A cubic through the samples: positions are what the velocities make of them.
    step = np.diff(trajectory.time)[:, None]
    mean = 0.5 * (trajectory.velocity[1:] + trajectory.velocity[:-1])
    np.testing.assert_allclose(np.diff(trajectory.position, axis=0), step * mean, atol=2e-4)
    np.testing.assert_allclose(np.diff(trajectory.time), 0.01, atol=2e-3)
    assert np.all(trajectory.velocity[-1] == 0.0) and plan.duration == pytest.approx(plan.rested)


def test_tool_keeps_to_its_path_and_rounds_its_corners_within_its_acceleration() -> None:
    corner = ToolPath(np.array([0.0, 1.0, 2.0]), np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1]]))
    motion = rounded(corner, 0.0, np.zeros(2), np.zeros(2), 2.0)
    away = np.linalg.norm(motion.position - corner.at(motion.time), axis=1)
    # From rest, and at the end, it lags by what it needs to gain or lose its speed.
    assert away.max() < 2.6e-3 and away[15:190].max() < 2e-3 and np.linalg.norm(motion.position[-1] - [0.1, 0.1]) < 1e-4
    acceleration = np.linalg.norm(np.diff(motion.velocity, axis=0), axis=1) / 0.01
    assert acceleration.max() < 2.001 and np.all(motion.velocity[-1] == 0.0)
    # From beside the path, in another direction, it comes back.
    late = rounded(corner, 0.5, np.array([0.05, 0.004]), np.array([0.0, 0.1]), 2.0)
    assert np.linalg.norm(late.position - corner.at(late.time), axis=1)[25] < 1e-3
    np.testing.assert_allclose(motion.heading(), [0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(motion.heading(0.7), [1.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(("speed", "acceleration"), [(0.05, 2.0), (0.25, 0.5)])
def test_tool_that_stops_or_comes_late_does_not_swing_back_and_keeps_its_speed(speed: float, acceleration: float) -> None:
    """What swings back at the end would back off into the object."""
    moving, rest = np.array([speed, 0.0]), np.zeros(2)
    time = np.arange(201) * 0.01
    steady = ToolMotion(time, np.outer(time - 1.0, moving), np.tile(moving, (201, 1)))
    stop = rounded(stopping(steady, 1.0, acceleration), 1.0, rest, moving, acceleration)
    assert stop.velocity[:, 0].min() > -0.1 * speed and np.all(np.abs(stop.position[:, 1]) < 1e-9)
    assert stop.position[-1, 0] == pytest.approx(speed**2 / (2 * 0.8 * acceleration), abs=3e-4)
    straight = ToolPath(np.array([0.0, 0.3]), np.array([[0.0, 0.01], [0.3 * speed, 0.01]]))
    late = rounded(straight, 0.0, rest, moving, acceleration, 0.25)
    assert np.linalg.norm(late.velocity, axis=1).max() < 0.2501 and late.position[:, 1].max() < 0.0102
    np.testing.assert_allclose(late.position[-1], straight.position[-1], atol=2e-4)
    for motion in (stop, late):
        assert np.linalg.norm(np.diff(motion.velocity, axis=0), axis=1).max() < 1.01 * acceleration * 0.01
    from_rest = rounded(ToolPath(straight.time, straight.position), 0.0, straight.position[0], rest, acceleration, 0.25)
    assert from_rest.velocity[:, 0].min() > -0.15 * speed, "also after it had to catch up"


def test_tool_that_stops_in_a_bend_keeps_to_the_motion_that_was_checked() -> None:
    speed, radius, acceleration = 0.2, 0.04, 2.0
    time = np.arange(151) * 0.01
    sin, cos = np.sin(time * speed / radius), np.cos(time * speed / radius)
    bend = ToolMotion(time, radius * np.column_stack([sin, 1.0 - cos]), speed * np.column_stack([cos, sin]))
    stop = rounded(stopping(bend, 0.5, acceleration), 0.5, bend.position[50], bend.velocity[50], acceleration)
    assert np.linalg.norm(np.diff(stop.position, axis=0), axis=1).sum() == pytest.approx(speed**2 / (2 * 0.8 * acceleration), abs=1e-3)
    assert np.max(np.abs(np.linalg.norm(stop.position - [0.0, radius], axis=1) - radius)) < 5e-4, "a straight line would be 1.9 mm away"


def test_joints_carry_the_tool_along_the_path_and_are_those_of_every_place_in_its_corridor(
    kinematics: ArmKinematics, plan: PathPlan
) -> None:
    check_motion(kinematics, plan)
    pushing = (plan.trajectory.time >= plan.departure) & (plan.trajectory.time <= plan.stop)
    made, wanted = plan.tip[pushing][:, :2], PATH.at(plan.trajectory.time[pushing] - plan.departure)
    assert np.max(np.linalg.norm(made - wanted, axis=1)[15:-20]) < 1e-3
    assert plan.contact == pytest.approx(plan.departure + 0.3) and plan.push.distance == pytest.approx(0.144, abs=0.003)
    rng = np.random.default_rng(0)
    places = CORRIDOR.line[rng.integers(1, 31, 60)] + rng.uniform(-0.02, 0.02, (60, 2))
    motion = replace(plan.tool, time=np.arange(60.0), position=places, velocity=np.ones((60, 2)))
    tip = tips(kinematics, plan.postures.joints(motion)[0])
    np.testing.assert_allclose(tip[:, :2], places, atol=5e-5)
    np.testing.assert_allclose(tip[:, 2], MOTION.push_height, atol=5e-5)


def test_corrected_motion_is_the_same_up_to_where_it_begins_and_goes_on_without_a_jump(kinematics: ArmKinematics, plan: PathPlan) -> None:
    begin, aside = 0.8, np.array([0.0, 0.006])
    changed = plan.corrected(ToolPath(PATH.time, PATH.position + aside), begin)
    check_motion(kinematics, changed)
    before = plan.trajectory.time <= plan.departure + begin - 0.011
    np.testing.assert_array_equal(changed.trajectory.position[: before.sum()], plan.trajectory.position[before])
    np.testing.assert_allclose(changed.tip[-1, :2], BEND[-1] + aside, atol=2e-4)
    again = changed.corrected(ToolPath(np.array([0.9, 1.1]), np.array([PATH.at(np.array(0.9)), BEND[18]]) + aside), 0.9)
    assert again.duration < changed.duration
    check_motion(kinematics, again)


@pytest.mark.parametrize(
    ("limits", "motion", "width", "code", "words"),
    [
        ({"workspace": (-0.6, 0.9, -0.9, 0.9)}, {}, 0.6, PushCode.UNREACHABLE, "corridor"),
        ({}, {"max_joint_velocity": 0.25}, 0.04, PushCode.LIMIT, "the joints allow"),
        ({}, {"joint_acceleration_limits": (2.0,)}, 0.04, PushCode.LIMIT, "go slower"),
        ({}, {"link_height": 0.6}, 0.04, PushCode.LIMIT, "above the table"),
    ],
    ids=["out of reach", "joints too slow", "joints too weak", "elbow too low"],
)
def test_what_is_impossible_anywhere_in_the_corridor_is_refused_before_anything_moves(
    kinematics: ArmKinematics, limits: dict[str, Any], motion: dict[str, Any], width: float, code: PushCode, words: str
) -> None:
    settings = replace(MOTION, **motion), replace(LIMITS, **limits)
    with pytest.raises(PlanningError, match=words) as refusal:
        plan_path_push(kinematics, PARKED, PUSH, PATH, Corridor(BEND, width), *settings)
    assert refusal.value.code == code


OBSTACLE = np.array([[0.11, -0.03], [0.13, -0.03], [0.13, 0.02], [0.11, 0.02]])
NOW = 1000.8
"""Of the cell, 0.8 s after the departure."""


def take(plan: PathPlan) -> bool:
    """An arm that is not past where the plans part."""
    return True


def steering(plan: PathPlan, timeout: float = 0.2) -> Steering:
    """In contact for a while, without a correction for 0.1 s, at `NOW`."""
    own = Steering(PathRequest(PATH, CORRIDOR, timeout), LIMITS, lambda: [OBSTACLE], timeout)
    own.begin(7, plan)
    for elapsed, wall in ((0.2, 50.7), (0.8, 50.8)):
        assert own.look(plan.departure + elapsed, NOW - 0.8 + elapsed, wall, take) is plan
    return own


def correction(aside: float = 0.0, *, stamp: float = NOW - 0.03, rate: float = 1.0, **changes: object) -> ToolCorrection:
    """The path from where the tool was at the frame, moved aside bit by bit."""
    time = np.linspace(0.0, 0.6, 20)
    at = stamp - (NOW - 0.8) + rate * time
    place = PATH.at(at) + np.outer(time / time[-1], [-0.78 * aside, 0.62 * aside])
    return replace(ToolCorrection(7, stamp, False, time, place), **changes)


WRONG = {
    "of another push": (correction(push_id=6), CorrectionFault.FOREIGN),
    "late": (correction(stamp=NOW - 0.3), CorrectionFault.LATE),
    "from the future": (correction(stamp=NOW + 0.3), CorrectionFault.LATE),
    "no stamp": (correction(stamp=float("nan")), CorrectionFault.OLDER),
    "not a number": (correction(position=np.full((20, 2), np.nan)), CorrectionFault.MALFORMED),
    "backwards": (correction(time=np.linspace(0.6, 0.0, 20)), CorrectionFault.MALFORMED),
    "nothing": (correction(time=np.empty(0), position=np.empty((0, 2))), CorrectionFault.MALFORMED),
    "endless": (correction(time=np.linspace(0.0, 1e9, 20)), CorrectionFault.MALFORMED),
    "longer than the loop has time for": (correction(time=np.linspace(0.0, 30.0, 20)), CorrectionFault.LONG),
    "around the world": (correction(position=correction().position + np.linspace(0.0, 4e7, 20)[:, None]), CorrectionFault.MALFORMED),
    "beyond all numbers": (correction(position=correction().position + np.linspace(0.0, 1e300, 20)[:, None]), CorrectionFault.MALFORMED),
    "elsewhere": (correction(position=correction().position + 0.02), CorrectionFault.JUMP),
    "out of the corridor": (correction(0.06), CorrectionFault.CORRIDOR),
    "too fast": (correction(rate=3.0), CorrectionFault.SPEED),
    "into another object": (correction(-0.02), CorrectionFault.OBSTACLE),
}


@pytest.mark.parametrize("name", WRONG)
def test_correction_that_cannot_be_used_is_refused_counted_and_changes_nothing(plan: PathPlan, name: str) -> None:
    wrong, fault = WRONG[name]
    own = steering(plan)
    with pytest.raises(InputError, match=fault.value):
        own.offer(wrong)
    assert own.refused == {fault: 1} and own.n_made == 0
    assert own.look(plan.departure + 0.81, NOW + 0.01, 50.81, take) is plan


def test_correction_is_made_in_time_and_one_that_is_older_than_it_is_not(plan: PathPlan) -> None:
    own = steering(plan)
    own.offer(correction(0.01))
    with pytest.raises(InputError, match="newer"):
        own.offer(correction(0.01))
    changed = own.look(plan.departure + 0.81, NOW + 0.01, 50.81, take)
    assert changed is not plan and own.n_made == 1
    np.testing.assert_allclose(changed.tool.position[-1], correction(0.01).position[-1], atol=2e-4)
    same = changed.tool.time < 0.84
    np.testing.assert_array_equal(changed.tool.position[same], plan.tool.position[: same.sum()])


def test_correction_for_which_the_arm_is_too_far_on_changes_nothing_and_a_stop_is_tried_again(plan: PathPlan) -> None:
    own = steering(plan)
    own.offer(correction(0.01))
    assert own.look(plan.departure + 0.81, NOW + 0.01, 50.81, lambda changed: False) is plan
    assert own.refused == {CorrectionFault.LATE: 1} and own.n_made == 0
    with pytest.raises(PlanningError, match="1 LATE"):  # it does not count as one that came
        own.look(plan.departure + 0.86, NOW + 0.06, 50.91, take)
    own.offer(correction(stop=True, stamp=NOW, time=np.empty(0), position=np.empty((0, 2))))
    assert own.look(plan.departure + 0.82, NOW + 0.02, 50.82, lambda changed: False) is plan
    assert own.look(plan.departure + 0.83, NOW + 0.03, 50.83, take).stop < plan.stop


def test_without_promised_corrections_the_push_ends_and_says_what_came_instead(plan: PathPlan) -> None:
    own = steering(plan)
    with pytest.raises(InputError):
        own.offer(correction(push_id=3))
    assert own.look(plan.departure + 0.85, NOW + 0.05, 50.89, take) is plan
    with pytest.raises(PlanningError, match="1 FOREIGN") as ended:
        own.look(plan.departure + 0.86, NOW + 0.06, 50.91, take)
    assert ended.value.code == PushCode.CORRECTION
    # A push that takes none needs none.
    alone = steering(plan, 0.0)
    with pytest.raises(InputError, match="without a timeout"):
        alone.offer(correction())
    assert alone.look(plan.departure + 1.2, NOW + 0.4, 60.0, take) is plan


def test_told_to_stop_the_tool_stops_at_once_and_waits_for_nothing(kinematics: ArmKinematics, plan: PathPlan) -> None:
    own = steering(plan)
    own.offer(correction(stop=True, time=np.empty(0), position=np.empty((0, 2))))
    changed = own.look(plan.departure + 0.81, NOW + 0.01, 50.81, take)
    assert changed is not plan and changed.stop - plan.departure < 0.81 + 0.3
    check_motion(kinematics, changed)
    way = np.linalg.norm(changed.tool.position[-1] - PATH.at(np.array(0.85)))
    assert way < SPEED**2 / (2 * 0.8 * changed.acceleration) + 1e-3, "no further than braking needs"
    assert own.look(changed.stop, NOW + 5.0, 60.0, take) is changed
    with pytest.raises(InputError, match="told to stop"):
        own.offer(correction(stamp=NOW))


def test_corridor_has_its_border_and_what_leaves_it_and_senseless_timeouts_are_refused() -> None:
    for corridor in (CORRIDOR, Corridor(0.25 * BEND, 0.04)):
        np.testing.assert_allclose(Corridor(corridor.line, 1e-6).excess(corridor.outline()), 0.04, rtol=0.06)
    with pytest.raises(InputError, match="leaves its corridor"):
        PathRequest(PATH, Corridor(BEND[:5], 0.01))
    with pytest.raises(InputError, match="correction_timeout"):
        PathRequest(PATH, CORRIDOR, 0.001)
    with pytest.raises(InputError, match="expected 0"):
        PathRequest(PATH.later(0.1), CORRIDOR)
