"""Paths of the tool, their corrections and paths of objects survive their messages; what is none is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, PoseStamped

from push_ident.errors import InputError
from push_ident.nodes.convert.tool_path import correction_from_msg, correction_to_msg, path_goal, path_request_from_goal
from push_ident.nodes.goal_pushing.convert_goal import feedback_to_msg, planar_pose_msg, request_from_msg, result_to_msg
from push_ident.nodes.goal_pushing.parameters import PARAMETERS
from push_ident.planning.goal import GoalCode
from push_ident.planning.goal_ports import GoalOutcome, GoalProgress
from push_ident.planning.path_goal import PathGoal
from push_ident.pushing.steering import PathRequest, ToolCorrection
from push_ident.pushing.tool_path import Corridor, ToolPath
from push_ident_msgs.action import PushToGoal

WAY = np.array([[0.0, 0.0], [0.03, 0.0], [0.08, 0.02]])
REQUEST = PathRequest(ToolPath(np.array([0.0, 0.3, 0.9]), WAY), Corridor(WAY, 0.04), 0.3)
CORRECTION = ToolCorrection(7, 12.5, False, np.array([0.0, 0.5]), WAY[1:])
DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}


def test_push_along_a_path_and_its_corrections_survive_their_messages() -> None:
    found = path_request_from_goal(path_goal("box", REQUEST))
    np.testing.assert_array_equal(found.path.position, WAY)
    np.testing.assert_array_equal(found.corridor.line, WAY)
    assert (found.correction_timeout, found.corridor.half_width) == (0.3, 0.04)
    for correction in (CORRECTION, replace(CORRECTION, stop=True, time=np.empty(0), position=np.empty((0, 2)))):
        again = correction_from_msg(correction_to_msg(correction))
        assert (again.push_id, again.stamp, again.stop) == (7, 12.5, correction.stop)
        np.testing.assert_array_equal(again.position, correction.position)


def shorter(goal: Any) -> None:
    goal.tool_path.x = goal.tool_path.x[:2]


def elsewhere(goal: Any) -> None:
    goal.frame_id = "object_box"


def endless(goal: Any) -> None:
    goal.tool_path.time[2] = 1e9


def no_corridor(goal: Any) -> None:
    goal.corridor = [Point()]


@pytest.mark.parametrize(
    ("change", "words"), [(shorter, "as many"), (elsewhere, "frame"), (endless, "duration"), (no_corridor, "corridor")]
)
def test_goal_that_is_no_path_of_the_tool_is_refused(change: Any, words: str) -> None:
    goal = path_goal("box", REQUEST)
    change(goal)
    with pytest.raises(InputError, match=words):
        path_request_from_goal(goal)


def test_path_of_an_object_becomes_a_request_with_the_defaults_of_the_node_and_its_progress_a_message() -> None:
    msg = PushToGoal.Goal(kind=PushToGoal.Goal.KIND_PATH)
    msg.path.poses = [PoseStamped(pose=planar_pose_msg(np.array([x, 0.0, 0.5]))) for x in (0.0, 0.1)]
    goal = request_from_msg(msg, DEFAULTS).goal
    assert (
        isinstance(goal, PathGoal) and (goal.speed, goal.position, goal.yaw) == (0.05, 0.003, 0.035) and goal.length == pytest.approx(0.1)
    )
    msg.speed, msg.path.header.frame_id = 0.1, "camera"
    with pytest.raises(InputError, match="camera"):
        request_from_msg(msg, DEFAULTS)
    progress = GoalProgress(done=0.4, rms=np.array([0.002, 0.01]), corrections=12)
    result = result_to_msg(GoalOutcome(GoalCode.NONE, "", progress))
    assert (feedback_to_msg(progress).done, result.done, result.rms_position, result.rms_yaw, result.corrections) == (
        0.4,
        0.4,
        0.002,
        0.01,
        12,
    )
