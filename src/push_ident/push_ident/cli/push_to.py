"""`push-ident push-to`: push an object of a live cell to a goal pose, or from one to the next along a path."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from push_ident.cli.checks import above_zero, finite
from push_ident.cli.output import JsonOption, console, warn, write_json
from push_ident.errors import InputError
from push_ident.extras import need_ros
from push_ident.geometry.se2 import quaternion_of_yaw, wrap_angle, yaw_of_quaternion
from push_ident.limits import printable
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from geometry_msgs.msg import Pose
    from rich.status import Status

    from push_ident.nodes.client import CellClient
    from push_ident_msgs.action import PushToGoal

__all__ = [
    "GoalReport",
    "GoalText",
    "PathReport",
    "PushLine",
    "finish",
    "goal_message",
    "goals_of",
    "push_to_command",
    "push_to_goal",
]

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


class PathReport:
    """What came of goals in a row along a path: a report for each that was begun, of `n_goals`."""

    def __init__(self, reports: list[GoalReport], n_goals: int) -> None:
        self.reports, self.n_goals = reports, n_goals

    @property
    def is_reached(self) -> bool:
        """Whether the object was at each of them."""
        return len(self.reports) == self.n_goals and all(report.is_reached for report in self.reports)

    def content(self) -> dict[str, Any]:
        """For JSON: lengths in metres, angles in radians; root mean squares over the goals that were reached."""
        reached = [report.result for report in self.reports if report.is_reached]
        rms = np.sqrt(np.mean([(r.position_error**2, r.yaw_error**2) for r in reached], axis=0)) if reached else np.full(2, np.nan)
        return {
            "reached": self.is_reached,
            "n_goals": self.n_goals,
            "n_reached": len(reached),
            "n_pushes": sum(int(report.result.pushes) for report in self.reports),
            "rms_position_m": float(rms[0]) if reached else None,
            "rms_yaw_rad": float(rms[1]) if reached else None,
            "goals": [report.content() for report in self.reports],
        }


def goals_of(x: float | None, y: float | None, yaw: float | None, path: Path | None, spacing_mm: float) -> Float64Array:
    """Poses to push to, one after another, shape (n, 3), from the options of the command line.

    Raises:
        InputError: neither a whole pose nor a path, both, numbers that are not finite, or a file that holds no path.
    """
    pose = [value for value in (x, y, yaw) if value is not None]
    if path is not None:
        if pose:
            raise InputError("--path was given beside --x, --y or --yaw; give a path or one pose.")
        from push_ident.planning.path_goal import read_path

        return read_path(path).waypoints(1e-3 * spacing_mm)
    if len(pose) < 3:
        raise InputError("A goal is missing; give --x, --y and --yaw, or a file of poses with --path.")
    if not np.isfinite(pose).all():
        raise InputError(f"the goal is ({x}, {y}, {yaw}), expected finite numbers in metres and radians")
    return np.array([pose])


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
    x: Annotated[
        float | None, typer.Option(callback=finite, help="Goal of the object's origin in the table frame [m].", show_default=False)
    ] = None,
    y: Annotated[
        float | None, typer.Option(callback=finite, help="Goal of the object's origin in the table frame [m].", show_default=False)
    ] = None,
    yaw: Annotated[
        float | None, typer.Option(callback=finite, help="Goal of the object's turn in the table frame [rad].", show_default=False)
    ] = None,
    path: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Goals in a row along a path: a line for each pose, x, y, yaw [m, rad].", show_default=False),
    ] = None,
    spacing_mm: Annotated[
        float, typer.Option("--spacing-mm", min=1.0, callback=above_zero, help="Between the goals along a path [mm].")
    ] = 40.0,
    tolerance_mm: Annotated[
        float, typer.Option("--tolerance-mm", min=0.1, callback=above_zero, help="Largest distance from the goal [mm].")
    ] = 20.0,
    tolerance_deg: Annotated[
        float, typer.Option("--tolerance-deg", min=0.1, callback=above_zero, help="Largest angle to the goal [degrees].")
    ] = 5.73,
    explore: Annotated[int, typer.Option(min=0, help="Random pushes first; 0: use what is known of the object.")] = 0,
    max_pushes: Annotated[int, typer.Option("--max-pushes", min=1, help="Most pushes for a goal, exploring ones included.")] = 15,
    time_limit: Annotated[float, typer.Option("--time-limit", min=1.0, callback=above_zero, help="Longest time for a goal [s].")] = 300.0,
    object_id: Annotated[str, typer.Option("--object", metavar="ID", help="The object. Default: the only one.", show_default=False)] = "",
    json: JsonOption = None,
) -> None:
    """Push an object of a live cell to a goal pose, or along a path; exit status 0 only where it was reached. Ctrl-C holds the arm."""
    poses = goals_of(x, y, yaw, path, spacing_mm)
    need_ros()
    from push_ident.nodes.client import CellClient

    reports: list[GoalReport] = []
    with CellClient() as client, console.status("looking for the cell") as status:
        for number, pose in enumerate(poses):
            goal = goal_message(
                pose,
                object_id=object_id,
                tolerance_mm=tolerance_mm,
                tolerance_deg=tolerance_deg,
                explore=0 if number else explore,
                max_pushes=max_pushes,
                time_limit=time_limit,
            )
            prefix = f"goal {number + 1} of {len(poses)}: " if path is not None else ""
            reports.append(push_to_goal(client, goal, partial(_show, status, prefix)))
            if not reports[-1].is_reached:
                break
    if path is None:
        finish(reports[0], json)
    else:
        _finish_path(PathReport(reports, len(poses)), json)


def _show(status: Status, prefix: str, text: str) -> None:
    status.update(escape(prefix + text))


def _finish_path(report: PathReport, json: Path | None) -> None:
    """Say how a path ended. Raises typer.Exit with status 1 where a goal was not reached."""
    content = report.content()
    if json is not None:
        write_json(json, content)
    if not report.is_reached:
        last = report.reports[-1]
        number = len(report.reports)
        warn(f"push-ident: {last.content()['code']} at goal {number} of {report.n_goals}: {printable(last.result.error_text)}")
        raise typer.Exit(1)
    console.print(
        f"at the end of the path after {content['n_pushes']} pushes: {1e3 * content['rms_position_m']:.1f} mm and "
        f"{np.degrees(content['rms_yaw_rad']):.1f}° from its {report.n_goals} goals (root mean square)",
        highlight=False,
    )


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
