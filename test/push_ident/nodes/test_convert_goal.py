"""Goals, their progress and the posterior as messages; what cannot be at all: `test_convert_any_message.py`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped

from helpers.objects import hammer
from push_ident.errors import InputError, PushIdentError
from push_ident.geometry.table import Table
from push_ident.identification.results.posterior import prior_posterior
from push_ident.nodes.convert.messages import planar_pose_of
from push_ident.nodes.convert.model import posterior_from_msg, posterior_to_msg
from push_ident.nodes.convert.table import table_from_msg, table_to_msg
from push_ident.nodes.convert.tool_path import correction_from_msg, correction_to_msg, path_goal, path_request_from_goal
from push_ident.nodes.goal_pushing.convert_goal import feedback_to_msg, planar_pose_msg, request_from_msg, result_to_msg
from push_ident.nodes.goal_pushing.parameters import PARAMETERS, check_values
from push_ident.nodes.input.table import table_of_corners
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal import EdgeHold, Goal, GoalCode, Target
from push_ident.planning.goal_ports import GoalOutcome, GoalProgress, GoalState
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.planner import GoalPush, PlanStatus
from push_ident.pushing.steering import PathRequest, ToolCorrection
from push_ident.pushing.tool_path import Corridor, ToolPath
from push_ident_msgs.action import ExecutePush, PushToGoal
from push_ident_msgs.msg import ModelPosterior

EDGE = {"kind": PushToGoal.Goal.KIND_EDGE}
POINTS = [Point(x=0.15, y=-0.3), Point(x=0.15, y=0.3)]
WAY = np.array([[0.0, 0.0], [0.03, 0.0], [0.08, 0.02]])
REQUEST = PathRequest(ToolPath(np.array([0.0, 0.3, 0.9]), WAY), Corridor(WAY, 0.04), 0.3)
CORRECTION = ToolCorrection(7, 12.5, False, np.array([0.0, 0.5]), WAY[1:])
DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}


def goal_msg(x: float, y: float, yaw: float, frame: str = "table", **fields: object) -> PushToGoal.Goal:
    msg = PushToGoal.Goal(**fields)
    msg.goal.header.frame_id = frame
    msg.goal.pose = planar_pose_msg(np.array([x, y, yaw]))
    return msg


def test_posterior_survives_its_message_to_the_last_bit() -> None:
    posterior = prior_posterior(hammer(2).shape)
    msg = posterior_to_msg(posterior, "o1", Time(sec=7, nanosec=5), n_pushes=3, is_known=True)
    assert (msg.object_id, msg.n_pushes, msg.is_known, msg.header.frame_id) == ("o1", 3, True, "object_o1")
    stamp, again = posterior_from_msg(msg)
    assert stamp == pytest.approx(7.000000005, abs=1e-9)
    assert np.array_equal(again.z, posterior.z) and np.array_equal(again.covariance, posterior.covariance)
    assert np.array_equal(again.unknowns.shape.outline, posterior.unknowns.shape.outline)
    assert np.array_equal(again.model.mass, posterior.model.mass)


@pytest.mark.parametrize("text", ["", "{" * 1000, "x" * 20_000_000])
def test_text_that_is_no_model_is_refused(text: str) -> None:
    with pytest.raises(PushIdentError, match=r"model of object o1"):
        posterior_from_msg(ModelPosterior(object_id="o1", model=text))


def test_zeros_of_a_goal_stand_for_the_parameters() -> None:
    request = request_from_msg(goal_msg(0.1, -0.05, 2.5, frame=""), DEFAULTS)
    assert request.goal.pose == pytest.approx([0.1, -0.05, 2.5])
    assert (request.goal.position, request.goal.yaw) == (0.02, 0.1)
    assert (request.time_limit, request.max_pushes, request.explore, request.object_id) == (300.0, 15, 0, "")
    given = request_from_msg(
        goal_msg(0, 0, 0, position_tolerance=0.01, yaw_tolerance=0.2, time_limit=7.0, max_pushes=3, explore=2), DEFAULTS
    )
    assert (given.goal.position, given.goal.yaw, given.time_limit, given.max_pushes, given.explore) == (0.01, 0.2, 7.0, 3, 2)


def test_goal_at_an_edge_is_the_told_edge_or_the_nearest_with_parameters_for_zeros() -> None:
    goal = request_from_msg(goal_msg(9.0, 9.0, 0.7, **EDGE), DEFAULTS).goal
    assert isinstance(goal, EdgeGoal) and goal.edge is None and goal.yaw is None
    assert (goal.overhang, goal.held, goal.position, goal.limit) == (0.04, 0.01, 0.02, 0.01) and goal.turn == pytest.approx(
        np.radians(15.0)
    )
    told = goal_msg(0, 0, 0.7, edge=POINTS, overhang=0.05, held=0.02, use_heading=True, position_tolerance=0.01, yaw_tolerance=0.3, **EDGE)
    goal = request_from_msg(told, DEFAULTS | {"edge_risk": 0.003}).goal
    assert isinstance(goal, EdgeGoal) and goal.edge is not None
    np.testing.assert_allclose(goal.edge.outward, [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(goal.edge.ends, [[0.15, -0.3], [0.15, 0.3]])
    assert (goal.overhang, goal.held, goal.yaw, goal.position, goal.turn, goal.limit) == (0.05, 0.02, pytest.approx(0.7), 0.01, 0.3, 0.003)


@pytest.mark.parametrize(
    ("msg", "word"),
    [
        (goal_msg(math.nan, 0, 0), "finite"),
        (goal_msg(0, 0, 0, frame="object_o1"), "table"),
        (goal_msg(0, 0, 0, yaw_tolerance=-1.0), "positive"),
        (goal_msg(0, 0, 0, time_limit=-3.0), "time_limit"),
        (goal_msg(0, 0, 0, explore=16), "explore"),
        (goal_msg(0, 0, 0, kind=7), "KIND_EDGE"),
        (goal_msg(0, 0, 0, edge=POINTS[:1], **EDGE), "1 point"),
        (goal_msg(0, 0, 0, edge=[POINTS[0]] * 2, **EDGE), "apart"),
        (goal_msg(0, 0, 0, held=-0.01, **EDGE), "held"),
        (goal_msg(0, 0, 0, object_id="o" * 2000), "object_id"),
    ],
)
def test_goal_that_cannot_be_is_refused_with_its_reason(msg: PushToGoal.Goal, word: str) -> None:
    with pytest.raises(InputError, match=word):
        request_from_msg(msg, DEFAULTS)


def test_progress_says_nothing_of_what_was_not_observed_or_predicted() -> None:
    msg = feedback_to_msg(GoalProgress(GoalState.EXPLORE, pushes=2, observed=1))
    assert msg.state == PushToGoal.Feedback.STATE_EXPLORE and msg.pushes == 1 and not msg.is_predicted
    assert math.isnan(msg.position_error) and math.isnan(msg.pose.position.x) and math.isnan(msg.pose.orientation.w)
    plan = GoalPush(PlanStatus.PUSH, 0.7, end=np.array([0.1, 0.2, 0.3]))
    seen = GoalProgress(GoalState.PUSH, pose=np.array([0.05, 0.0, -3.0]), error=np.array([0.03, 0.4]), plan=plan, elapsed=12.0)
    msg = feedback_to_msg(seen)
    assert msg.is_predicted and msg.expected_chance == 0.7 and planar_pose_of(msg.expected_pose) == pytest.approx([0.1, 0.2, 0.3])
    assert planar_pose_of(msg.pose) == pytest.approx([0.05, 0.0, -3.0]) and (msg.position_error, msg.yaw_error) == (0.03, 0.4)


def test_progress_at_an_edge_names_the_pose_that_was_chosen_and_what_holds_the_object() -> None:
    edge = TableEdge.between(np.array([0.15, -0.3]), np.array([0.15, 0.3]))
    target = Target(Goal(np.array([0.12, 0.0, 0.4])), EdgeHold(edge), np.zeros((1, 2)), np.zeros((1, 2)))
    plan = GoalPush(PlanStatus.PUSH, 0.7, end=np.array([0.1, 0.2, 0.3]), risk=0.004)
    progress = GoalProgress(GoalState.PUSH, target=target, overhang=-0.02, margin=0.03, plan=plan, pushes=4)
    msg = feedback_to_msg(progress)
    assert planar_pose_of(msg.target) == pytest.approx([0.12, 0.0, 0.4]) and (msg.overhang, msg.margin, msg.risk) == (-0.02, 0.03, 0.004)
    np.testing.assert_allclose([(point.x, point.y) for point in msg.edge], [(0.15, -0.3), (0.15, 0.3)])
    result = result_to_msg(GoalOutcome(GoalCode.MAX_PUSHES, "not at the goal\n\x1b[31m", progress))
    assert planar_pose_of(result.target) == pytest.approx([0.12, 0.0, 0.4]) and (result.overhang, result.margin) == (-0.02, 0.03)
    assert (result.error_code, result.pushes) == (PushToGoal.Result.MAX_PUSHES, 4) and result.error_text.isprintable()
    unknown = result_to_msg(GoalOutcome(GoalCode.EDGE_UNKNOWN, "", GoalProgress()))
    assert math.isnan(unknown.target.position.x) and math.isnan(unknown.overhang) and math.isnan(unknown.margin)


def test_table_survives_its_message_and_its_parameter_is_checked() -> None:
    table = Table.rectangle(np.array([-0.5, 0.15, -0.4, 0.4]))
    np.testing.assert_allclose(table_from_msg(table_to_msg(table, Time())).corners, table.corners, atol=1e-7)
    given = table_of_corners([-0.5, -0.4, 0.15, -0.4, 0.15, 0.4, -0.5, 0.4])
    assert given is not None and table_of_corners([0.0]) is None
    np.testing.assert_array_equal(given.corners, table.corners)
    for wrong, words in (({"table_corners": [0.0, 0.1, 0.2]}, "3 numbers"), ({"workspace": [0.2, -0.2, 0.0, 0.1]}, "workspace")):
        with pytest.raises(InputError, match=words):
            check_values(DEFAULTS | wrong)


def test_push_along_a_path_and_its_corrections_survive_their_messages() -> None:
    found = path_request_from_goal(path_goal("box", REQUEST))
    np.testing.assert_array_equal(found.path.position, WAY)
    np.testing.assert_array_equal(found.corridor.line, WAY)
    assert (found.correction_timeout, found.corridor.half_width) == (0.3, 0.04)
    for correction in (CORRECTION, replace(CORRECTION, stop=True, time=np.empty(0), position=np.empty((0, 2)))):
        again = correction_from_msg(correction_to_msg(correction))
        assert (again.push_id, again.stamp, again.stop) == (7, 12.5, correction.stop)
        np.testing.assert_array_equal(again.position, correction.position)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda goal: goal.tool_path.x.pop(), "as many"),
        (lambda goal: setattr(goal, "frame_id", "object_box"), "frame"),
        (lambda goal: goal.tool_path.time.__setitem__(2, 1e9), "duration"),
        (lambda goal: setattr(goal, "corridor", [Point()]), "corridor"),
    ],
)
def test_goal_that_is_no_path_of_the_tool_is_refused(change: Callable[[ExecutePush.Goal], object], words: str) -> None:
    goal = path_goal("box", REQUEST)
    change(goal)
    with pytest.raises(InputError, match=words):
        path_request_from_goal(goal)


def test_path_of_an_object_becomes_a_request_with_the_defaults_of_the_node_and_its_progress_a_message() -> None:
    msg = PushToGoal.Goal(kind=PushToGoal.Goal.KIND_PATH)
    msg.path.poses = [PoseStamped(pose=planar_pose_msg(np.array([x, 0.0, 0.5]))) for x in (0.0, 0.1)]
    goal = request_from_msg(msg, DEFAULTS).goal
    assert isinstance(goal, PathGoal) and (goal.speed, goal.position, goal.yaw) == (0.05, 0.003, 0.035)
    assert goal.length == pytest.approx(0.1)
    msg.speed, msg.path.header.frame_id = 0.1, "camera"
    with pytest.raises(InputError, match="camera"):
        request_from_msg(msg, DEFAULTS)
    progress = GoalProgress(done=0.4, rms=np.array([0.002, 0.01]), corrections=12)
    result = result_to_msg(GoalOutcome(GoalCode.NONE, "", progress))
    assert (result.done, result.rms_position, result.rms_yaw, result.corrections) == (0.4, 0.002, 0.01, 12)
    assert feedback_to_msg(progress).done == 0.4
