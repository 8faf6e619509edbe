"""Goals, their progress and the posterior as messages."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point

from helpers.objects import hammer
from push_ident.errors import InputError, PushIdentError
from push_ident.geometry.se2 import quaternion_of_yaw
from push_ident.geometry.table import Table
from push_ident.identification.results.posterior import prior_posterior
from push_ident.nodes.convert.messages import planar_pose_of
from push_ident.nodes.convert.model import posterior_from_msg, posterior_to_msg
from push_ident.nodes.convert.table import table_from_msg, table_to_msg
from push_ident.nodes.goal_pushing.convert_goal import feedback_to_msg, request_from_msg, result_to_msg
from push_ident.nodes.goal_pushing.parameters import PARAMETERS, check_values, push_settings
from push_ident.nodes.input.table import table_of_corners
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal import Goal, GoalCode, Target
from push_ident.planning.goal_ports import GoalOutcome, GoalProgress, GoalState
from push_ident.planning.hold import EdgeHold
from push_ident.planning.planner import GoalPush, PlanStatus
from push_ident_msgs.action import PushToGoal
from push_ident_msgs.msg import ModelPosterior

EDGE = {"kind": PushToGoal.Goal.KIND_EDGE}
POINTS = [Point(x=0.15, y=-0.3), Point(x=0.15, y=0.3)]
DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}


def goal_msg(x: float, y: float, yaw: float, frame: str = "table", **fields: object) -> PushToGoal.Goal:
    msg = PushToGoal.Goal(**fields)
    msg.goal.header.frame_id = frame
    msg.goal.pose.position.x, msg.goal.pose.position.y = float(x), float(y)
    turn = msg.goal.pose.orientation
    turn.x, turn.y, turn.z, turn.w = (float(value) for value in quaternion_of_yaw(yaw))
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


@pytest.mark.parametrize("text", ["", "{}", "[]", "{" * 1000, "x" * 20_000_000])
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
        (goal_msg(0, 0, math.inf), "finite"),
        (goal_msg(1e6, 0, 0), "metres"),
        (goal_msg(0, 0, 0, frame="object_o1"), "table"),
        (goal_msg(0, 0, 0, position_tolerance=-1.0), "positive"),
        (goal_msg(0, 0, 0, yaw_tolerance=math.nan), "positive"),
        (goal_msg(0, 0, 0, time_limit=-3.0), "time_limit"),
        (goal_msg(0, 0, 0, explore=16), "explore"),
        (goal_msg(0, 0, 0, kind=7), "KIND_EDGE"),
        (goal_msg(0, 0, 0, edge=POINTS[:1], **EDGE), "1 point"),
        (goal_msg(0, 0, 0, edge=[POINTS[0]] * 2, **EDGE), "apart"),
        (goal_msg(0, 0, 0, edge=[POINTS[0], Point(x=math.nan)], **EDGE), "Edge of the table"),
        (goal_msg(0, 0, 0, overhang=math.nan, **EDGE), "overhang"),
        (goal_msg(0, 0, 0, held=-0.01, **EDGE), "held"),
        (goal_msg(0, 0, 0, yaw_tolerance=-1.0, **EDGE), "positive"),
        (goal_msg(0, 0, 0, object_id="o" * 2000), "object_id"),
    ],
)
def test_goal_that_cannot_be_is_refused_with_its_reason(msg: PushToGoal.Goal, word: str) -> None:
    with pytest.raises(InputError, match=word):
        request_from_msg(msg, DEFAULTS)


def test_goal_tilted_against_the_table_is_refused() -> None:
    msg = goal_msg(0, 0, 0)
    msg.goal.pose.orientation.x, msg.goal.pose.orientation.w = 1.0, 0.0
    with pytest.raises(InputError):
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


def test_result_has_code_and_text() -> None:
    progress = GoalProgress(pushes=4, error=np.array([0.03, 0.4]), chance=0.1, elapsed=50.0)
    msg = result_to_msg(GoalOutcome(GoalCode.MAX_PUSHES, "not at the goal\n\x1b[31m", progress))
    assert (msg.error_code, msg.pushes, msg.position_error, msg.yaw_error, msg.chance) == (PushToGoal.Result.MAX_PUSHES, 4, 0.03, 0.4, 0.1)
    assert "\n" not in msg.error_text and "\x1b" not in msg.error_text


def test_parameters_that_contradict_each_other_are_refused() -> None:
    assert push_settings(DEFAULTS, 0.018).speed_range == (0.1, 0.1)
    with pytest.raises(InputError, match="workspace"):
        push_settings(DEFAULTS | {"workspace": [0.2, -0.2, 0.0, 0.1]}, 0.018)


def test_progress_at_an_edge_names_the_pose_that_was_chosen_and_what_holds_the_object() -> None:
    edge = TableEdge.between(np.array([0.15, -0.3]), np.array([0.15, 0.3]))
    target = Target(Goal(np.array([0.12, 0.0, 0.4])), EdgeHold(edge), np.zeros((1, 2)), np.zeros((1, 2)))
    plan = GoalPush(PlanStatus.PUSH, 0.7, end=np.array([0.1, 0.2, 0.3]), risk=0.004)
    progress = GoalProgress(GoalState.PUSH, target=target, overhang=-0.02, margin=0.03, plan=plan)
    msg = feedback_to_msg(progress)
    assert planar_pose_of(msg.target) == pytest.approx([0.12, 0.0, 0.4]) and (msg.overhang, msg.margin, msg.risk) == (-0.02, 0.03, 0.004)
    np.testing.assert_allclose([(point.x, point.y) for point in msg.edge], [(0.15, -0.3), (0.15, 0.3)])
    result = result_to_msg(GoalOutcome(GoalCode.NONE, "", progress))
    assert planar_pose_of(result.target) == pytest.approx([0.12, 0.0, 0.4]) and (result.overhang, result.margin) == (-0.02, 0.03)
    unknown = result_to_msg(GoalOutcome(GoalCode.EDGE_UNKNOWN, "", GoalProgress()))
    assert math.isnan(unknown.target.position.x) and math.isnan(unknown.overhang) and math.isnan(unknown.margin)


def test_table_survives_its_message_and_comes_from_the_parameter_first() -> None:
    table = Table.rectangle(np.array([-0.5, 0.15, -0.4, 0.4]))
    np.testing.assert_allclose(table_from_msg(table_to_msg(table, Time())).corners, table.corners, atol=1e-7)
    other = table_to_msg(table, Time())
    other.header.frame_id = "map"
    with pytest.raises(InputError, match="'map', expected 'table'"):
        table_from_msg(other)
    given = table_of_corners([-0.5, -0.4, 0.15, -0.4, 0.15, 0.4, -0.5, 0.4])
    assert given is not None and table_of_corners([0.0]) is None
    np.testing.assert_array_equal(given.corners, table.corners)
    with pytest.raises(InputError, match="3 numbers"):
        check_values(DEFAULTS | {"table_corners": [0.0, 0.1, 0.2]})
