"""`push-ident push-to`: push an object of a live cell to a goal pose."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from push_ident.cli.output import JsonOption, console, warn, write_json
from push_ident.errors import InputError
from push_ident.geometry.se2 import quaternion_of_yaw, wrap_angle, yaw_of_quaternion
from push_ident.limits import printable
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from geometry_msgs.msg import Pose

    from push_ident.nodes.client import CellClient
    from push_ident_msgs.action import PushToGoal

__all__ = ["GoalReport", "GoalText", "PushLine", "finish", "goal_message", "push_to_command", "push_to_goal"]

_STATES = ("looking", "exploring push", "planning", "pushing", "learning")
"""What is under way, by the state in the feedback of action/PushToGoal."""


class PushLine:
    """One push on the way: predicted and observed.

    Attributes:
        number: from 1.
        seen: pose after it, table frame, shape (3,) [m, m, rad].
        expected: predicted pose, or None for an exploring push.
        chance: predicted probability of being at the goal after it [1].
        position_error: distance from the goal after it [m].
        yaw_error: angle to the goal after it [rad].
    """

    def __init__(self, feedback: PushToGoal.Feedback) -> None:
        self.number = int(feedback.pushes)
        self.seen = _planar(feedback.pose)
        self.expected: Float64Array | None = _planar(feedback.expected_pose) if feedback.is_predicted else None
        self.chance = float(feedback.expected_chance)
        self.position_error, self.yaw_error = float(feedback.position_error), float(feedback.yaw_error)

    def __str__(self) -> str:
        now = f"{1e3 * self.position_error:.1f} mm and {np.degrees(self.yaw_error):.1f}° from the goal"
        if self.expected is None:
            return f"push {self.number}: explores; {now}"
        off = self.seen - self.expected
        return (
            f"push {self.number}: {now}; predicted to {1e3 * float(np.hypot(off[0], off[1])):.1f} mm and "
            f"{np.degrees(abs(float(wrap_angle(off[2])))):.1f}°, {100 * self.chance:.0f} % chance of the goal"
        )

    def content(self) -> dict[str, Any]:
        """For JSON: lengths in metres, angles in radians."""
        return {
            "number": self.number,
            "seen": self.seen.tolist(),
            "expected": None if self.expected is None else self.expected.tolist(),
            "chance": None if self.expected is None else self.chance,
            "position_error_m": self.position_error,
            "yaw_error_rad": self.yaw_error,
        }


class GoalReport:
    """What came of a goal: its result, a line for each push, and the pose before them, `start`, shape (3,); NaN where none was seen."""

    def __init__(self, result: PushToGoal.Result, lines: list[PushLine], start: Float64Array) -> None:
        self.result, self.lines, self.start = result, lines, start

    @property
    def is_reached(self) -> bool:
        """Whether the object is at the goal."""
        return int(self.result.error_code) == 0

    def content(self) -> dict[str, Any]:
        """For JSON."""
        result = self.result
        names = {value: name for name, value in _codes().items()}
        return {
            "reached": self.is_reached,
            "code": names.get(int(result.error_code), str(result.error_code)),
            "text": printable(result.error_text),
            "position_error_m": float(result.position_error),
            "yaw_error_rad": float(result.yaw_error),
            "chance": float(result.chance),
            "n_pushes": int(result.pushes),
            "time_s": float(result.elapsed),
            "pushes": [line.content() for line in self.lines],
        }


def _codes() -> dict[str, int]:
    from push_ident.planning.goal_ports import GoalCode

    return {code.name: code.value for code in GoalCode}


class GoalText:
    """`X,Y,YAW` of the command line. Raises InputError where it is not three finite numbers."""

    def __init__(self, text: str) -> None:
        try:
            self.pose = np.array([float(part) for part in text.split(",")])
        except ValueError:
            self.pose = np.empty(0)
        if self.pose.shape != (3,) or not np.isfinite(self.pose).all():
            raise InputError(f"--goal is {text!r}, expected X,Y,YAW in metres and radians, such as 0.05,-0.1,1.57.")


def push_to_goal(client: CellClient, goal: PushToGoal.Goal, show: Callable[[str], None]) -> GoalReport:
    """Push an object to a goal, with one line a push; `show` gets what is under way. Raises CellTimeout where no node answers."""
    lines: list[PushLine] = []
    start = np.full(3, np.nan)

    def progress(feedback: PushToGoal.Feedback) -> None:
        if np.isnan(start[0]) and np.isfinite(feedback.pose.position.x):
            start[:] = _planar(feedback.pose)
        if feedback.pushes > (lines[-1].number if lines else 0):
            lines.append(PushLine(feedback))
            console.print(str(lines[-1]), highlight=False, soft_wrap=True)
        state = _STATES[feedback.state] if feedback.state < len(_STATES) else "at work"
        show(f"push {feedback.pushes + 1}: {state}")

    return GoalReport(client.push_to_goal(goal, on_feedback=progress), lines, start)


def goal_message(
    pose: Float64Array, *, object_id: str = "", tolerance_mm: float = 20.0, tolerance_deg: float = 5.73, **limits: Any
) -> PushToGoal.Goal:
    """The goal of the action; `limits` are further fields of it."""
    from push_ident_msgs.action import PushToGoal

    goal = PushToGoal.Goal(
        object_id=object_id, position_tolerance=1e-3 * tolerance_mm, yaw_tolerance=float(np.radians(tolerance_deg)), **limits
    )
    goal.goal.header.frame_id = "table"
    goal.goal.pose.position.x, goal.goal.pose.position.y = float(pose[0]), float(pose[1])
    turn = goal.goal.pose.orientation
    turn.x, turn.y, turn.z, turn.w = (float(value) for value in quaternion_of_yaw(pose[2]))
    return goal


def push_to_command(
    x: Annotated[float, typer.Option(help="Goal of the object's origin in the table frame [m].", show_default=False)],
    y: Annotated[float, typer.Option(help="Goal of the object's origin in the table frame [m].", show_default=False)],
    yaw: Annotated[float, typer.Option(help="Goal of the object's turn in the table frame [rad].", show_default=False)],
    tolerance_mm: Annotated[float, typer.Option("--tolerance-mm", min=0.1, help="Largest distance from the goal [mm].")] = 20.0,
    tolerance_deg: Annotated[float, typer.Option("--tolerance-deg", min=0.1, help="Largest angle to the goal [degrees].")] = 5.73,
    explore: Annotated[int, typer.Option(min=0, help="Random pushes first; 0: use what is known of the object.")] = 0,
    max_pushes: Annotated[int, typer.Option("--max-pushes", min=1, help="Most pushes, exploring ones included.")] = 15,
    time_limit: Annotated[float, typer.Option("--time-limit", min=1.0, help="Longest time [s].")] = 300.0,
    object_id: Annotated[str, typer.Option("--object", metavar="ID", help="The object. Default: the only one.", show_default=False)] = "",
    json: JsonOption = None,
) -> None:
    """Push an object of a live cell to a goal pose; exit status 0 only where it was reached. Ctrl-C holds the arm."""
    if not np.isfinite([x, y, yaw]).all():
        raise InputError(f"the goal is ({x}, {y}, {yaw}), expected finite numbers in metres and radians")
    from push_ident.nodes.client import CellClient

    with CellClient() as client, console.status("looking for the cell") as status:
        goal = goal_message(
            np.array([x, y, yaw]),
            object_id=object_id,
            tolerance_mm=tolerance_mm,
            tolerance_deg=tolerance_deg,
            explore=explore,
            max_pushes=max_pushes,
            time_limit=time_limit,
        )
        report = push_to_goal(client, goal, lambda text: status.update(escape(text)))
    finish(report, json)


def finish(report: GoalReport, json: Path | None) -> None:
    """Say how it ended. Raises typer.Exit with status 1 where the goal was not reached."""
    if json is not None:
        write_json(json, report.content())
    result = report.result
    where = f"{1e3 * result.position_error:.1f} mm and {np.degrees(result.yaw_error):.1f}° from it"
    if not report.is_reached:
        warn(f"push-ident: {report.content()['code']}: {printable(result.error_text)}")
        raise typer.Exit(1)
    console.print(f"at the goal after {result.pushes} pushes and {result.elapsed:.0f} s: {where}", highlight=False)


def _planar(pose: Pose) -> Float64Array:
    turn = pose.orientation
    yaw = float(yaw_of_quaternion([turn.x, turn.y, turn.z, turn.w]))
    return np.array([pose.position.x, pose.position.y, yaw])
