"""The goal or path that is pursued and the push under way, as markers for RViz, Foxglove and the viewer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points
from push_ident.limits import LIMITS, check_coordinates, check_object_id, plain_text
from push_ident.nodes.convert.marker import MARKERS, marker
from push_ident.nodes.convert.messages import TABLE_FRAME
from push_ident.planning.goal import Target
from push_ident.planning.goal_ports import GoalProgress, GoalState
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_steps import PathStep
from push_ident.planning.planner import GoalPush
from push_ident.pushing.push import PushPlan2D
from push_ident.types import Float64Array

__all__ = ["GoalDrawing", "draw_goal", "goal_markers_from_msg", "goal_markers_to_msg"]

_GOAL: Final = ColorRGBA(r=0.94, g=0.89, b=0.26, a=1.0)
_PUSH: Final = ColorRGBA(r=0.80, g=0.47, b=0.65, a=1.0)
_EDGE: Final = ColorRGBA(r=0.84, g=0.37, b=0.0, a=1.0)
_CORRIDOR: Final = ColorRGBA(r=0.55, g=0.55, b=0.55, a=1.0)
_WITH_POINTS: Final = ("goal", "push", "expected", "edge", "path", "corridor")
"""Markers whose points are drawn."""


@dataclass(frozen=True, slots=True)
class GoalDrawing:
    """What is shown of a goal; lengths in metres, table frame."""

    object_id: str
    goal: Float64Array
    """Outline of the object at the goal, of a path at its end, shape (n_vertices, 2)."""
    words: str
    """Of the goal: its tolerances, and how far the object overhangs an edge there."""
    tool: Float64Array | None = None
    """Places of the pusher's axis in the push under way, shape (n, 2): two of a straight one, all of what is planned of one whose tool is
    steered; None where none is, or it explores."""
    end: Float64Array | None = None
    """Outline of the object where that push is expected to leave it, shape (n_vertices, 2)."""
    chance: str = ""
    """Of being at the goal after it, in words; along a path how much of that it is expected to leave behind."""
    edge: Float64Array | None = None
    """First and last point of the edge that the object overhangs at the goal, shape (2, 2); None away from edges."""
    path: Float64Array | None = None
    """Of the object's origin, shape (n, 2); None where the goal is none."""
    corridor: Float64Array | None = None
    """Border of the strip that a steered tool does not leave, shape (n, 2); None for other pushes."""


def draw_goal(progress: GoalProgress, outline: Float64Array) -> GoalDrawing | None:
    """What is shown of a goal; None before it is known where the object shall be.

    Args:
        progress: towards the goal.
        outline: of the object in its frame [m], shape (n_vertices, 2).
    """
    target, path = progress.target, progress.path
    if target is None:
        return None
    at_goal, number = transform_points(target.goal.pose, outline), progress.pushes + 1
    is_pushing = progress.state is GoalState.PUSH
    if path is not None:
        drawing = GoalDrawing(progress.object_id, at_goal, _path_text(path), path=path.at(_path_samples(path))[:, :2])
        step = progress.step
        return drawing if step is None or not is_pushing else _with_step(drawing, outline, path, step, progress.tool, number)
    edge = None if target.hold is None else target.hold.edge.ends
    drawing = GoalDrawing(progress.object_id, at_goal, _goal_text(target, at_goal), edge=edge)
    plan = progress.plan
    return drawing if plan is None or not is_pushing else _with_push(drawing, outline, target, plan, number)


def _goal_text(target: Target, at_goal: Float64Array) -> str:
    goal = target.goal
    words = f"goal: within {1e3 * goal.position:.0f} mm and {np.degrees(goal.yaw):.1f}°"
    if target.hold is None:
        return words
    return f"{words}, {1e3 * target.overhang(at_goal):.0f} mm over the edge, held by {1e3 * target.margin(goal.pose):.0f} mm"


def _path_text(path: PathGoal) -> str:
    tolerance = f"one tolerance is {1e3 * path.position:.0f} mm and {np.degrees(path.yaw):.1f}°"
    return f"path: {1e3 * path.length:.0f} mm at {1e3 * path.speed:.0f} mm/s, {tolerance}"


def _path_samples(path: PathGoal) -> Float64Array:
    return np.linspace(0.0, path.length, min(len(path.poses), MARKERS.n_path_points))


def _with_push(drawing: GoalDrawing, outline: Float64Array, target: Target, plan: GoalPush, number: int) -> GoalDrawing:
    """Also push `number` to a pose, counted from 1."""
    if plan.plan is None:
        return drawing
    chance = f"push {number}: {100 * plan.chance:.0f} % chance of the goal"
    if target.hold is not None:
        chance += f", {100 * plan.risk:.1f} % of being held by less than {1e3 * target.hold.margin:.0f} mm"
    return replace(drawing, tool=_straight(plan.plan), end=transform_points(plan.end, outline), chance=chance)


def _with_step(
    drawing: GoalDrawing, outline: Float64Array, path: PathGoal, step: PathStep, corrected: Float64Array | None, number: int
) -> GoalDrawing:
    """Also push `number` along a path, with the tool as it was corrected last."""
    if step.contact is None:
        return drawing
    end = transform_points(path.at(step.expected_done), outline)
    chance = f"push {number}: expected to {100 * step.expected_done / path.length:.0f} % of the path"
    steered = step.steered
    if steered is None or steered.tool is None or steered.corridor is None:
        return replace(drawing, tool=_straight(step.contact), end=end, chance=chance)
    tool = steered.tool if corrected is None else corrected
    return replace(drawing, tool=tool, end=end, chance=chance, corridor=steered.corridor.outline())


def _straight(push: PushPlan2D) -> Float64Array:
    return np.array([push.tool_at_contact, push.tool_end])


def goal_markers_to_msg(drawing: GoalDrawing | None, stamp: Time) -> MarkerArray:
    """Markers that replace the earlier ones; None: no goal is pursued."""
    cleared = Marker(action=Marker.DELETEALL, header=Header(stamp=stamp, frame_id=TABLE_FRAME))
    if drawing is None:
        return MarkerArray(markers=[cleared])
    suffix = f"/{drawing.object_id}"
    markers = [
        cleared,
        _outline(stamp, "goal" + suffix, _GOAL, drawing.goal),
        _text(stamp, "goal_words" + suffix, _GOAL, drawing.goal, drawing.words),
    ]
    if drawing.tool is not None and drawing.end is not None:
        tool = _line(stamp, "push" + suffix, _PUSH, drawing.tool)
        if len(drawing.tool) == 2:
            tool.type, tool.scale.y = Marker.ARROW, 4 * MARKERS.goal_line
        markers += [
            tool,
            _outline(stamp, "expected" + suffix, _PUSH, drawing.end),
            _text(stamp, "chance" + suffix, _PUSH, drawing.end, drawing.chance),
        ]
    if drawing.edge is not None:
        markers.append(_line(stamp, "edge" + suffix, _EDGE, drawing.edge, 2 * MARKERS.goal_line))
    if drawing.path is not None:
        markers.append(_line(stamp, "path" + suffix, _GOAL, drawing.path))
    if drawing.corridor is not None:
        markers.append(_outline(stamp, "corridor" + suffix, _CORRIDOR, drawing.corridor))
    return MarkerArray(markers=markers)


def goal_markers_from_msg(msg: MarkerArray) -> GoalDrawing | None:
    """What is shown of a goal; None where no goal is pursued.

    Raises:
        InputError: another frame, too many points, coordinates that are not on a table, or no object id.
    """
    LIMITS.POINTS.check(sum(len(item.points) for item in msg.markers) + len(msg.markers), "Goal markers")
    points: dict[str, Float64Array] = {}
    words: dict[str, str] = {}
    object_id = ""
    for item in msg.markers:
        if item.action != Marker.ADD:
            continue
        if item.header.frame_id != TABLE_FRAME:
            raise InputError(f"A marker of the goal is in frame {plain_text(item.header.frame_id)}, expected {TABLE_FRAME}.")
        kind, _, name = item.ns.partition("/")
        object_id = check_object_id(name)
        points[kind] = np.array([(point.x, point.y) for point in item.points]).reshape(-1, 2)
        words[kind] = plain_text(item.text)
        if kind in _WITH_POINTS:
            check_coordinates(points[kind], "Goal marker")
    if len(points.get("goal", ())) < 3:
        return None
    shown = len(points.get("push", ())) >= 2 and len(points.get("expected", ())) >= 3
    return GoalDrawing(
        object_id,
        points["goal"][:-1],
        words.get("goal_words", ""),
        points["push"] if shown else None,
        points["expected"][:-1] if shown else None,
        words.get("chance", "") if shown else "",
        points["edge"] if len(points.get("edge", ())) == 2 else None,
        points["path"] if len(points.get("path", ())) >= 2 else None,
        points["corridor"][:-1] if len(points.get("corridor", ())) >= 3 else None,
    )


def _line(stamp: Time, name: str, colour: ColorRGBA, points: Float64Array, width: float = MARKERS.goal_line) -> Marker:
    line = marker(stamp, name, Marker.LINE_STRIP, colour)
    line.scale.x = width
    line.points = [Point(x=float(x), y=float(y)) for x, y in points]
    return line


def _outline(stamp: Time, name: str, colour: ColorRGBA, corners: Float64Array) -> Marker:
    return _line(stamp, name, colour, np.vstack([corners, corners[:1]]))


def _text(stamp: Time, name: str, colour: ColorRGBA, corners: Float64Array, text: str) -> Marker:
    """Beside the upper edge of an outline."""
    label = marker(stamp, name, Marker.TEXT_VIEW_FACING, colour)
    label.text, label.scale.z = text, MARKERS.letter
    label.pose.position.x, label.pose.position.y = float(corners[:, 0].max()) + MARKERS.letter, float(corners[:, 1].mean())
    return label
