"""Markers for RViz, Foxglove and the viewer: what perception refused, and the goal or path that is pursued with the push under way."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from push_ident.errors import InputError
from push_ident.geometry.frames import TABLE_FRAME
from push_ident.limits import LIMITS, check_coordinates, check_object_id, plain_text
from push_ident.perception.refusals import Refusal
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class MarkerSettings:
    """Sizes of what is drawn [m]."""

    goal_line: float = 0.003
    """Width of outlines and paths of a goal."""
    refusal_line: float = 0.002
    """Width of outlines of what perception refuses."""
    letter: float = 0.015
    """Height of text."""
    cell: float = 0.004
    """Thickness of the cells of an object above the table."""
    n_path_points: int = 500
    """Of a path at most: 1 mm apart on one of half a metre."""


MARKERS: Final = MarkerSettings()
_GOAL: Final = ColorRGBA(r=0.94, g=0.89, b=0.26, a=1.0)
_PUSH: Final = ColorRGBA(r=0.80, g=0.47, b=0.65, a=1.0)
_EDGE: Final = ColorRGBA(r=0.84, g=0.37, b=0.0, a=1.0)
"""Of refusals, too."""
_CORRIDOR: Final = ColorRGBA(r=0.55, g=0.55, b=0.55, a=1.0)
_WITH_POINTS: Final = ("goal", "push", "expected", "edge", "path", "corridor")
"""Markers whose points are drawn."""


def _marker(stamp: Time, name: str, kind: int, colour: ColorRGBA, number: int = 0) -> Marker:
    """A marker in the frame `table`, to be added; `kind` is a type of visualization_msgs/Marker."""
    msg = Marker(ns=name, id=number, type=kind, action=Marker.ADD, color=colour, header=Header(stamp=stamp, frame_id=TABLE_FRAME))
    msg.pose.orientation.w = 1.0
    return msg


def _added(msg: MarkerArray, what: str) -> Iterator[Marker]:
    """The markers that are added; raises InputError for too many, and for another frame."""
    LIMITS.POINTS.check(sum(len(item.points) for item in msg.markers) + len(msg.markers), f"Markers of {what}")
    for item in msg.markers:
        if item.action != Marker.ADD:
            continue
        if item.header.frame_id != TABLE_FRAME:
            raise InputError(f"A marker of {what} is in frame {plain_text(item.header.frame_id)}, expected {TABLE_FRAME}.")
        yield item


# ---- refusals


def refusals_to_msg(refusals: Iterable[Refusal], stamp: Time) -> MarkerArray:
    """Outline and reason of each; they replace the earlier ones."""
    markers = [_marker(stamp, "refused", Marker.LINE_STRIP, _EDGE)]
    markers[0].action = Marker.DELETEALL
    for number, refusal in enumerate(refusals):
        line = _marker(stamp, "refused", Marker.LINE_STRIP, _EDGE, number)
        line.scale.x = MARKERS.refusal_line
        line.points = [Point(x=float(x), y=float(y), z=float(refusal.height)) for x, y in [*refusal.outline, refusal.outline[0]]]
        text = _marker(stamp, "refused_because", Marker.TEXT_VIEW_FACING, _EDGE, number)
        text.scale.z, text.text = MARKERS.letter, refusal.why
        text.pose.position.x, text.pose.position.y = (float(value) for value in refusal.outline.mean(axis=0))
        text.pose.position.z = float(refusal.height + MARKERS.letter)
        markers += [line, text]
    return MarkerArray(markers=markers)


def refusals_from_msg(msg: MarkerArray) -> list[tuple[Float64Array, str]]:
    """Outline [m], shape (n, 3), table frame, and reason of each.

    Raises InputError: another frame, too many, or coordinates that are not on a table.
    """
    lines: dict[int, Float64Array] = {}
    words: dict[int, str] = {}
    for item in _added(msg, "a refusal"):
        if item.type == Marker.LINE_STRIP and len(item.points) > 1:
            lines[item.id] = np.array([(point.x, point.y, point.z) for point in item.points])
            check_coordinates(lines[item.id], "Outline of a refusal")
        elif item.type == Marker.TEXT_VIEW_FACING:
            words[item.id] = plain_text(item.text)
    return [(line, words.get(number, "")) for number, line in lines.items()]


# ---- goals


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

    Raises InputError: another frame, too many points, coordinates that are not on a table, or no object id.
    """
    points: dict[str, Float64Array] = {}
    words: dict[str, str] = {}
    object_id = ""
    for item in _added(msg, "the goal"):
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
    line = _marker(stamp, name, Marker.LINE_STRIP, colour)
    line.scale.x = width
    line.points = [Point(x=float(x), y=float(y)) for x, y in points]
    return line


def _outline(stamp: Time, name: str, colour: ColorRGBA, corners: Float64Array) -> Marker:
    return _line(stamp, name, colour, np.vstack([corners, corners[:1]]))


def _text(stamp: Time, name: str, colour: ColorRGBA, corners: Float64Array, text: str) -> Marker:
    """Beside the upper edge of an outline."""
    label = _marker(stamp, name, Marker.TEXT_VIEW_FACING, colour)
    label.text, label.scale.z = text, MARKERS.letter
    label.pose.position.x, label.pose.position.y = float(corners[:, 0].max()) + MARKERS.letter, float(corners[:, 1].mean())
    return label
