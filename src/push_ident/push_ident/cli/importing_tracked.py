"""`push-ident import csv` and `import rosbag`: own recordings of tracked poses."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from push_ident.bags.importers import (
    RosbagTopics,
    TableFormat,
    TrackedPoses,
    import_rosbag,
    import_tracked_poses,
)
from push_ident.bags.importers.axes import parse_axes
from push_ident.bags.importers.recording import RecordingOptions
from push_ident.bags.importers.rosbag import parse_map
from push_ident.bags.importers.shapes import CELL_SIZE
from push_ident.bags.importers.tables import parse_columns
from push_ident.bags.importers.tracked_poses import POSE_ROLES, PUSHER_ROLES
from push_ident.cli.checks import above_zero, at_least_zero, finite
from push_ident.cli.import_report import BagOption, PageOption, run_import
from push_ident.cli.output import JsonOption
from push_ident.errors import InputError
from push_ident.limits import plain_text
from push_ident.types import Float64Array

__all__ = ["PositionStdOption", "YawStdOption", "csv_command", "rosbag_command"]


class LengthUnit(StrEnum):
    """Unit of length of a file."""

    m = "m"
    mm = "mm"

    @property
    def metres(self) -> float:
        """[m]"""
        return 1e-3 if self is LengthUnit.mm else 1.0


class AngleUnit(StrEnum):
    """Unit of angle of a file."""

    rad = "rad"
    deg = "deg"

    @property
    def radians(self) -> float:
        """[rad]"""
        return float(np.pi / 180.0) if self is AngleUnit.deg else 1.0


class TimeUnit(StrEnum):
    """Unit of time of a file."""

    s = "s"
    ms = "ms"
    us = "us"
    ns = "ns"

    @property
    def seconds(self) -> float:
        """[s]"""
        return {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[self.value]


PositionStdOption = Annotated[
    float | None,
    typer.Option(
        "--position-std",
        callback=above_zero,
        help="Standard deviation of an object position [m]. Default: the scatter at rest; for mit 0.5 mm.",
        show_default=False,
    ),
]
YawStdOption = Annotated[
    float | None,
    typer.Option(
        "--yaw-std",
        callback=above_zero,
        help="Standard deviation of an object yaw [rad]. Default: the scatter at rest; for mit 0.3 degrees.",
        show_default=False,
    ),
]
PusherOption = Annotated[
    Path, typer.Option(metavar="FILE", help="Table time,x,y of the axis of the pusher, optionally with z and push.", show_default=False)
]
WrenchOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Table time,fx,fy of the force on the object [N].", show_default=False)
]
TableOption = Annotated[Path, typer.Option(metavar="FILE", help="Table x,y of the outline, object frame.", show_default=False)]
RadiusOption = Annotated[float, typer.Option(callback=at_least_zero, help="Radius of the pusher [m].", show_default=False)]
ColumnsOption = Annotated[str, typer.Option(metavar="ROLE=NAME,…", help="Other names of the columns of POSES.", show_default=False)]
PusherColumnsOption = Annotated[
    str, typer.Option(metavar="ROLE=NAME,…", help="Other names of the columns of --pusher.", show_default=False)
]
TimeUnitOption = Annotated[TimeUnit, typer.Option(help="Unit of time in columns whose names say none.")]
PosesArgument = Annotated[
    Path | None, typer.Argument(metavar="POSES", help="Table time,x,y,yaw or time,x,y,z,qx,qy,qz,qw of the object.", show_default=False)
]
OutlineUnitOption = Annotated[LengthUnit | None, typer.Option(help="Unit of the outline, if it has another.", show_default=False)]
AxesOption = Annotated[
    str, typer.Option(metavar="A,B,C", help="Axes of the poses that are x, y and z of the table; of a file with y up x,-z,y.")
]
PusherAxesOption = Annotated[str, typer.Option(metavar="A,B,C", help="The same of the pusher.")]
TimeOffsetOption = Annotated[
    float, typer.Option(callback=finite, help="Added to the times of pusher and force; above 0 where their clock is behind [s].")
]
PusherFrameOption = Annotated[
    str,
    typer.Option(metavar="X,Y,YAW", help="Where the frame of the pusher lies in that of the poses [m, m, rad].", show_default=False),
]
LiftedOption = Annotated[
    float | None,
    typer.Option("--lifted-above", callback=finite, help="Height z of the pusher above which it is lifted [m].", show_default=False),
]
CellSizeOption = Annotated[float, typer.Option(callback=above_zero, help="Edge of the cells of the object [m].")]


def csv_command(
    pusher: PusherOption,
    outline: TableOption,
    radius: RadiusOption,
    out: BagOption,
    poses: PosesArgument = None,
    object_: Annotated[
        str,
        typer.Option(
            "--object", metavar="ID", help="Id of the object in the bag; without POSES the file of its poses.", show_default=False
        ),
    ] = "",
    wrench: WrenchOption = None,
    columns: ColumnsOption = "",
    pusher_columns: PusherColumnsOption = "",
    length_unit: Annotated[LengthUnit, typer.Option(help="Unit of lengths in columns whose names say none.")] = LengthUnit.m,
    pusher_length_unit: Annotated[LengthUnit | None, typer.Option(help="Of the pusher, if it has another.", show_default=False)] = None,
    outline_length_unit: OutlineUnitOption = None,
    angle_unit: Annotated[AngleUnit, typer.Option(help="Unit of yaw in columns whose names say none.")] = AngleUnit.rad,
    time_unit: TimeUnitOption = TimeUnit.s,
    pusher_time_unit: Annotated[TimeUnit | None, typer.Option(help="Of pusher and force, if another.", show_default=False)] = None,
    axes: AxesOption = "x,y,z",
    pusher_axes: PusherAxesOption = "x,y,z",
    time_offset: TimeOffsetOption = 0.0,
    pusher_frame: PusherFrameOption = "",
    position_std: PositionStdOption = None,
    yaw_std: YawStdOption = None,
    lifted_above: LiftedOption = None,
    cell_size: CellSizeOption = CELL_SIZE,
    page: PageOption = None,
    json: JsonOption = None,
) -> None:
    """Tables of tracked poses of an object and of the pusher (CSV). Options are in metres and radians whatever the units of the files."""
    if poses is None and not object_:
        raise InputError("no file of the object's poses is given; name it before the options.")
    pose_units = {"length": length_unit.metres, "angle": angle_unit.radians, "time": time_unit.seconds}
    pusher_units = {"length": (pusher_length_unit or length_unit).metres, "time": (pusher_time_unit or time_unit).seconds}
    tables = TrackedPoses(
        poses=Path(object_) if poses is None else poses,
        pusher=pusher,
        outline=outline,
        radius=radius,
        wrench=wrench,
        object_id=object_ if poses is not None and object_ else "1",
        pose_format=TableFormat(parse_columns(columns, POSE_ROLES, "--columns"), **pose_units),
        pusher_format=TableFormat(parse_columns(pusher_columns, PUSHER_ROLES, "--pusher-columns"), **pusher_units),
        outline_length=(outline_length_unit or length_unit).metres,
        axes=parse_axes(axes, "--axes"),
        pusher_axes=parse_axes(pusher_axes, "--pusher-axes"),
        cell_size=cell_size,
        position_std=position_std,
        yaw_std=yaw_std,
        lifted_above=lifted_above,
        time_offset=time_offset,
        pusher_frame=_frame(pusher_frame),
    )
    run_import(lambda: import_tracked_poses(tables, out), out, f"{tables.poses.name} and {pusher.name}", page, json)


def rosbag_command(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help="The recording, of ROS 1 or ROS 2.", show_default=False)],
    map_: Annotated[
        list[str],
        typer.Option(
            "--map",
            metavar="TOPIC=ROLE",
            help="What a topic holds: object (poses), pusher (poses of the tip), wrench (force on the object). Transforms as /tf#FRAME.",
            show_default=False,
        ),
    ],
    outline: TableOption,
    radius: RadiusOption,
    out: BagOption,
    object_id: Annotated[str, typer.Option("--object", metavar="ID", help="Id of the object in the new bag.")] = "1",
    outline_length_unit: Annotated[LengthUnit, typer.Option(help="Unit of the outline.")] = LengthUnit.m,
    axes: AxesOption = "x,y,z",
    pusher_axes: PusherAxesOption = "x,y,z",
    log_time: Annotated[bool, typer.Option("--log-time", help="Take the times of recording, not the stamps.")] = False,
    time_offset: TimeOffsetOption = 0.0,
    pusher_frame: PusherFrameOption = "",
    wrench_on_sensor: Annotated[
        bool, typer.Option("--wrench-on-sensor", help="The force is that on the sensor, not on the object.")
    ] = False,
    position_std: PositionStdOption = None,
    yaw_std: YawStdOption = None,
    lifted_above: LiftedOption = None,
    cell_size: CellSizeOption = CELL_SIZE,
    page: PageOption = None,
    json: JsonOption = None,
) -> None:
    """Bag with other topics than those of the contract: say which topic holds what."""
    options = RecordingOptions(
        radius=radius,
        object_id=object_id,
        position_std=position_std,
        yaw_std=yaw_std,
        lifted_above=lifted_above,
        time_offset=time_offset,
        pusher_frame=_frame(pusher_frame),
    )
    source = RosbagTopics(
        bag=bag,
        topics=parse_map(map_),
        outline=outline,
        options=options,
        outline_length=outline_length_unit.metres,
        cell_size=cell_size,
        axes=parse_axes(axes, "--axes"),
        pusher_axes=parse_axes(pusher_axes, "--pusher-axes"),
        log_time=log_time,
        wrench_on_sensor=wrench_on_sensor,
    )
    run_import(lambda: import_rosbag(source, out), out, bag.name, page, json)


def _frame(text: str) -> Float64Array | None:
    """Pose `x,y,yaw` [m, m, rad]; None for no text. Raises InputError for another form."""
    if not text:
        return None
    try:
        pose = np.array([float(part) for part in text.split(",")])
    except ValueError:
        pose = np.empty(0)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise InputError(f"--pusher-frame is {plain_text(text)!r}, expected X,Y,YAW in metres and radians, such as 0.4,-0.1,1.57.")
    return pose
