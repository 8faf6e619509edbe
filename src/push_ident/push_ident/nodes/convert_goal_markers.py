"""The goal that is pursued and the push under way, as markers for RViz, Foxglove and the viewer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points
from push_ident.limits import LIMITS, check_coordinates, check_object_id, plain_text
from push_ident.nodes.convert import TABLE_FRAME
from push_ident.planning.planner import GoalPush
from push_ident.planning.target import Target
from push_ident.types import Float64Array

__all__ = ["GoalDrawing", "draw_goal", "goal_markers_from_msg", "goal_markers_to_msg"]

_GOAL: Final = ColorRGBA(r=0.94, g=0.89, b=0.26, a=1.0)
_PUSH: Final = ColorRGBA(r=0.80, g=0.47, b=0.65, a=1.0)
_EDGE: Final = ColorRGBA(r=0.84, g=0.37, b=0.0, a=1.0)
_LINE: Final = 0.003
"""Width of an outline [m]."""
_LETTER: Final = 0.015
"""Height of the text [m]."""


@dataclass(frozen=True, slots=True)
class GoalDrawing:
    """What is shown of a goal; lengths in metres, table frame."""

    object_id: str
    goal: Float64Array
    """Outline of the object at the goal, shape (n_vertices, 2)."""
    words: str
    """Of the goal: its tolerances, and how far the object overhangs an edge there."""
    tool: Float64Array | None = None
    """First and last place of the pusher's axis in the push under way, shape (2, 2); None where none is, or it explores."""
    end: Float64Array | None = None
    """Outline of the object where that push is expected to leave it, shape (n_vertices, 2)."""
    chance: str = ""
    """Of being at the goal after it, in words."""
    edge: Float64Array | None = None
    """First and last point of the edge that the object overhangs at the goal, shape (2, 2); None away from edges."""


def draw_goal(object_id: str, outline: Float64Array, target: Target, plan: GoalPush | None, number: int) -> GoalDrawing:
    """What is shown of a goal.

    Args:
        object_id: of the object.
        outline: of the object in its frame [m], shape (n_vertices, 2).
        target: where it shall be.
        plan: of push `number`, which is under way; None: no push to the goal is.
        number: from 1.
    """
    goal = target.goal
    words = f"goal: within {1e3 * goal.position:.0f} mm and {np.degrees(goal.yaw):.1f}°"
    at_goal = transform_points(goal.pose, outline)
    hold, edge = target.hold, None
    if hold is not None:
        edge = hold.edge.ends
        words += f", {1e3 * target.overhang(at_goal):.0f} mm over the edge, held by {1e3 * target.margin(goal.pose):.0f} mm"
    if plan is None or plan.plan is None:
        return GoalDrawing(object_id, at_goal, words, edge=edge)
    tool = np.array([plan.plan.tool_at_contact, plan.plan.tool_end])
    chance = f"push {number}: {100 * plan.chance:.0f} % chance of the goal"
    if hold is not None:
        chance += f", {100 * plan.risk:.1f} % of being held by less than {1e3 * hold.margin:.0f} mm"
    return GoalDrawing(object_id, at_goal, words, tool, transform_points(plan.end, outline), chance, edge)


def goal_markers_to_msg(drawing: GoalDrawing | None, stamp: Time) -> MarkerArray:
    """Markers in place of those that were shown before; None: no goal is pursued."""
    gone = Marker(action=Marker.DELETEALL)
    gone.header.frame_id, gone.header.stamp = TABLE_FRAME, stamp
    if drawing is None:
        return MarkerArray(markers=[gone])
    own = f"/{drawing.object_id}"
    markers = [
        gone,
        _outline(stamp, "goal" + own, _GOAL, drawing.goal),
        _text(stamp, "goal_words" + own, _GOAL, drawing.goal, drawing.words),
    ]
    if drawing.tool is not None and drawing.end is not None:
        arrow = _marker(stamp, "push" + own, Marker.ARROW, _PUSH)
        arrow.points = [Point(x=float(x), y=float(y)) for x, y in drawing.tool]
        arrow.scale.x, arrow.scale.y = _LINE, 4 * _LINE
        markers += [
            arrow,
            _outline(stamp, "expected" + own, _PUSH, drawing.end),
            _text(stamp, "chance" + own, _PUSH, drawing.end, drawing.chance),
        ]
    if drawing.edge is not None:
        line = _marker(stamp, "edge" + own, Marker.LINE_STRIP, _EDGE)
        line.scale.x = 2 * _LINE
        line.points = [Point(x=float(x), y=float(y)) for x, y in drawing.edge]
        markers.append(line)
    return MarkerArray(markers=markers)


def goal_markers_from_msg(msg: MarkerArray) -> GoalDrawing | None:
    """What is shown of a goal; None where no goal is pursued.

    Raises:
        InputError: another frame, too many points, coordinates that are not on a table, or no object id.
    """
    LIMITS.POINTS.check(sum(len(marker.points) for marker in msg.markers) + len(msg.markers), "Goal markers")
    points: dict[str, Float64Array] = {}
    words: dict[str, str] = {}
    object_id = ""
    for marker in msg.markers:
        if marker.action != Marker.ADD:
            continue
        if marker.header.frame_id != TABLE_FRAME:
            raise InputError(f"A marker of the goal is in frame {plain_text(marker.header.frame_id)}, expected {TABLE_FRAME}.")
        kind, _, own = marker.ns.partition("/")
        object_id = check_object_id(own)
        points[kind] = np.array([(point.x, point.y) for point in marker.points]).reshape(-1, 2)
        words[kind] = plain_text(marker.text)
        if kind in ("goal", "push", "expected", "edge"):
            check_coordinates(points[kind], "Goal marker")
    if len(points.get("goal", ())) < 3:
        return None
    shown = len(points.get("push", ())) == 2 and len(points.get("expected", ())) >= 3
    return GoalDrawing(
        object_id,
        points["goal"][:-1],
        words.get("goal_words", ""),
        points["push"] if shown else None,
        points["expected"][:-1] if shown else None,
        words.get("chance", "") if shown else "",
        points["edge"] if len(points.get("edge", ())) == 2 else None,
    )


def _marker(stamp: Time, name: str, kind: int, colour: ColorRGBA) -> Marker:
    marker = Marker(ns=name, type=kind, action=Marker.ADD, color=colour)
    marker.header.frame_id, marker.header.stamp = TABLE_FRAME, stamp
    marker.pose.orientation.w = 1.0
    return marker


def _outline(stamp: Time, name: str, colour: ColorRGBA, corners: Float64Array) -> Marker:
    marker = _marker(stamp, name, Marker.LINE_STRIP, colour)
    marker.scale.x = _LINE
    marker.points = [Point(x=float(x), y=float(y)) for x, y in [*corners, corners[0]]]
    return marker


def _text(stamp: Time, name: str, colour: ColorRGBA, corners: Float64Array, text: str) -> Marker:
    """Beside the upper edge of an outline."""
    marker = _marker(stamp, name, Marker.TEXT_VIEW_FACING, colour)
    marker.text, marker.scale.z = text, _LETTER
    marker.pose.position.x, marker.pose.position.y = float(corners[:, 0].max()) + _LETTER, float(corners[:, 1].mean())
    return marker
