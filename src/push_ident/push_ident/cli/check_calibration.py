"""`push-ident check-calibration`: where camera and tool stand, by the contacts of recorded pushes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from push_ident.calibration.check import CalibrationCheck, Verdict, check_calibration
from push_ident.calibration.wording import HEADINGS, calibration_json, camera_file, rows_of, sentences_of
from push_ident.cli.checks import parse_numbers
from push_ident.cli.identify import (
    CameraOption,
    DepthUnitOption,
    MapOption,
    ObjectOption,
    WithoutOption,
    leave_out,
    read_camera,
    read_options,
)
from push_ident.cli.output import BagsArgument, JsonOption, OutOption, console, progress, say, warn, write_json
from push_ident.cli.overrides import parameters_of
from push_ident.cli.robot import RobotOption
from push_ident.errors import InputError
from push_ident.extras import need
from push_ident.files import write_whole
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.offline.loading import load_pushes
from push_ident.pushing.robot.robot_file import read_robot
from push_ident.survey.parameter_file import HEADING_STD, POSITION, POSITION_STD, QUATERNION
from push_ident.types import CameraAccuracy, Float64Array, PushRecord

_ParamsOption = Annotated[
    Path | None,
    typer.Option(
        "--params",
        metavar="FILE",
        help="Parameter file of the cell: pose and accuracy of the camera, where the bags do not have them.",
        show_default=False,
    ),
]


@dataclass(frozen=True, slots=True)
class _Configured:
    """What files of the cell state; None where they do not."""

    radius: float | None = None
    """Of the tool [m]."""
    camera_in_table: Float64Array | None = None
    accuracy: CameraAccuracy | None = None

    def of(self, records: list[PushRecord]) -> list[PushRecord]:
        """The pushes with this tool, and with this accuracy where they state none."""
        if self.radius is not None:
            records = [replace(record, pusher=replace(record.pusher, radius=self.radius)) for record in records]
        if self.accuracy is not None and records[0].poses.camera == CameraAccuracy():
            records = [replace(record, poses=replace(record.poses, camera=self.accuracy)) for record in records]
        return records


def check_calibration_command(
    bags: BagsArgument,
    robot: RobotOption = None,
    params: _ParamsOption = None,
    out: OutOption = None,
    json: JsonOption = None,
    without: WithoutOption = "",
    object_id: ObjectOption = "",
    camera: CameraOption = None,
    map_: MapOption = None,
    depth_unit: DepthUnitOption = None,
) -> None:
    """Compare where camera and tool stand, by the contacts of recorded pushes, with what is configured.

    The exit status is 0 where they agree, and 1 where they differ or the pushes do not show it.
    """
    if out is not None:
        need("report")
    left_out = parse_numbers(without, "--without") if without else []
    options, in_table, configured = read_options(map_, depth_unit), read_camera(camera), _configured(robot, params)
    pose = configured.camera_in_table if in_table is None else in_table
    with progress() as report:
        loaded = load_pushes(bags, object_id=object_id, camera_in_table=pose, options=options, on_progress=report)
        loaded, kept = leave_out(loaded, left_out, no_forces=False)
        report("fitting the contacts")
        records = configured.of([loaded[i] for i in kept])
        check = check_calibration(records)
    pose = loaded.camera_in_table
    notes = [*loaded.notes]
    if configured.radius is not None and (used := loaded[0].pusher.radius) != configured.radius:
        notes.append(
            f"the bags have a tool of radius {1e3 * used:.1f} mm; the {1e3 * configured.radius:.1f} mm of the robot file are checked."
        )
    for note in notes:
        warn(f"note: {note}")
    _show(check, loaded.object_id)
    content = calibration_json(check, pose) | {"notes": notes}
    for file in (json, None if out is None else out / "result.json"):
        write_json(file, content)
    if out is not None:
        from push_ident.calibration.page import write_calibration_page

        write_calibration_page(out / "calibration.html", check, title=f"Calibration, by pushes of {loaded.object_id}")
        names = ["calibration.html", "result.json"]
        if content["corrected_camera"] is not None:
            assert pose is not None
            source = ", ".join(path.name for path in bags)
            write_whole(out / "camera.yaml", camera_file(check, pose, source), "the parameter file")
            names.append("camera.yaml")
        say(f"written: {', '.join(str(out / name) for name in names)}")
        if pose is None:
            warn("note: no bag has the pose of the camera, so that no corrected one is written; give --params, --robot or --camera.")
    if check.verdict is not Verdict.AGREES:
        raise typer.Exit(1)


def _show(check: CalibrationCheck, object_id: str) -> None:
    table = Table(*HEADINGS, title=f"object {object_id}: camera and tool")
    for row in rows_of(check):
        table.add_row(*row)
    console.print(table)
    for sentence in sentences_of(check):
        say(sentence)
    for text in check.warnings:
        warn(f"warning: {text}")


def _configured(robot: Path | None, params: Path | None) -> _Configured:
    """Tool and camera of the files of a cell; of two that place the camera, the parameter file counts."""
    found = _Configured()
    if robot is not None:
        read = read_robot(robot)
        found = _Configured(read.file.tool.pusher_radius, read.camera_in_table)
    if params is None:
        return found
    values = parameters_of(params, "perception_node")
    if POSITION in values and QUATERNION in values:
        found = replace(found, camera_in_table=pose_of_quaternion(values[POSITION], values[QUATERNION]))
    if POSITION_STD in values or HEADING_STD in values:
        found = replace(found, accuracy=CameraAccuracy(_number(values, POSITION_STD, params), _number(values, HEADING_STD, params)))
    return found


def _number(values: dict[str, Any], name: str, file: Path) -> float:
    value = values.get(name, 0.0)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"--params {file}: {name} is {value!r}, expected a number.")
    return float(value)
