"""The way to a goal on one page: each push as it was predicted and as it was seen, and why it ended."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from push_ident import __version__
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.pages.chart import Mark, Row, Series, row_chart
from push_ident.pages.outline_chart import Placed, outline_panel
from push_ident.pages.page import FigureSection, write_page
from push_ident.types import Float64Array

_ENDED = {
    "SUCCESS": "at the goal",
    "CANCELED": "canceled",
    "PREEMPTED": "given up for a newer goal",
    "TIME_LIMIT": "out of time",
    "MAX_PUSHES": "out of pushes",
    "NOT_HELD": "it might fall",
    "FELL": "it fell",
}
"""How it ended, for the title, by the code of the result; of any other: not reached."""


def write_goal_page(path: Path, content: Mapping[str, Any], sections: Sequence[FigureSection] = ()) -> None:
    """Write the page of what `push-ident push-to --json` writes, of one goal or of goals in a row along a path; also of one that was broken
    off. `sections`: further figures. Raises InputError where the file cannot be written."""
    goals: Sequence[Mapping[str, Any]] = content.get("goals", [content])
    n_goals = int(content.get("n_goals", 1))
    last = goals[-1]
    context = {
        "title": f"Push {last['object_id'] or 'an object'} {_where(last, n_goals)}: {_ended(last)}",
        "headline": _headline(content, goals, n_goals),
        "reached": content["reached"],
        "code": last["code"],
        "text": last["text"],
        "goals": [_goal(goal, number if n_goals > 1 else 0) for number, goal in enumerate(goals, 1)],
        "sections": sections,
        "version": f"push_ident {__version__}, Python {platform.python_version()}",
    }
    write_page(path, __package__, "goal.html.j2", context)


def _where(goal: Mapping[str, Any], n_goals: int) -> str:
    if goal.get("kind") == "edge":
        return "out over the edge"
    if goal.get("kind") == "path":
        return "along a path"
    return "to a goal" if n_goals == 1 else f"to {n_goals} goals"


def _ended(goal: Mapping[str, Any]) -> str:
    return _ENDED.get(goal["code"], "not reached")


def _headline(content: Mapping[str, Any], goals: Sequence[Mapping[str, Any]], n_goals: int) -> str:
    n_pushes, seconds = content["n_pushes"], sum(goal["time_s"] for goal in goals)
    made = f"{n_pushes} {'push' if n_pushes == 1 else 'pushes'} in {seconds:.0f} s"
    if n_goals > 1:
        return f"{content['n_reached']} of {n_goals} goals along the path were reached with {made}."
    if content.get("kind") == "edge" and content["goal"] is None:
        return f"{made}; no pre-grasp pose was chosen."
    if _unknown(content["position_error_m"]):
        return f"{made}; the object was not observed."
    if content.get("kind") == "edge":
        over, inside = (_length(content[key]) for key in ("overhang_m", "margin_m"))
        apart = _apart(content["position_error_m"], content["yaw_error_rad"])
        return (
            f"After {made} the object overhangs the edge by {over}, its centre of mass {inside} inside what supports it. It is {apart} "
            "from the pre-grasp pose."
        )
    return f"After {made} the object is {_apart(content['position_error_m'], content['yaw_error_rad'])} from the goal."


def _goal(goal: Mapping[str, Any], number: int) -> dict[str, Any]:
    """One goal; `number` is from 1 along a path, 0 where there is only one."""
    tolerance = _apart(goal["tolerance_m"], goal["tolerance_rad"], digits=0)
    is_at_edge = goal.get("kind") == "edge"
    return {
        "name": f"Goal {number}" if number else "Goal",
        "effects": _effects(goal),
        "words": f"{_wanted(goal) if is_at_edge else _target(goal)}; there within {tolerance}",
        "at_edge": is_at_edge,
        "ended": f"{_ended(goal)}{'' if goal['code'] == 'SUCCESS' else ' (' + goal['code'] + ')'}",
        "rows": _rows(goal),
        "panels": _panels(goal),
        "errors": _errors(goal) if goal["pushes"] else "",
    }


def _effects(goal: Mapping[str, Any]) -> str:
    """What else the pushes were planned with; empty where nothing was diagnosed, or at an edge, where effects are left out."""
    effects = goal.get("effects", "")
    if not effects:
        return ""
    words = "Planned with what was diagnosed"
    if goal.get("kind") == "edge":
        words = "Diagnosed, but left out where pushes at the edge are judged"
    return f"{words}: {effects}."


def _target(goal: Mapping[str, Any]) -> str:
    x, y, yaw = goal["goal"]
    return f"({1e3 * x:.0f}, {1e3 * y:.0f}) mm, turned by {np.degrees(yaw):.1f}°"


def _wanted(goal: Mapping[str, Any]) -> str:
    wanted = f"{_length(goal['wanted_overhang_m'])} over the edge, held by {_length(goal['wanted_margin_m'])}"
    return wanted + (": no pre-grasp pose was chosen" if goal["goal"] is None else f": pre-grasp pose {_target(goal)}")


def _rows(goal: Mapping[str, Any]) -> list[dict[str, str]]:
    return [
        {
            "number": str(push["number"]),
            "chance": ("explores" if push["seen"] else "–") if push["expected"] is None else f"{100 * push['chance']:.0f} %",
            "risk": "–" if push.get("risk") is None else f"{100 * push['risk']:.1f} %",
            "predicted": "–" if push["expected"] is None else _pose(push["expected"]),
            "seen": "not seen" if push["seen"] is None else _pose(push["seen"]),
            "missed": "–" if push["seen"] is None or push["expected"] is None else _apart(*_difference(push["seen"], push["expected"])),
            "left": _apart(push["position_error_m"], push["yaw_error_rad"]),
        }
        for push in goal["pushes"]
    ]


def _panels(goal: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Title and drawing of each push, all of one scale; none where the outline or the first pose was not received."""
    if goal["outline"] is None or goal["start"] is None:
        return []
    outline = np.array(goal["outline"])
    target = [] if goal["goal"] is None else [Placed(transform_points(np.array(goal["goal"]), outline), "goal", "goal")]
    poses = [goal["start"], *(pose for push in goal["pushes"] for pose in (push["seen"], push["expected"]) if pose is not None)]
    every = np.vstack([*(placed.corners for placed in target), *(transform_points(np.array(pose), outline) for pose in poses)])
    frame = np.array([every.min(axis=0), every.max(axis=0)])
    edge = _edge_within(goal.get("edge"), frame)
    found, before = [], goal["start"]
    for push in (push for push in goal["pushes"] if push["seen"] is not None):
        placed = [Placed(transform_points(np.array(before), outline), "before", "before the push"), *target, *edge]
        if push["expected"] is None:
            title = f"Push {push['number']} explores"
        else:
            title = f"Push {push['number']}: {100 * push['chance']:.0f} % chance of the goal"
            placed.append(Placed(transform_points(np.array(push["expected"]), outline), "predicted", "predicted"))
        placed.append(Placed(transform_points(np.array(push["seen"]), outline), "seen", "observed"))
        found.append((title, outline_panel(title, placed, frame)))
        before = push["seen"]
    return found


def _edge_within(edge: Sequence[Sequence[float]] | None, frame: Float64Array) -> list[Placed]:
    """The part of the edge within the frame of a drawing, least and largest corner, shape (2, 2) [m]; none where it is outside."""
    if edge is None:
        return []
    points = np.linspace(edge[0], edge[1], 2000)
    inside = points[np.all((points >= frame[0]) & (points <= frame[1]), axis=1)]
    return [Placed(inside[[0, -1]], "edge", "edge of the table")] if len(inside) else []


def _errors(goal: Mapping[str, Any]) -> str:
    """Distance from the goal after each push, beside the one that was predicted; none where no pre-grasp pose was chosen."""
    if goal["goal"] is None:
        return ""
    series = (Series("observed", "dot", "var(--accent, #1f5fa8)"), Series("predicted before the push", "ring", "var(--warm, #b54a12)"))
    rows = []
    for push in goal["pushes"]:
        seen = 1e3 * float("nan" if push["position_error_m"] is None else push["position_error_m"])
        marks = [Mark(0, seen, f"push {push['number']}, observed: {seen:.1f} mm")]
        if push["expected"] is not None:
            expected = 1e3 * _difference(push["expected"], goal["goal"])[0]
            marks.append(Mark(1, expected, f"push {push['number']}, predicted: {expected:.1f} mm"))
        rows.append(Row(f"push {push['number']}", tuple(marks)))
    return row_chart("Distance from the goal", rows, series, "mm", axis="distance from the goal", limit=1e3 * goal["tolerance_m"])


def _difference(pose: Sequence[float], other: Sequence[float]) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses (x, y, yaw)."""
    apart: Float64Array = np.asarray(pose, dtype=np.float64) - np.asarray(other, dtype=np.float64)
    return float(np.hypot(apart[0], apart[1])), abs(float(wrap_angle(apart[2])))


def _pose(pose: Sequence[float]) -> str:
    return f"({1e3 * pose[0]:.0f}, {1e3 * pose[1]:.0f}) mm, {np.degrees(pose[2]):.1f}°"


def _apart(metres: float | None, radians: float | None, digits: int = 1) -> str:
    if metres is None or radians is None or _unknown(metres):
        return "not seen"
    return f"{1e3 * metres:.{digits}f} mm and {np.degrees(radians):.1f}°"


def _length(metres: float | None) -> str:
    return "an unknown distance" if metres is None or _unknown(metres) else f"{1e3 * metres:.0f} mm"


def _unknown(value: float | None) -> bool:
    return value is None or not np.isfinite(value)
