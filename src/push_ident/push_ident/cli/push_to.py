"""`push-ident push-to`: push an object of a live cell to a goal pose, from one to the next along a path, or out over an edge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer
from rich.markup import escape

from push_ident.cli.goal_messages import edge_message, goal_message, path_message, planar
from push_ident.cli.goal_report import GoalReport, PathReport, broken_off, last_feedback
from push_ident.cli.output import JsonOption, OutOption, console, warn, write_json
from push_ident.cli.push_to_options import (
    EdgeFlag,
    EdgeLineOption,
    EdgeOptions,
    ExploreOption,
    HeldOption,
    MaxPushesOption,
    ObjectOption,
    OverhangOption,
    PathOption,
    PlaceOption,
    SpacingOption,
    SpeedOption,
    TimeLimitOption,
    ToleranceAngleOption,
    ToleranceOption,
    YawOption,
)
from push_ident.errors import InputError
from push_ident.extras import need_ros
from push_ident.limits import printable
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from rich.status import Status

    from push_ident.nodes.client.cell_client import CellClient
    from push_ident_msgs.action import PushToGoal

__all__ = ["GoalText", "finish", "goals_of", "push_to_command", "push_to_goal"]

_TO_WRITE = 15.0
"""From Ctrl-C to the end by force [s]: for the arm to be held, 1 s, and for results and page, 1 s on an idle machine."""
_STATES = ("looking", "exploring push", "planning", "pushing", "learning")
"""What is under way, by the state in the feedback of action/PushToGoal."""


def goals_of(x: float | None, y: float | None, yaw: float | None, path: Path | None, spacing_mm: float | None) -> Float64Array:
    """Poses of a path to be followed, or to be pushed to one after another, shape (n, 3), from the options of the command line.

    Raises:
        InputError: neither a whole pose nor a path, both, numbers that are not finite, or a file that holds no path.
    """
    pose = [value for value in (x, y, yaw) if value is not None]
    if path is not None:
        if pose:
            raise InputError("--path was given beside --x, --y or --yaw; give a path or one pose.")
        from push_ident.planning.path_goal import read_path

        followed = read_path(path)
        return followed.poses if spacing_mm is None else followed.waypoints(1e-3 * spacing_mm)
    if len(pose) < 3:
        raise InputError("A goal is missing; give --x, --y and --yaw, or a file of poses with --path.")
    if not np.isfinite(pose).all():
        raise InputError(f"the goal is ({x}, {y}, {yaw}), expected finite numbers in metres and radians")
    return np.array([pose])


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
            report.start = planar(feedback.pose)
        report.take(feedback)
        report.result = broken_off(feedback)
        state = _STATES[feedback.state] if feedback.state < len(_STATES) else "at work"
        show(f"push {feedback.pushes + 1}: {state}")

    try:
        report.result = client.push_to_goal(goal, on_feedback=progress)
    finally:
        found = (goal.object_id,) if goal.object_id else client.object_ids()
        if len(found) == 1 and client.is_known(found[0]):
            goal.object_id, report.outline = found[0], client.shape(found[0]).outline
            report.effects = printable(client.values_of("identification_node").get(f"{found[0]}: diagnosed effects", ""))
    if latest is not None and (poses := client.poses(goal.object_id)):
        report.take(last_feedback(report.result, latest, poses[-1][1]))


def push_to_command(
    x: PlaceOption = None,
    y: PlaceOption = None,
    yaw: YawOption = None,
    path: PathOption = None,
    spacing_mm: SpacingOption = None,
    speed_mm: SpeedOption = None,
    edge: EdgeFlag = False,
    edge_line: EdgeLineOption = None,
    overhang_mm: OverhangOption = None,
    held_mm: HeldOption = None,
    tolerance_mm: ToleranceOption = None,
    tolerance_deg: ToleranceAngleOption = None,
    explore: ExploreOption = 0,
    max_pushes: MaxPushesOption = None,
    time_limit: TimeLimitOption = 300.0,
    object_id: ObjectOption = "",
    out: OutOption = None,
    json: JsonOption = None,
) -> None:
    """Push an object of a live cell to a goal pose, along a path, or out over an edge; exit status 0 only where it was reached.

    Ctrl-C holds the arm; results are written all the same.
    """
    options = EdgeOptions(edge=edge, line=edge_line, overhang_mm=overhang_mm, held_mm=held_mm, x=x, y=y, path=path)
    poses = np.full((1, 3), np.nan) if edge else goals_of(x, y, yaw, path, spacing_mm)
    need_ros()
    follows = path is not None and spacing_mm is None
    limits: dict[str, Any] = {"object_id": object_id, "time_limit": time_limit}
    limits |= {"tolerance_mm": tolerance_mm or (3.0 if follows else 20.0), "max_pushes": max_pushes or (60 if follows else 15)}
    if edge:
        limits |= {"tolerance_deg": tolerance_deg or 15.0, "overhang_mm": options.overhang_mm, "held_mm": options.held_mm}
        goals = [edge_message(yaw, options.line, explore=explore, **limits)]
    elif follows:
        goals = [path_message(poses, 1e-3 * (speed_mm or 0.0), explore=explore, tolerance_deg=tolerance_deg or 2.0, **limits)]
    else:
        limits["tolerance_deg"] = tolerance_deg or 5.73
        goals = [goal_message(pose, explore=0 if number else explore, **limits) for number, pose in enumerate(poses)]
    reports: list[GoalReport] = []
    try:
        _pursue(goals, reports)
    finally:
        # Also after Ctrl-C, and where the cell does not answer any more.
        if reports and not np.isnan(reports[0].start[0]):
            whole = PathReport(reports, len(poses)) if path is not None and not follows else reports[0]
            _write(whole.content(), out, json)
    if path is None or follows:
        finish(reports[0])
    else:
        _finish_path(PathReport(reports, len(poses)))


def _pursue(goals: Sequence[PushToGoal.Goal], reports: list[GoalReport]) -> None:
    """Push to one goal after another, until one is not reached; `reports` gets a report for each that was begun."""
    from push_ident.nodes.base.lifetime import LIFETIME
    from push_ident.nodes.client.cell_client import CellClient

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
    if report.goal.kind == report.goal.KIND_PATH:
        console.print(
            f"at the end of the path after {result.pushes} pushes with {result.corrections} corrections and {result.elapsed:.0f} s: "
            f"{1e3 * result.rms_position:.1f} mm and {np.degrees(result.rms_yaw):.1f}° from it (root mean square)",
            highlight=False,
        )
        return
    if report.edge is None:
        console.print(f"at the goal after {result.pushes} pushes and {result.elapsed:.0f} s: {where}", highlight=False)
        return
    x, y, yaw = report.target
    console.print(
        f"over the edge by {1e3 * report.overhang:.0f} mm after {result.pushes} pushes and {result.elapsed:.0f} s, the centre of mass "
        f"{1e3 * report.margin:.0f} mm inside its support; pre-grasp pose ({x:.3f}, {y:.3f}) m, {yaw:.2f} rad: {where}",
        highlight=False,
        soft_wrap=True,
    )
