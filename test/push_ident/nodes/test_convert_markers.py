"""The goal, the push under way and what perception refused, as markers and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time

from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.convert.markers import GoalDrawing, goal_markers_from_msg, goal_markers_to_msg, refusals_from_msg, refusals_to_msg
from push_ident.nodes.goal_pushing.convert_goal import draw_goal
from push_ident.perception.refusals import Reason, Refusal, summary_of
from push_ident.physics.overhang import TableEdge
from push_ident.planning.curved_planner import CurvedPush
from push_ident.planning.goal import EdgeHold, Goal, Target
from push_ident.planning.goal_ports import GoalProgress, GoalState
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PathPush, PathStatus
from push_ident.planning.path_steps import PathStep
from push_ident.planning.planner import GoalPush, PlanStatus
from push_ident.pushing.push import PushPlan2D
from push_ident.pushing.tool_path import Corridor

OUTLINE = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.05]])
TARGET = Target(Goal(np.array([0.2, 0.1, 0.5]), 0.01, np.radians(5.0)))
STRAIGHT = PushPlan2D(np.zeros(2), np.array([0.0, -0.01]), np.pi / 2, 0.07, 0.1)
PLAN = GoalPush(PlanStatus.PUSH, 0.82, STRAIGHT, end=np.array([0.19, 0.1, 0.5]), risk=0.004)
PATH = PathGoal(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), 0.05, 0.003, 0.035)


def shown(**progress: Any) -> GoalDrawing:
    """What is shown, by way of the message, while the third push is made."""
    progress = {"object_id": "o1", "target": TARGET, "state": GoalState.PUSH, "pushes": 2} | progress
    found = goal_markers_from_msg(goal_markers_to_msg(draw_goal(GoalProgress(**progress), OUTLINE), Time(sec=3)))
    assert found is not None and found.object_id == "o1"
    return found


def test_goal_and_push_are_shown_while_they_last() -> None:
    found = shown(plan=PLAN)
    assert "10 mm and 5.0°" in found.words and "82 %" in found.chance and found.edge is None
    np.testing.assert_allclose(found.goal, transform_points(TARGET.goal.pose, OUTLINE))
    np.testing.assert_allclose(found.tool, [[0.0, -0.01], [0.0, 0.06]], atol=1e-12)
    np.testing.assert_allclose(found.end, found.goal - [0.01, 0.0])
    for waiting in (shown(), shown(plan=PLAN, state=GoalState.LEARN)):
        assert waiting.tool is None and waiting.end is None and waiting.chance == ""
    assert goal_markers_from_msg(goal_markers_to_msg(None, Time())) is None
    assert draw_goal(GoalProgress(object_id="o1"), OUTLINE) is None


def test_edge_of_a_goal_is_shown_with_what_is_risked() -> None:
    edge = TableEdge.between(np.array([0.25, -0.3]), np.array([0.25, 0.3]))
    held = Target(TARGET.goal, EdgeHold(edge, 0.012), np.array([[0.01, 0.01], [0.09, 0.01]]), np.array([[0.05, 0.01]]))
    found = shown(plan=PLAN, target=held)
    assert "over the edge, held by" in found.words and "0.4 % of being held by less than 12 mm" in found.chance
    np.testing.assert_allclose(found.edge, [[0.25, -0.3], [0.25, 0.3]])


def test_path_is_shown_with_the_tool_as_it_is_steered_and_its_corridor() -> None:
    corridor = Corridor(np.array([[0.0, 0.0], [0.04, 0.0], [0.08, 0.0]]), 0.02)
    tool = np.array([[0.0, 0.0], [0.04, 0.001], [0.08, 0.003]])
    steered = PathStep(PathStatus.PUSH, 0.02, CurvedPush(PathStatus.PUSH, 0.02, STRAIGHT, np.arange(3.0), tool, corridor, 0.3, 0.08))
    straight = PathStep(PathStatus.PUSH, 0.02, straight=PathPush(PathStatus.PUSH, 0.02, STRAIGHT, 0.05))
    along = {"path": PATH, "target": Target(Goal(PATH.poses[-1], PATH.position, PATH.yaw))}
    waiting, planned = shown(**along), shown(**along, step=steered)
    assert "100 mm at 50 mm/s" in waiting.words and waiting.tool is None and waiting.corridor is None
    np.testing.assert_allclose(waiting.path[[0, -1]], [[0.0, 0.0], [0.1, 0.0]])
    np.testing.assert_allclose(waiting.goal, OUTLINE + np.array([0.1, 0.0]))
    assert "80 %" in planned.chance
    np.testing.assert_allclose(planned.tool, tool)
    np.testing.assert_allclose(planned.end, OUTLINE + np.array([0.08, 0.0]))
    np.testing.assert_allclose(np.abs(planned.corridor[:, 1]), 0.02)
    np.testing.assert_allclose(shown(**along, step=steered, tool=tool[1:] + 0.002).tool, tool[1:] + 0.002)
    pushed = shown(**along, step=straight)
    assert pushed.corridor is None and "50 %" in pushed.chance and len(pushed.tool) == 2


def test_outlines_and_reasons_of_refusals_come_back_and_equal_reasons_are_counted() -> None:
    beside, small = (Refusal(why, why.value, OUTLINE + shift, 0.05) for why, shift in ((Reason.BESIDE_ROBOT, 0.0), (Reason.TOO_SMALL, 0.2)))
    found = refusals_from_msg(refusals_to_msg([beside, small], Time(sec=3)))
    for (outline, words), refusal in zip(found, (beside, small), strict=True):
        assert words == refusal.why
        np.testing.assert_allclose(outline, np.column_stack([[*refusal.outline, refusal.outline[0]], np.full(4, refusal.height)]))
    assert refusals_from_msg(refusals_to_msg([], Time())) == []
    assert summary_of([beside, small, small]).startswith(f"2 segments: {small.why}; 1 segment: touches the robot")


def test_markers_of_another_frame_are_refused() -> None:
    goal, refused = goal_markers_to_msg(shown(plan=PLAN), Time()), refusals_to_msg([Refusal(Reason.TOO_SMALL, "", OUTLINE, 0.05)], Time())
    for msg, convert in ((goal, goal_markers_from_msg), (refused, refusals_from_msg)):
        msg.markers[1].header.frame_id = "map"
        with pytest.raises(InputError, match="frame map, expected table"):
            convert(msg)
