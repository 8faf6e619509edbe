"""The goal and the push under way, as markers and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from visualization_msgs.msg import Marker, MarkerArray

from push_ident.errors import InputError
from push_ident.nodes.convert_goal_markers import GoalDrawing, draw_goal, goal_markers_from_msg, goal_markers_to_msg
from push_ident.physics.overhang import TableEdge
from push_ident.planning.goal import Goal
from push_ident.planning.hold import EdgeHold
from push_ident.planning.planner import GoalPush, PlanStatus
from push_ident.planning.target import Target
from push_ident.pushing.push import PushPlan2D

OUTLINE = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.05]])
GOAL = Goal(np.array([0.2, 0.1, 0.5]), 0.01, np.radians(5.0))
PLAN = GoalPush(
    PlanStatus.PUSH, 0.82, PushPlan2D(np.zeros(2), np.array([0.0, -0.01]), np.pi / 2, 0.07, 0.1), end=np.array([0.19, 0.1, 0.5])
)


def test_goal_and_push_come_back() -> None:
    drawing = draw_goal("o1", OUTLINE, Target(GOAL), PLAN, 3)
    assert drawing.words == "goal: within 10 mm and 5.0°" and drawing.chance == "push 3: 82 % chance of the goal"
    found = goal_markers_from_msg(goal_markers_to_msg(drawing, Time(sec=3)))
    assert isinstance(found, GoalDrawing) and (found.object_id, found.words, found.chance) == ("o1", drawing.words, drawing.chance)
    np.testing.assert_allclose(found.goal, drawing.goal)
    np.testing.assert_allclose(found.tool, [[0.0, -0.01], [0.0, 0.06]], atol=1e-12)
    np.testing.assert_allclose(found.end, drawing.goal - [0.01, 0.0])
    assert found.edge is None
    waiting = goal_markers_from_msg(goal_markers_to_msg(draw_goal("o1", OUTLINE, Target(GOAL), None, 3), Time()))
    assert waiting is not None and waiting.tool is None and waiting.end is None and waiting.chance == ""
    assert goal_markers_from_msg(goal_markers_to_msg(None, Time())) is None


def test_edge_of_a_goal_comes_back_with_what_is_risked() -> None:
    edge = TableEdge.between(np.array([0.25, -0.3]), np.array([0.25, 0.3]))
    target = Target(GOAL, EdgeHold(edge, 0.012), np.array([[0.01, 0.01], [0.09, 0.01]]), np.array([[0.05, 0.01]]))
    found = goal_markers_from_msg(goal_markers_to_msg(draw_goal("o1", OUTLINE, target, replace(PLAN, risk=0.004), 3), Time()))
    assert found is not None and found.edge is not None and "over the edge, held by" in found.words
    assert found.chance == "push 3: 82 % chance of the goal, 0.4 % of being held by less than 12 mm"
    np.testing.assert_allclose(found.edge, [[0.25, -0.3], [0.25, 0.3]])


def test_markers_of_another_frame_place_object_or_size_are_refused() -> None:
    for change, words in (
        (lambda marker: setattr(marker.header, "frame_id", "map"), "frame map, expected table"),
        (lambda marker: setattr(marker.points[0], "x", float("nan")), "Goal marker"),
        (lambda marker: setattr(marker, "ns", "goal/1 2"), "1 2"),
    ):
        msg = goal_markers_to_msg(draw_goal("o1", OUTLINE, Target(GOAL), PLAN, 1), Time())
        change(msg.markers[1])
        with pytest.raises(InputError, match=words):
            goal_markers_from_msg(msg)
    many = Marker(action=Marker.ADD, type=Marker.LINE_STRIP, points=[Point()] * 10_001)
    with pytest.raises(InputError, match="Goal markers"):
        goal_markers_from_msg(MarkerArray(markers=[many]))
