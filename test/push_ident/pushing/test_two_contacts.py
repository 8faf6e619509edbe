"""Pushes with a tool of two contacts: one end in front on straight pushes, both on a path on which it turns."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from helpers.memory_cell import CONTACT, PARKED, SETTINGS, SHAPE, Bench, Cell, code_of
from push_ident.errors import InputError, PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.planning.stable import Support, contact_on_face, shortest_stable_push, stable_turns
from push_ident.pushing.motion import ArmPlan, TurningPlan, plan_push, plan_turning_push
from push_ident.pushing.ports import Phase
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings, tool_shape, tool_sizes
from push_ident.pushing.push_request import Mode, PushRequest
from push_ident.pushing.sampling import push_from_goal, push_with_both_ends
from push_ident.pushing.steering import PathRequest
from push_ident.pushing.tool_path import Corridor, ToolPath
from push_ident.types import Float64Array, PusherShape

FINGERS = PushSettings(workspace=(-0.2, 0.2, -0.25, 0.25), pusher_radius=0.008, finger_distance=0.04)
CELL = replace(SETTINGS, push=FINGERS, lost_timeout=0.4)
MOTION = SETTINGS.motion
BACK = MOTION.back_off
START, GOAL = np.array([0.0, 0.02, 0.3]), np.array([0.07, -0.06, 1.2])


def carrying(start: Float64Array = START, goal: Float64Array = GOAL, speed: float = 0.05) -> ToolPath:
    """A path by which both fingers carry the box from one pose to another, if its load is even."""
    support = Support.of_models(SHAPE.cells.centres, np.ones(len(SHAPE.cells)))
    contacts = (contact_on_face(SHAPE, FINGERS.tool, face, 0.5 * side) for face, side in enumerate((0.1, 0.06, 0.1, 0.06)))
    turns = [stable_turns(contact, support, 0.3, speed) for contact in contacts if contact is not None]
    push = shortest_stable_push(
        [one for one in turns if one], start, goal, FINGERS.tool, speed=speed, clearance=0.03, workspace=FINGERS.workspace
    )
    assert push is not None
    return ToolPath(push.path.time, push.path.position, push.path.yaw)


PATH = carrying()


def poses_of(kinematics: ArmKinematics, plan: ArmPlan, begin: float, end: float) -> Float64Array:
    """Of the tip between two times of a plan (x, y, yaw, z), by the kinematics alone."""
    time = plan.trajectory.time
    tips = [kinematics.forward(q) for q in plan.trajectory.position[(time >= begin) & (time <= end)]]
    yaw = np.unwrap([math.atan2(tip[1, 0], tip[0, 0]) for tip in tips])
    return np.column_stack([[tip[0, 3] for tip in tips], [tip[1, 3] for tip in tips], yaw, [tip[2, 3] for tip in tips]])


@pytest.fixture(scope="module")
def turning(kinematics: ArmKinematics) -> TurningPlan:
    return plan_turning_push(kinematics, PARKED, push_with_both_ends(SHAPE, START, PATH, FINGERS, back_off=BACK), PATH, MOTION, 0.04)


def test_both_ends_follow_the_path_within_the_limits_of_the_joints(kinematics: ArmKinematics, turning: TurningPlan) -> None:
    made = poses_of(kinematics, turning, turning.departure, turning.stop)
    assert np.ptp(PATH.poses[:, 2]) > 0.5 and np.abs(made[:, 3] - MOTION.push_height).max() < 1e-4
    frame = made[:, :3] - [0.0, 0.0, turning.turn]
    wanted = PATH.dense_poses(5e-4, 0.02)[1]
    for end in (0.02, -0.02):
        one, other = (transform_points(poses, np.array([[0.0, end]]))[:, 0] for poses in (frame, wanted))
        # Every place is on the line, and the whole line is driven.
        away = np.linalg.norm(one[:, None] - other[None], axis=2)
        assert away.min(axis=1).max() < 5e-4 and away.min(axis=0).max() < 2e-3
    assert frame[-1] == pytest.approx(PATH.poses[-1], abs=1e-5)
    assert np.all(np.abs(turning.trajectory.acceleration) <= turning.limits.acceleration * 1.001)
    assert np.all(np.abs(turning.trajectory.velocity) <= turning.limits.velocity * 1.001)
    at_contact = kinematics.forward(turning.trajectory.follow(np.array([turning.contact]))[0][0])[:2, 3]
    assert at_contact == pytest.approx(PATH.position[1], abs=1e-3)
    assert turning.tool_yaw is not None and turning.tool_yaw == pytest.approx(made[:, 2], abs=1e-9)


def test_tool_comes_down_backs_off_its_face_and_rises_without_turning(kinematics: ArmKinematics, turning: TurningPlan) -> None:
    down = poses_of(kinematics, turning, turning.lowered - 0.15, turning.departure)
    away = poses_of(kinematics, turning, turning.rested, turning.rested + 0.6)
    low = away[away[:, 3] < 0.05]
    for rows in (down, low):
        assert len(rows) > 10 and np.ptp(rows[:, 2]) < 1e-4
    backed = low[:, :2] - low[0, :2]
    heading = np.array([math.cos(PATH.poses[-1, 2]), math.sin(PATH.poses[-1, 2])])
    assert backed[-1] == pytest.approx(-BACK * heading, abs=1e-4)
    assert turning.away_from(turning.stop) == pytest.approx(heading, abs=1e-3)


def test_joints_that_are_too_weak_make_the_push_slower_and_too_short_a_clearance_refuses_it(kinematics: ArmKinematics) -> None:
    push = push_with_both_ends(SHAPE, START, PATH, FINGERS, back_off=BACK)
    weak = replace(MOTION, max_joint_velocity=0.4, joint_acceleration_limits=(1.5,), max_joint_acceleration=1.5)
    slow = plan_turning_push(kinematics, PARKED, push, PATH, weak, 0.04)
    fast = plan_turning_push(kinematics, PARKED, push, PATH, MOTION, 0.04)

    assert slow.push.speed < 0.9 * fast.push.speed and slow.stop - slow.departure > fast.stop - fast.departure
    assert np.all(np.abs(slow.trajectory.acceleration) <= slow.limits.acceleration * 1.001)
    with pytest.raises(PlanningError, match="within the clearance") as refusal:
        plan_turning_push(kinematics, PARKED, push, PATH, replace(MOTION, clearance=1e-5), 0.04)
    assert refusal.value.code == PushCode.LIMIT


def test_tool_is_turned_by_half_a_turn_where_the_wrist_ends(kinematics: ArmKinematics) -> None:
    """Both ends are alike: of 12 paths with any heading some need it, and the ends are where the path has them."""
    turns, rng = [], np.random.default_rng(4)
    for _ in range(12):
        start, goal = (np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(-3.0, 3.0)]) for _ in range(2))
        path = carrying(start, goal, 0.03)
        try:
            push = push_with_both_ends(SHAPE, start, path, FINGERS, back_off=BACK)
            plan = plan_turning_push(kinematics, PARKED, push, path, MOTION, 0.04)
        except PlanningError as error:
            assert error.code in (PushCode.UNREACHABLE, PushCode.LIMIT)
            continue
        end = poses_of(kinematics, plan, plan.stop - 1e-6, plan.stop + 1e-6)[0]
        ends = [np.sort(FINGERS.ends(pose[None])[0], axis=0) for pose in (end[:3], path.poses[-1])]
        np.testing.assert_allclose(*ends, atol=1e-5)
        turns.append(plan.turn)
    assert len(turns) >= 8 and {0.0, math.pi} == set(turns)


def test_one_end_is_in_front_of_a_straight_push(kinematics: ArmKinematics) -> None:
    push = push_from_goal(SHAPE, START, np.array([0.0, -0.01]), 1.6, 0.05, 0.1, FINGERS)
    assert push.tool_at_contact == pytest.approx(push.contact_point + 0.008 * np.array([math.sin(0.3), -math.cos(0.3)]), abs=1e-9)
    plan = plan_push(kinematics, PARKED, push, MOTION, FINGERS.span)
    (pose,) = poses_of(kinematics, plan, plan.stop - 1e-6, plan.stop + 1e-6)
    ends = FINGERS.ends(pose[None, :3])[0]
    front = ends[np.argmax(ends @ push.heading)]
    assert front == pytest.approx(push.tool_end, abs=1e-4)
    assert abs(float(wrap_angle(pose[2] - push.direction))) == pytest.approx(math.pi / 2, abs=1e-4)
    low = poses_of(kinematics, plan, plan.lowered, plan.rested)
    assert np.ptp(low[:, 2]) < 1e-4
    round_tool = plan_push(kinematics, PARKED, push, MOTION)
    assert round_tool.yaw is None and round_tool.push == push


@pytest.mark.parametrize("sizes", [{"finger_distance": 0.04}, {"plate_length": 0.04}], ids=["fingers", "plate"])
def test_rear_end_must_not_come_down_on_another_object_nor_outside_of_the_workspace(sizes: dict[str, float]) -> None:
    settings = PushSettings(workspace=(-0.2, 0.2, -0.25, 0.25), pusher_radius=0.008, **sizes)
    request: tuple[Any, ...] = (SHAPE, np.zeros(3), np.array([0.0, -0.03]), math.pi / 2, 0.05, 0.1)
    round_tool = replace(settings, finger_distance=0.0, plate_length=0.0)
    # Behind the start of a round tool, 68 mm below the middle, and 22 mm beside the rear end.
    behind = np.array([[-0.01, -0.13], [0.01, -0.13], [0.01, -0.10], [-0.01, -0.10]])
    push_from_goal(*request, round_tool, [behind])
    with pytest.raises(PlanningError, match="cannot be lowered"):
        push_from_goal(*request, settings, [behind])
    narrow = replace(round_tool, workspace=(-0.2, 0.2, -0.08, 0.25))
    push_from_goal(*request, narrow)
    with pytest.raises(PlanningError, match="leaves the workspace"):
        push_from_goal(*request, replace(settings, workspace=narrow.workspace))


def shifted(path: ToolPath, by: tuple[float, float, float]) -> ToolPath:
    """A path whose places are those of a tool moved in its own frame."""
    poses = compose(path.poses, np.array(by))
    return ToolPath(path.time, poses[:, :2], poses[:, 2])


@pytest.mark.parametrize(
    ("settings", "path", "code", "words"),
    [
        ({"finger_distance": 0.0}, PATH, PushCode.INVALID_GOAL, "the tool is a cylinder"),
        ({}, shifted(PATH, (-0.006, 0.0, 0.0)), PushCode.INVALID_GOAL, "6.0 mm from the object"),
        ({}, shifted(PATH, (0.006, 0.0, 0.0)), PushCode.INVALID_GOAL, "-6.0 mm from the object"),
        (
            {"max_speed": 0.04, "distance_range": (0.04, 0.1), "speed_range": (0.01, 0.02)},
            PATH,
            PushCode.INVALID_GOAL,
            "an end of the tool",
        ),
        ({"workspace": (-0.2, 0.2, -0.25, 0.06)}, PATH, PushCode.LIMIT, "leaves the workspace"),
        ({"lowering_gap": 0.029}, shifted(PATH, (0.004, 0.0, 0.0)), PushCode.UNREACHABLE, "mm from an object"),
    ],
    ids=["cylinder", "too far", "too near", "too fast", "outside", "no room to come down"],
)
def test_path_that_is_none_for_the_tool_is_refused(settings: dict[str, Any], path: ToolPath, code: PushCode, words: str) -> None:
    with pytest.raises(PlanningError, match=words) as refusal:
        push_with_both_ends(SHAPE, START, path, replace(FINGERS, **settings), back_off=BACK)
    assert refusal.value.code == code


def test_circle_around_a_turning_tool_keeps_clear_of_others_also_where_it_backs_off() -> None:
    """It touches a face, goes along it to the left, and backs off where it has not been: the circle has 28 mm, the tool's back 8 mm."""
    path = ToolPath(np.array([0.0, 0.6, 1.8]), np.array([[-0.088, 0.0], [-0.058, 0.0], [-0.058, 0.06]]), np.zeros(3))
    size = 0.002 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    behind = -0.058 - BACK - 0.028 - 0.002
    push_with_both_ends(SHAPE, np.zeros(3), path, FINGERS, [size + np.array([behind - 1e-3, 0.06])], back_off=BACK)
    for x, y in ((behind + 1e-3, 0.06), (-0.058, 0.089)):
        with pytest.raises(PlanningError, match="mm from an object"):
            push_with_both_ends(SHAPE, np.zeros(3), path, FINGERS, [size + np.array([x, y])], back_off=BACK)


class Carried:
    """The box goes with the tool from where both ends touch it."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self.in_tool, self.tool = bench, None, np.zeros(3)
        bench.cell.is_box_fixed = True
        bench.cell.events.append(self)

    def __call__(self, cell: Cell) -> None:
        tip = cell.planner.forward(cell.q)
        self.tool = np.array([*tip[:2, 3], math.atan2(tip[1, 0], tip[0, 0])])
        if not self.bench.execution.is_pushing or tip[2, 3] > 0.05:
            self.in_tool = None
        elif self.in_tool is not None:
            cell.box = compose(self.tool, self.in_tool)
        elif np.linalg.norm(self.tool[:2] - PATH.position[1]) < 1e-3:
            self.in_tool = compose(inverse(self.tool), cell.box)


ALONG = PushRequest(Mode.PATH, "box", path=PATH)


def test_execution_carries_the_box_to_its_goal_and_goes_home(bench: Bench) -> None:
    Carried(bench)
    outcome = bench.push(ALONG, CELL)
    assert code_of(outcome) == PushCode.NONE, outcome.error
    box = bench.cell.box - [0.0, 0.0, 2 * math.pi * round((bench.cell.box[2] - GOAL[2]) / (2 * math.pi))]
    assert box == pytest.approx(GOAL, abs=3e-3)
    assert bench.cell.q == pytest.approx(PARKED, abs=1e-3)
    assert list(dict.fromkeys(bench.client.phases)) == [Phase.PLAN, Phase.APPROACH, Phase.PUSH, Phase.REST, Phase.RETREAT]
    (push,) = bench.pushes
    assert push.contact is not None and push.contact - push.started == pytest.approx(push.plan.contact, abs=0.05)


def test_tool_backs_off_its_face_where_the_box_is_lost_on_the_way(bench: Bench) -> None:
    carried, at = Carried(bench), []

    def hide(cell: Cell) -> None:
        cell.is_hidden = cell.is_hidden or cell.box[2] > 0.7

    def note(cell: Cell) -> None:
        if cell.is_hidden and cell.tip[2] < 0.02:
            at.append(carried.tool.copy())

    bench.cell.events += [hide, note]
    outcome = bench.push(ALONG, CELL)
    assert code_of(outcome) == PushCode.OBJECT_LOST and "went home" in str(outcome.error)
    stood = max(range(1, len(at)), key=lambda k: float(np.linalg.norm(at[k][:2] - at[0][:2])))
    away, backed = at[-1], at[-1][:2] - at[stood][:2]
    yaw = away[2] - (bench.pushes[0].plan.turn if isinstance(bench.pushes[0].plan, TurningPlan) else math.nan)
    assert float(backed @ [math.cos(yaw), math.sin(yaw)]) == pytest.approx(-BACK, abs=2e-3)
    assert abs(float(wrap_angle(away[2] - at[stood][2]))) < 2e-3


def test_random_and_given_pushes_of_the_execution_have_one_end_in_front(bench: Bench) -> None:
    for request in (CONTACT, PushRequest(Mode.RANDOM, dry_run=True, seed=3)):
        outcome = bench.push(replace(request, dry_run=True), CELL)
        assert code_of(outcome) == PushCode.NONE and outcome.plan is not None and outcome.plan.tool_yaw is not None
        across = wrap_angle(outcome.plan.tool_yaw - outcome.plan.push.direction)
        assert np.abs(across) == pytest.approx(math.pi / 2, abs=1e-3)


def test_path_without_yaws_is_refused_by_a_tool_that_needs_them(bench: Bench) -> None:
    round_path = PathRequest(ToolPath(PATH.time, PATH.position), Corridor(PATH.position, 0.02))
    for path, words in ((None, "without a path"), (round_path, "no yaws")):
        outcome = bench.push(PushRequest(Mode.PATH, "box", path=path), CELL)
        assert code_of(outcome) == PushCode.INVALID_GOAL and words in str(outcome.error)


@pytest.mark.parametrize(
    ("yaw", "words"),
    [([0.0], "shape"), ([0.0, np.nan], "finite"), ([0.0, 3.5], "do not wrap"), ([200.0, 200.0], "100 rad")],
)
def test_yaws_that_are_none_are_refused(yaw: list[float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        ToolPath(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [0.1, 0.0]]), np.array(yaw))


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ((0.01, 0.015), "expected more than 0.02 m"),
        ((0.01, -0.1), "finger_distance is -0.1 m"),
        ((0.01, 0.0, -0.1), "plate_length is -0.1 m"),
        ((0.01, np.inf), "finger_distance is inf m"),
        ((0.01, 0.05, 0.05), "take the other out"),
    ],
)
def test_impossible_tools_are_refused(sizes: tuple[float, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        tool_shape(*sizes)


def test_tools_whose_contacts_are_elsewhere_have_no_sizes() -> None:
    assert tool_sizes(tool_shape(0.004, 0.03)) == {"pusher_radius": 0.004, "finger_distance": 0.03, "plate_length": 0.0}
    for fingers in ([[0.03, 0.0], [0.0, 0.0]], [[0.0, 0.03], [0.0, 0.0]]):
        with pytest.raises(InputError, match="y axis"):
            tool_sizes(PusherShape(0.004, fingers=np.array(fingers)))
    with pytest.raises(InputError, match="3 points"):
        tool_sizes(PusherShape(0.004, np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]])))
    assert PushPlan2D(np.zeros(2), np.array([0.1, 0.0]), 0.0, 0.05, 0.1).of_frame(0.04).tool_at_contact == pytest.approx([0.08, 0.0])
