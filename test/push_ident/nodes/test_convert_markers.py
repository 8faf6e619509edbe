"""The goal, the push under way and what perception refused, as markers and back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time

from push_ident.errors import InputError
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
GOAL = Goal(np.array([0.2, 0.1, 0.5]), 0.01, np.radians(5.0))
STRAIGHT = PushPlan2D(np.zeros(2), np.array([0.0, -0.01]), np.pi / 2, 0.07, 0.1)
PLAN = GoalPush(PlanStatus.PUSH, 0.82, STRAIGHT, end=np.array([0.19, 0.1, 0.5]))
PATH = PathGoal(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), 0.05, 0.003, 0.035)


TARGET = Target(GOAL)


def drawn(plan: GoalPush | None, target: Target = TARGET, **progress: Any) -> GoalDrawing:
    """What is drawn while the third push is made."""
    progress = {"target": target, "plan": plan, "state": GoalState.PUSH, "pushes": 2} | progress
    drawing = draw_goal(GoalProgress(object_id="o1", **progress), OUTLINE)
    assert drawing is not None
    return drawing


def test_goal_and_push_come_back() -> None:
    drawing = drawn(PLAN)
    assert "10 mm and 5.0°" in drawing.words and "82 %" in drawing.chance
    found = goal_markers_from_msg(goal_markers_to_msg(drawing, Time(sec=3)))
    assert isinstance(found, GoalDrawing) and (found.object_id, found.words, found.chance) == ("o1", drawing.words, drawing.chance)
    np.testing.assert_allclose(found.goal, drawing.goal)
    np.testing.assert_allclose(found.tool, [[0.0, -0.01], [0.0, 0.06]], atol=1e-12)
    np.testing.assert_allclose(found.end, drawing.goal - [0.01, 0.0])
    assert found.edge is None
    waiting = goal_markers_from_msg(goal_markers_to_msg(drawn(None), Time()))
    assert waiting is not None and waiting.tool is None and waiting.end is None and waiting.chance == ""
    assert drawn(PLAN, state=GoalState.LEARN).tool is None, "that push is over"
    assert goal_markers_from_msg(goal_markers_to_msg(None, Time())) is None
    assert draw_goal(GoalProgress(object_id="o1"), OUTLINE) is None


def test_edge_of_a_goal_comes_back_with_what_is_risked() -> None:
    edge = TableEdge.between(np.array([0.25, -0.3]), np.array([0.25, 0.3]))
    target = Target(GOAL, EdgeHold(edge, 0.012), np.array([[0.01, 0.01], [0.09, 0.01]]), np.array([[0.05, 0.01]]))
    found = goal_markers_from_msg(goal_markers_to_msg(drawn(replace(PLAN, risk=0.004), target), Time()))
    assert found is not None and found.edge is not None and "over the edge, held by" in found.words
    assert "82 %" in found.chance and "0.4 % of being held by less than 12 mm" in found.chance
    np.testing.assert_allclose(found.edge, [[0.25, -0.3], [0.25, 0.3]])


def test_path_comes_back_with_the_tool_as_it_is_steered_and_its_corridor() -> None:
    corridor = Corridor(np.array([[0.0, 0.0], [0.04, 0.0], [0.08, 0.0]]), 0.02)
    tool = np.array([[0.0, 0.0], [0.04, 0.001], [0.08, 0.003]])
    curved = CurvedPush(PathStatus.PUSH, 0.02, STRAIGHT, np.arange(3.0), tool, corridor, 0.3, 0.08)
    steered = PathStep(PathStatus.PUSH, 0.02, curved)
    end = Target(Goal(PATH.poses[-1], PATH.position, PATH.yaw))

    def back(drawing: GoalDrawing) -> GoalDrawing:
        found = goal_markers_from_msg(goal_markers_to_msg(drawing, Time()))
        assert found is not None and found.path is not None
        np.testing.assert_allclose(found.path[[0, -1]], [[0.0, 0.0], [0.1, 0.0]])
        np.testing.assert_allclose(found.goal, OUTLINE + np.array([0.1, 0.0]))
        return found

    waiting = back(drawn(None, end, path=PATH))
    assert "100 mm at 50 mm/s" in waiting.words and waiting.tool is None and waiting.corridor is None
    planned = back(drawn(None, end, path=PATH, step=steered))
    assert "80 %" in planned.chance and planned.corridor is not None
    np.testing.assert_allclose(planned.tool, tool)
    np.testing.assert_allclose(planned.end, OUTLINE + np.array([0.08, 0.0]))
    np.testing.assert_allclose(np.abs(planned.corridor[:, 1]), 0.02)
    corrected = back(drawn(None, end, path=PATH, step=steered, tool=tool[1:] + np.array([0.0, 0.002])))
    np.testing.assert_allclose(corrected.tool, tool[1:] + np.array([0.0, 0.002]))
    straight = PathStep(PathStatus.PUSH, 0.02, straight=PathPush(PathStatus.PUSH, 0.02, STRAIGHT, 0.05))
    pushed = back(drawn(None, end, path=PATH, step=straight))
    assert pushed.corridor is None and "50 %" in pushed.chance
    np.testing.assert_allclose(pushed.tool, [[0.0, -0.01], [0.0, 0.06]], atol=1e-12)


def test_outlines_and_reasons_of_refusals_come_back_and_equal_reasons_are_counted() -> None:
    beside, small = (Refusal(why, why.value, OUTLINE + shift, 0.05) for why, shift in ((Reason.BESIDE_ROBOT, 0.0), (Reason.TOO_SMALL, 0.2)))
    found = refusals_from_msg(refusals_to_msg([beside, small], Time(sec=3)))
    for (outline, words), refusal in zip(found, (beside, small), strict=True):
        assert words == refusal.why
        np.testing.assert_allclose(outline, np.column_stack([[*refusal.outline, refusal.outline[0]], np.full(4, refusal.height)]))
    assert refusals_from_msg(refusals_to_msg([], Time())) == []
    assert summary_of([beside, small, small]).startswith(f"2 segments: {small.why}; 1 segment: touches the robot")


def test_markers_of_another_frame_are_refused() -> None:
    goal, refused = goal_markers_to_msg(drawn(PLAN), Time()), refusals_to_msg([Refusal(Reason.TOO_SMALL, "", OUTLINE, 0.05)], Time())
    for msg, convert in ((goal, goal_markers_from_msg), (refused, refusals_from_msg)):
        msg.markers[1].header.frame_id = "map"
        with pytest.raises(InputError, match="frame map, expected table"):
            convert(msg)
