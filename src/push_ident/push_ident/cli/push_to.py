"""`push-ident push-to`: push an object of a live cell to a goal pose, or from one to the next along a path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from push_ident.cli.checks import above_zero, finite
from push_ident.cli.output import JsonOption, OutOption, console, warn, write_json
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
    "last_feedback",
    "push_to_command",
    "push_to_goal",
]

_TO_WRITE = 15.0
"""From Ctrl-C to the end by force [s]: for the arm to be held, 1 s, and for results and page, 1 s on an idle machine."""
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
    """What came of a goal, so far: it can be written at any time, also where something broke it off.

    Attributes:
        goal: as it was sent.
        result: of the action; until it ends, that of a goal that is broken off now.
        lines: one for each push.
        start: pose before them, table frame, shape (3,) [m, m, rad]; NaN where none was seen.
        outline: of the object, object frame, shape (n_vertices, 2) [m]; None where it was not received.
    """

    def __init__(self, goal: PushToGoal.Goal) -> None:
        self.goal, self.result = goal, _broken_off()
        self.lines: list[PushLine] = []
        self.start = np.full(3, np.nan)
        self.outline: Float64Array | None = None

    def take(self, feedback: PushToGoal.Feedback) -> None:
        """Note and print a push that is new in a feedback."""
        if feedback.pushes > (self.lines[-1].number if self.lines else 0):
            self.lines.append(PushLine(feedback))
            console.print(str(self.lines[-1]), highlight=False, soft_wrap=True)

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
            "object_id": printable(self.goal.object_id),
            "goal": _planar(self.goal.goal.pose).tolist(),
            "tolerance_m": float(self.goal.position_tolerance),
            "tolerance_rad": float(self.goal.yaw_tolerance),
            "start": self.start.tolist() if np.isfinite(self.start).all() else None,
            "outline": None if self.outline is None else self.outline.tolist(),
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


def push_to_goal(client: CellClient, report: GoalReport, show: Callable[[str], None]) -> None:
    """Push an object to the goal of a report, with one line a push; `show` gets what is under way.

    The report is kept up to date. Raises CellTimeout where no node answers.
    """
    goal = report.goal
    latest: PushToGoal.Feedback | None = None

    def progress(feedback: PushToGoal.Feedback) -> None:
        nonlocal latest
        latest = feedback
        if np.isnan(report.start[0]) and np.isfinite(feedback.pose.position.x):
            report.start = _planar(feedback.pose)
        report.take(feedback)
        report.result = _broken_off(feedback)
        state = _STATES[feedback.state] if feedback.state < len(_STATES) else "at work"
        show(f"push {feedback.pushes + 1}: {state}")

    try:
        report.result = client.push_to_goal(goal, on_feedback=progress)
    finally:
        found = (goal.object_id,) if goal.object_id else client.object_ids()
        if len(found) == 1 and client.is_known(found[0]):
            goal.object_id, report.outline = found[0], client.shape(found[0]).outline
    if latest is not None and (poses := client.poses(goal.object_id)):
        report.take(last_feedback(report.result, latest, poses[-1][1]))


def last_feedback(result: PushToGoal.Result, latest: PushToGoal.Feedback, pose: Float64Array) -> PushToGoal.Feedback:
    """The feedback that belongs to a result: ROS drops feedback that arrives after the result, as that of the last push may do.

    Args:
        result: of the goal.
        latest: feedback that was received last; its prediction is that of the push made last, or then under way.
        pose: of the object as it was seen last, shape (3,), table frame [m, m, rad].
    """
    from push_ident_msgs.action import PushToGoal

    is_seen = bool(np.isfinite(result.position_error))
    last = PushToGoal.Feedback(
        pushes=result.pushes if is_seen else latest.pushes, position_error=result.position_error, yaw_error=result.yaw_error
    )
    last.is_predicted, last.expected_chance, last.expected_pose = latest.is_predicted, latest.expected_chance, latest.expected_pose
    last.pose = _pose_msg(pose)
    return last


def _broken_off(latest: PushToGoal.Feedback | None = None) -> PushToGoal.Result:
    """The result of a goal whose own result does not come any more, as of the latest feedback."""
    from push_ident_msgs.action import PushToGoal

    text = "broken off before it ended: the arm holds, and what was learned is kept. A push under way then is not listed."
    result = PushToGoal.Result(error_code=PushToGoal.Result.CANCELED, error_text=text, position_error=float("nan"), yaw_error=float("nan"))
    if latest is not None:
        result.position_error, result.yaw_error = latest.position_error, latest.yaw_error
        result.pushes, result.elapsed = latest.pushes, latest.elapsed
    return result


def goal_message(
    pose: Float64Array, *, object_id: str = "", tolerance_mm: float = 20.0, tolerance_deg: float = 5.73, **limits: Any
) -> PushToGoal.Goal:
    """The goal of the action; `limits` are further fields of it."""
    from push_ident_msgs.action import PushToGoal

    goal = PushToGoal.Goal(
        object_id=object_id, position_tolerance=1e-3 * tolerance_mm, yaw_tolerance=float(np.radians(tolerance_deg)), **limits
    )
    goal.goal.header.frame_id = "table"
    goal.goal.pose = _pose_msg(pose)
    return goal


def _pose_msg(pose: Float64Array) -> Pose:
    from geometry_msgs.msg import Pose

    msg = Pose()
    msg.position.x, msg.position.y = float(pose[0]), float(pose[1])
    turn = msg.orientation
    turn.x, turn.y, turn.z, turn.w = (float(value) for value in quaternion_of_yaw(pose[2]))
    return msg


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
    out: OutOption = None,
    json: JsonOption = None,
) -> None:
    """Push an object of a live cell to a goal pose, or along a path; exit status 0 only where it was reached.

    Ctrl-C holds the arm; results are written all the same.
    """
    poses = goals_of(x, y, yaw, path, spacing_mm)
    need_ros()
    goals = [
        goal_message(
            pose,
            object_id=object_id,
            tolerance_mm=tolerance_mm,
            tolerance_deg=tolerance_deg,
            explore=0 if number else explore,
            max_pushes=max_pushes,
            time_limit=time_limit,
        )
        for number, pose in enumerate(poses)
    ]
    reports: list[GoalReport] = []
    try:
        _pursue(goals, reports)
    finally:
        # Also after Ctrl-C, and where the cell does not answer any more.
        if reports and not np.isnan(reports[0].start[0]):
            whole = reports[0] if path is None else PathReport(reports, len(poses))
            _write(whole.content(), out, json)
    if path is None:
        finish(reports[0])
    else:
        _finish_path(PathReport(reports, len(poses)))


def _pursue(goals: Sequence[PushToGoal.Goal], reports: list[GoalReport]) -> None:
    """Push to one goal after another, until one is not reached; `reports` gets a report for each that was begun."""
    from push_ident.nodes.client import CellClient
    from push_ident.nodes.lifetime import LIFETIME

    LIFETIME.patience = _TO_WRITE
    with CellClient() as client, console.status("looking for the cell") as status:
        for number, goal in enumerate(goals, 1):
            prefix = f"goal {number} of {len(goals)}: " if len(goals) > 1 else ""
            reports.append(GoalReport(goal))
            push_to_goal(client, reports[-1], partial(_show, status, prefix))
            if not reports[-1].is_reached:
                break


def _write(content: dict[str, Any], out: Path | None, json: Path | None) -> None:
    """Write the result as JSON, and as a page into the folder `out`."""
    for file in [json, None if out is None else out / "result.json"]:
        if file is not None:
            write_json(file, content)
    if out is not None:
        from push_ident.planning.goal_page import write_goal_page

        page = out / "report.html"
        write_goal_page(page, content)
        console.print(f"written: {page}, {out / 'result.json'}", highlight=False, soft_wrap=True)


def _show(status: Status, prefix: str, text: str) -> None:
    status.update(escape(prefix + text))


def _finish_path(report: PathReport) -> None:
    """Say how a path ended. Raises typer.Exit with status 1 where a goal was not reached."""
    content = report.content()
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


def finish(report: GoalReport) -> None:
    """Say how it ended. Raises typer.Exit with status 1 where the goal was not reached."""
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
