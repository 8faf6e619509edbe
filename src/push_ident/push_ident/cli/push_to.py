"""`push-ident push-to`: push an object of a live cell to a goal pose, from one to the next along a path, or out over an edge."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from push_ident.cli.checks import above_zero
from push_ident.cli.goal_report import GoalReport, PathReport, broken_off, edge_message, goal_message, last_feedback, path_message, planar
from push_ident.cli.output import JsonOption, OutOption, console, say, warn, write_json
from push_ident.cli.push_several import SeveralReport, parse_goals, push_several
from push_ident.cli.units import in_unit, parse_floats
from push_ident.errors import InputError
from push_ident.extras import need_ros
from push_ident.limits import plain_text, printable
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from push_ident.nodes.client.cell_client import CellClient
    from push_ident_msgs.action import PushToGoal

PlaceOption = Annotated[
    float | None,
    typer.Option(parser=in_unit("m"), metavar="M", help="Goal of the object's origin, table frame [m, or 50mm].", show_default=False),
]
YawOption = Annotated[
    float | None,
    typer.Option(
        parser=in_unit("rad"),
        metavar="ANGLE",
        help="Goal of the object's turn, table frame [rad, or 90deg]; with --edge not needed.",
        show_default=False,
    ),
]
PathOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Along a path: a line for each pose, x, y, yaw [m, rad].", show_default=False),
]
SpacingOption = Annotated[
    float | None,
    typer.Option(
        "--spacing-mm",
        metavar="MM",
        parser=in_unit("mm", 1.0),
        help="Push to poses on the path this far apart instead [mm, or 4cm].",
        show_default=False,
    ),
]
SpeedOption = Annotated[
    float | None,
    typer.Option("--speed-mm", metavar="MM/S", parser=in_unit("mm/s", 1.0), help="Along a path [mm/s, or 0.05m/s].", show_default="50"),
]
EdgeFlag = Annotated[bool, typer.Option("--edge", help="Out over an edge of the table, held on it, instead of to a pose.")]
EdgeLineOption = Annotated[
    str | None,
    typer.Option(
        metavar="X1,Y1,X2,Y2",
        help="Two points of the edge, the table on the left [m, or with units]. Default: the nearest edge that the node knows.",
        show_default=False,
    ),
]
OverhangOption = Annotated[
    float | None,
    typer.Option(
        "--overhang-mm", metavar="MM", parser=in_unit("mm", 1.0), help="Of the object beyond the edge [mm, or 4cm].", show_default="40"
    ),
]
HeldOption = Annotated[
    float | None,
    typer.Option(
        "--held-mm",
        metavar="MM",
        parser=in_unit("mm", 0.1),
        help="Least distance of the centre of mass from the border of what supports it, at the edge [mm, or 1cm].",
        show_default="10",
    ),
]
ToleranceOption = Annotated[
    str | None,
    typer.Option(
        metavar="M[,ANGLE]", help="Largest distance from the goal, and angle to it [m, rad, or 20mm,5deg]: both in one.", show_default=False
    ),
]
ToleranceLengthOption = Annotated[
    float | None,
    typer.Option(
        "--tolerance-mm",
        metavar="MM",
        parser=in_unit("mm", 0.1),
        help="Largest distance from the goal [mm, or 2cm].",
        show_default="20; along a path 3",
    ),
]
ToleranceAngleOption = Annotated[
    float | None,
    typer.Option(
        "--tolerance-deg",
        metavar="DEG",
        parser=in_unit("deg", 0.1),
        help="Largest angle to the goal [degrees, or 0.1rad].",
        show_default="5.73; at an edge 15, along a path 2",
    ),
]
ExploreOption = Annotated[int, typer.Option(min=0, help="Random pushes first; 0: use what is known of the object.")]
MaxPushesOption = Annotated[
    int | None,
    typer.Option("--max-pushes", min=1, help="Most pushes for a goal, exploring ones included.", show_default="15; along a path 60"),
]
TimeLimitOption = Annotated[float, typer.Option("--time-limit", min=1.0, callback=above_zero, help="Longest time for a goal [s].")]
GoalsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--goal",
        metavar="ID:X,Y,YAW",
        help="Goal of one of several objects, once for each: they are pushed one after another [m, rad, or with units].",
        show_default=False,
    ),
]
ObjectOption = Annotated[str, typer.Option("--object", metavar="ID", help="The object. Default: the only one.", show_default=False)]


_STATES = ("looking", "exploring push", "planning", "pushing", "learning")
"""What is under way, by the state in the feedback of action/PushToGoal."""


def goals_of(x: float | None, y: float | None, yaw: float | None, path: Path | None, spacing_mm: float | None) -> Float64Array:
    """Poses of a path to be followed, or to be pushed to one after another, shape (n, 3), from the options of the command line.

    Raises InputError: neither a whole pose nor a path, both, numbers that are not finite, or a file that holds no path.
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


def parse_goal(text: str) -> Float64Array:
    """A pose `X,Y,YAW` [m, m, rad], shape (3,). Raises InputError for another form."""
    return parse_floats(text, ("m", "m", "rad"), "--goal", "X,Y,YAW in metres and radians, such as 0.05,-0.1,1.57")


def parse_tolerance(text: str) -> tuple[float, float | None]:
    """`M[,ANGLE]` as millimetres and degrees, None without an angle. Raises InputError for another form, or nothing above 0."""
    expected = "M or M,ANGLE above 0 in metres and radians, such as 0.02,0.1 or 20mm,5deg"
    values = parse_floats(text, ("m", "rad")[: 1 + text.count(",")], "--tolerance", expected)
    if not np.all(values > 0):
        raise InputError(f"--tolerance is {plain_text(text)!r}, expected {expected}.")
    return 1e3 * float(values[0]), float(np.degrees(values[1])) if len(values) > 1 else None


def parse_edge(text: str) -> Float64Array:
    """Two points of an edge [m], shape (2, 2), with the table on the left of the way from the first to the second. Raises InputError."""
    from push_ident.physics.overhang import TableEdge

    points = parse_floats(text, ["m"] * 4, "--edge-line", "X1,Y1,X2,Y2 in metres, such as 0.15,-0.3,0.15,0.3").reshape(2, 2)
    TableEdge.between(*points)
    return points


def _one_form(both: str | None, mm: float | None, deg: float | None) -> tuple[float | None, float | None]:
    """Tolerances [mm] and [degrees], given in one text or in two numbers. Raises InputError where both forms are given."""
    if both is None:
        return mm, deg
    if mm is not None or deg is not None:
        raise InputError("--tolerance was given beside --tolerance-mm or --tolerance-deg; give one of both forms.")
    return parse_tolerance(both)


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
    report.count_up_to(int(report.result.pushes))


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
    tolerance: ToleranceOption = None,
    tolerance_mm: ToleranceLengthOption = None,
    tolerance_deg: ToleranceAngleOption = None,
    explore: ExploreOption = 0,
    max_pushes: MaxPushesOption = None,
    time_limit: TimeLimitOption = 300.0,
    object_id: ObjectOption = "",
    goal: GoalsOption = None,
    out: OutOption = None,
    json: JsonOption = None,
) -> None:
    """Push objects of a live cell to a pose, along a path, or out over an edge; exit status 0 only where all was reached.

    Ctrl-C holds the arm; results are written all the same.
    """
    for_edge = {"--edge-line": edge_line, "--overhang-mm": overhang_mm, "--held-mm": held_mm}
    _check_edge_options(edge, for_edge, {"--x": x, "--y": y, "--path": path})
    line = None if edge_line is None else parse_edge(edge_line)
    tolerance_mm, tolerance_deg = _one_form(tolerance, tolerance_mm, tolerance_deg)
    if goal:
        others = {"--x": x, "--y": y, "--yaw": yaw, "--path": path, "--edge": edge or None, "--object": object_id or None}
        limits: dict[str, Any] = {"time_limit": time_limit, "max_pushes": max_pushes or 15, "explore": explore}
        _push_several(goal, others, (tolerance_mm or 20.0, tolerance_deg or 5.73), limits, (out, json))
        return
    poses = np.full((1, 3), np.nan) if edge else goals_of(x, y, yaw, path, spacing_mm)
    need_ros()
    follows = path is not None and spacing_mm is None
    limits = {"object_id": object_id, "time_limit": time_limit}
    limits |= {"tolerance_mm": tolerance_mm or (3.0 if follows else 20.0), "max_pushes": max_pushes or (60 if follows else 15)}
    if edge:
        limits |= {"tolerance_deg": tolerance_deg or 15.0, "overhang_mm": overhang_mm or 40.0, "held_mm": held_mm or 10.0}
        goals = [edge_message(yaw, line, explore=explore, **limits)]
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

    LIFETIME.patience = 15.0  # [s] from Ctrl-C to the end by force: the arm is held in 1 s, results written in 1 s on an idle machine
    with CellClient() as client, console.status("looking for the cell") as status:
        for number, goal in enumerate(goals, 1):
            prefix = f"goal {number} of {len(goals)}: " if len(goals) > 1 else ""
            reports.append(GoalReport(goal))

            def show(text: str, prefix: str = prefix) -> None:
                status.update(escape(prefix + text))

            push_to_goal(client, reports[-1], show)
            if not reports[-1].is_reached:
                break


def _push_several(
    texts: Sequence[str],
    others: Mapping[str, object],
    tolerance: tuple[float, float],
    limits: Mapping[str, Any],
    files: tuple[Path | None, Path | None],
) -> None:
    """Push several objects, and say how it ended; `files`: folder and JSON file of the result. Raises typer.Exit with status 1 where not
    all are at their goals."""
    from push_ident.nodes.client.cell_client import CellClient

    if given := [name for name, value in others.items() if value is not None]:
        raise InputError(f"--goal was given beside {', '.join(given)}; name each object with --goal.")
    goals = parse_goals(texts)
    need_ros()
    report = SeveralReport(goals)
    try:
        with CellClient() as client, console.status("looking for the cell") as status:

            def push(client: CellClient, of: GoalReport, prefix: str) -> None:
                push_to_goal(client, of, lambda text: status.update(escape(prefix + text)))

            push_several(client, report, goals, push, tolerance=tolerance, limits=limits)
    finally:
        out, json = files
        for file in (json, None if out is None else out / "result.json"):
            write_json(file, report.content())
    content = report.content()
    if report.why:
        warn(f"push-ident: {content['n_reached']} of {content['n_objects']} objects are at their goals: {printable(report.why)}")
        raise typer.Exit(1)
    say(f"all {content['n_objects']} objects at their goals after {content['n_pushes']} pushes and {content['time_s']:.0f} s")


def _write(content: dict[str, Any], out: Path | None, json: Path | None) -> None:
    for file in [json, None if out is None else out / "result.json"]:
        write_json(file, content)
    if out is not None:
        from push_ident.planning.goal_page import write_goal_page

        page = out / "report.html"
        write_goal_page(page, content)
        say(f"written: {page}, {out / 'result.json'}")


def _finish_path(report: PathReport) -> None:
    """Say how a path ended. Raises typer.Exit with status 1 where a goal was not reached."""
    content = report.content()
    if not report.is_reached:
        last = report.reports[-1]
        number = len(report.reports)
        warn(f"push-ident: {last.content()['code']} at goal {number} of {report.n_goals}: {printable(last.result.error_text)}")
        raise typer.Exit(1)
    say(
        f"at the end of the path after {content['n_pushes']} pushes: {1e3 * content['rms_position_m']:.1f} mm and "
        f"{np.degrees(content['rms_yaw_rad']):.1f}° from its {report.n_goals} goals (root mean square)"
    )


def finish(report: GoalReport) -> None:
    """Say how it ended. Raises typer.Exit with status 1 where the goal was not reached."""
    result = report.result
    where = f"{1e3 * result.position_error:.1f} mm and {np.degrees(result.yaw_error):.1f}° from it"
    if not report.is_reached:
        warn(f"push-ident: {report.content()['code']}: {printable(result.error_text)}")
        raise typer.Exit(1)
    if report.goal.kind == report.goal.KIND_PATH:
        say(
            f"at the end of the path after {result.pushes} pushes with {result.corrections} corrections and {result.elapsed:.0f} s: "
            f"{1e3 * result.rms_position:.1f} mm and {np.degrees(result.rms_yaw):.1f}° from it (root mean square)"
        )
        return
    if report.edge is None:
        made = f"after {result.pushes} pushes and {result.elapsed:.0f} s" if result.pushes else "already, nothing was pushed"
        say(f"at the goal {made}: {where}")
        return
    x, y, yaw = report.target
    say(
        f"over the edge by {1e3 * report.overhang:.0f} mm after {result.pushes} pushes and {result.elapsed:.0f} s, the centre of mass "
        f"{1e3 * report.margin:.0f} mm inside its support; pre-grasp pose ({x:.3f}, {y:.3f}) m, {yaw:.2f} rad: {where}"
    )


def _check_edge_options(is_at_edge: bool, for_edge: Mapping[str, object], for_pose: Mapping[str, object]) -> None:
    """Raise InputError where an option for a goal at an edge is given for another one, or the other way round; None: not given."""
    if not is_at_edge and (given := [name for name, value in for_edge.items() if value is not None]):
        raise InputError(f"{given[0]} was given without --edge; add --edge.")
    if is_at_edge and (given := [name for name, value in for_pose.items() if value is not None]):
        raise InputError(f"--edge was given beside {', '.join(given)}; of a pose only --yaw goes with it.")
