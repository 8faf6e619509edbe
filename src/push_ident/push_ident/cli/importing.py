"""`push-ident import`: recordings of others as bags of the contract, one command for each format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from push_ident.bags.importers import (
    FINGER_SHAPES,
    MIT_SHAPES,
    FingerOptions,
    ImportReport,
    MitOptions,
    MocapObject,
    RosbagTopics,
    TableFormat,
    TrackedPoses,
    import_cmu_fingers,
    import_cmu_icra16,
    import_cmu_mocap,
    import_mit,
    import_rosbag,
    import_tracked_poses,
)
from push_ident.bags.importers.axes import parse_axes
from push_ident.bags.importers.recording import OverlapError, RecordingOptions
from push_ident.bags.importers.rosbag import parse_map
from push_ident.bags.importers.shapes import CELL_SIZE
from push_ident.bags.importers.tables import parse_columns, read_table
from push_ident.bags.importers.tracked_poses import POSE_ROLES, PUSHER_ROLES
from push_ident.cli.checks import above_zero, at_least_zero, finite, new_bag, writable_file
from push_ident.cli.identify import read_camera
from push_ident.cli.output import JsonOption, say, warn, write_json
from push_ident.cli.units import in_unit, parse_floats
from push_ident.errors import InputError
from push_ident.extras import need
from push_ident.types import Float64Array

BagOption = Annotated[Path, typer.Option("--out", metavar="BAG", help="New bag.", callback=new_bag, show_default=False)]
PageOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", callback=writable_file, help="Page (HTML) about the import. Default: beside the bag.", show_default=False),
]


LengthUnit = Literal["m", "cm", "mm", "in"]
AngleUnit = Literal["rad", "deg"]
TimeUnit = Literal["s", "ms", "us", "ns"]
_SI = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "in": 0.0254,
    "rad": 1.0,
    "deg": float(np.pi / 180.0),
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
}
"""Metres, radians or seconds of each of these units."""
PositionStdOption = Annotated[
    float | None,
    typer.Option(
        "--position-std",
        parser=in_unit("m"),
        callback=above_zero,
        help="Standard deviation of an object position [m]. Default: the scatter at rest; for mit 0.5 mm.",
        show_default=False,
    ),
]
YawStdOption = Annotated[
    float | None,
    typer.Option(
        "--yaw-std",
        parser=in_unit("rad"),
        callback=above_zero,
        help="Standard deviation of an object yaw [rad]. Default: the scatter at rest; for mit 0.3 degrees.",
        show_default=False,
    ),
]
PusherOption = Annotated[
    Path,
    typer.Option(
        metavar="FILE", help="Table time,x,y of the axis of the pusher, optionally with z and push; or FILE#BODY.", show_default=False
    ),
]
WrenchOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Table time,fx,fy of the force on the object [N].", show_default=False)
]
TableOption = Annotated[Path, typer.Option(metavar="FILE", help="Table x,y of the outline, object frame.", show_default=False)]
RadiusOption = Annotated[
    float, typer.Option(parser=in_unit("m"), callback=at_least_zero, help="Radius of the pusher [m, or 4.75mm].", show_default=False)
]
ColumnsOption = Annotated[str, typer.Option(metavar="ROLE=NAME,…", help="Other names of the columns of POSES.", show_default=False)]
PusherColumnsOption = Annotated[
    str, typer.Option(metavar="ROLE=NAME,…", help="Other names of the columns of --pusher.", show_default=False)
]
TimeUnitOption = Annotated[TimeUnit, typer.Option(help="Unit of time in columns whose names say none.")]
PosesArgument = Annotated[
    Path | None,
    typer.Argument(
        metavar="POSES",
        help="Table time,x,y,yaw or time,x,y,z,qx,qy,qz,qw of the object; or an export of Motive, Vicon or QTM, as FILE#BODY.",
        show_default=False,
    ),
]
PusherLengthUnitOption = Annotated[LengthUnit | None, typer.Option(help="Of the pusher, if it has another.", show_default=False)]
OutlineUnitOption = Annotated[LengthUnit | None, typer.Option(help="Unit of the outline, if it has another.", show_default=False)]
AxesOption = Annotated[
    str,
    typer.Option(
        metavar="A,B,C",
        help="Axes of the poses that are x, y and z of the table; with y up x,-z,y. Default: x,y,z, or those of a motion capture program.",
        show_default=False,
    ),
]
PusherAxesOption = Annotated[
    str, typer.Option(metavar="A,B,C", help="The same of the pusher. Default: --axes, if it is given.", show_default=False)
]
WrenchAxesOption = Annotated[
    str, typer.Option(metavar="A,B,C", help="The same of the force, where it is not in the frame of the pusher.", show_default=False)
]
TimeOffsetOption = Annotated[
    float, typer.Option(callback=finite, help="Added to the times of pusher and force; above 0 where their clock is behind [s].")
]
PusherFrameOption = Annotated[
    str,
    typer.Option(metavar="X,Y,YAW", help="Where the frame of the pusher lies in that of the poses [m, m, rad].", show_default=False),
]
RosbagMapOption = Annotated[
    list[str],
    typer.Option(
        "--map",
        metavar="TOPIC=ROLE",
        help="What a topic holds: object (poses), pusher (poses of the tip), wrench (force on the object). Transforms as /tf#FRAME.",
        show_default=False,
    ),
]
FrameOption = Annotated[
    str,
    typer.Option(help="Frame of /tf with z up to which all is brought. Default: the nearest above object and pusher.", show_default=False),
]
LiftedOption = Annotated[
    float | None,
    typer.Option("--lifted-above", parser=in_unit("m"), help="Height z of the pusher above which it is lifted [m].", show_default=False),
]
CellSizeOption = Annotated[float, typer.Option(parser=in_unit("m"), callback=above_zero, help="Edge of the cells of the object [m].")]


import_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Convert own tables and bags, or published recordings, to a bag that all commands read.",
)

_FINGERS = FingerOptions()
_MIT = MitOptions()
FileArgument = Annotated[Path, typer.Argument(metavar="FILE", help="The recording as it was published.", show_default=False)]
SupportsOption = Annotated[
    tuple[str, str, str] | None,
    typer.Option(
        metavar="X,Y X,Y X,Y",
        help="The three supports [m], from the right-angle corner, if they are known. Default: those that the file's name gives.",
        show_default=False,
    ),
]
OutlineOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Table x,y of the outline [m], object frame, for another object.", show_default=False)
]


@import_app.command("cmu-icra16")
def icra16_command(
    file: FileArgument, out: BagOption, supports: SupportsOption = None, page: PageOption = None, json: JsonOption = None
) -> None:
    """Text file of single-point pushes of an aluminium triangle (CMU, ICRA 2016), any of the published sets."""
    points = _points(supports)
    run_import(lambda: import_cmu_icra16(file, out, supports=points), out, file.name, page, json)


@import_app.command("cmu-mocap")
def mocap_command(
    file: FileArgument,
    out: BagOption,
    supports: SupportsOption = None,
    mass: Annotated[
        float | None, typer.Option(callback=above_zero, help="Mass of the object, if it was weighed [kg].", show_default=False)
    ] = None,
    outline: OutlineOption = None,
    frame_in_body: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Object frame in the tracked body (4x4 numbers, text, in mm), for another object.",
            show_default=False,
        ),
    ] = None,
    page: PageOption = None,
    json: JsonOption = None,
) -> None:
    """ROS 1 bag of many pushes of a wooden triangle under motion capture (CMU)."""
    body = MocapObject(_outline(outline), read_camera(frame_in_body), _points(supports), mass)
    run_import(lambda: import_cmu_mocap(file, out, body=body), out, file.name, page, json)


@import_app.command("cmu-fingers")
def fingers_command(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Logs log*.txt of one object, or folders of them.", show_default=False)
    ],
    out: BagOption,
    shape: Annotated[
        str,
        typer.Option(help=f"Object, one of {', '.join(FINGER_SHAPES)}. Default: by names of files and folders.", show_default=False),
    ] = "",
    outline: OutlineOption = None,
    position_std: PositionStdOption = None,
    yaw_std: YawStdOption = None,
    ends_only: Annotated[bool, typer.Option("--ends-only", help="Keep only the poses before and after each push.")] = False,
    page: PageOption = None,
    json: JsonOption = None,
) -> None:
    """Logs of stable pushes with two fingers of a gripper (CMU, ISRR 2017)."""
    options = FingerOptions(
        shape=shape,
        outline=_outline(outline),
        position_std=_FINGERS.position_std if position_std is None else position_std,
        yaw_std=_FINGERS.yaw_std if yaw_std is None else yaw_std,
        ends_only=ends_only,
    )
    run_import(lambda: import_cmu_fingers(files, out, options=options), out, _names(files), page, json)


@import_app.command("mit")
def mit_command(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Files .json or .h5 of the dataset, or folders of them.", show_default=False)
    ],
    out: BagOption,
    shape: Annotated[
        str, typer.Option(help=f"Object, one of {', '.join(MIT_SHAPES)}. Default: by the file names.", show_default=False)
    ] = "",
    outline: OutlineOption = None,
    radius: Annotated[float, typer.Option(parser=in_unit("m"), callback=above_zero, help="Radius of the probe [m].")] = _MIT.radius,
    position_std: PositionStdOption = None,
    yaw_std: YawStdOption = None,
    ends_only: Annotated[bool, typer.Option("--ends-only", help="Keep only the poses before and after each push.")] = False,
    page: PageOption = None,
    json: JsonOption = None,
) -> None:
    """Files of the MIT pushing dataset (IROS 2016), one push each, one object on one surface."""
    options = MitOptions(
        shape=shape,
        outline=_outline(outline),
        radius=radius,
        position_std=_MIT.position_std if position_std is None else position_std,
        yaw_std=_MIT.yaw_std if yaw_std is None else yaw_std,
        ends_only=ends_only,
    )
    run_import(lambda: import_mit(files, out, options=options), out, _names(files), page, json)


def _names(files: list[Path]) -> str:
    return files[0].name + (f" and {len(files) - 1} more" if len(files) > 1 else "")


def _points(texts: tuple[str, str, str] | None) -> Float64Array | None:
    """Points `x,y` [m], shape (3, 2); raises InputError for another form."""
    if texts is None:
        return None
    expected = "X,Y of each of three points in metres, such as 0.03,0.03 0.09,0.03 0.03,0.09"
    return np.array([parse_floats(text, ("m", "m"), "--supports", expected) for text in texts])


def _pose(text: str) -> Float64Array | None:
    """Pose of the frame of the pusher (x, y, yaw) [m, m, rad]; None where it is not given."""
    return parse_floats(text, ("m", "m", "rad"), "--pusher-frame", "X,Y,YAW in metres and radians, such as 0.4,-0.1,1.57") if text else None


def _outline(file: Path | None) -> Float64Array | None:
    """Vertices [m], shape (n, 2), from a table x,y."""
    if file is None:
        return None
    table = read_table(file)
    outline = np.column_stack([table.column(axis, {}) for axis in ("x", "y")])
    if not np.isfinite(outline).all():
        raise InputError(f"{file}: a vertex lacks a number, expected x and y in every row.")
    return outline


@import_app.command("csv")
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
    length_unit: Annotated[LengthUnit, typer.Option(help="Unit of lengths in columns whose names say none.")] = "m",
    pusher_length_unit: PusherLengthUnitOption = None,
    outline_length_unit: OutlineUnitOption = None,
    angle_unit: Annotated[AngleUnit, typer.Option(help="Unit of yaw in columns whose names say none.")] = "rad",
    time_unit: TimeUnitOption = "s",
    pusher_time_unit: Annotated[TimeUnit | None, typer.Option(help="Of pusher and force, if another.", show_default=False)] = None,
    axes: AxesOption = "",
    pusher_axes: PusherAxesOption = "",
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
    pose_units = {"length": _SI[length_unit], "angle": _SI[angle_unit], "time": _SI[time_unit]}
    pusher_units = {"length": _SI[pusher_length_unit or length_unit], "time": _SI[pusher_time_unit or time_unit]}
    tables = TrackedPoses(
        poses=Path(object_) if poses is None else poses,
        pusher=pusher,
        outline=outline,
        radius=radius,
        wrench=wrench,
        object_id=object_ if poses is not None and object_ else "1",
        pose_format=TableFormat(parse_columns(columns, POSE_ROLES, "--columns"), option="--columns", **pose_units),
        pusher_format=TableFormat(
            parse_columns(pusher_columns, PUSHER_ROLES, "--pusher-columns"), option="--pusher-columns", **pusher_units
        ),
        outline_length=_SI[outline_length_unit or length_unit],
        axes=parse_axes(axes, "--axes") if axes else None,
        pusher_axes=parse_axes(pusher_axes, "--pusher-axes") if pusher_axes else None,
        cell_size=cell_size,
        position_std=position_std,
        yaw_std=yaw_std,
        lifted_above=lifted_above,
        time_offset=time_offset,
        pusher_frame=_pose(pusher_frame),
    )
    run_import(lambda: import_tracked_poses(tables, out), out, f"{tables.poses.name} and {pusher.name}", page, json)


@import_app.command("rosbag")
def rosbag_command(
    bags: Annotated[
        list[Path],
        typer.Argument(metavar="BAG...", help="The recording, of ROS 1 or ROS 2; or several, of one push each.", show_default=False),
    ],
    map_: RosbagMapOption,
    outline: TableOption,
    radius: RadiusOption,
    out: BagOption,
    object_id: Annotated[str, typer.Option("--object", metavar="ID", help="Id of the object in the new bag.")] = "1",
    length_unit: Annotated[LengthUnit, typer.Option(help="Unit of positions of the object and the pusher.")] = "m",
    pusher_length_unit: PusherLengthUnitOption = None,
    outline_length_unit: Annotated[LengthUnit, typer.Option(help="Unit of the outline.")] = "m",
    frame: FrameOption = "",
    axes: AxesOption = "x,y,z",
    pusher_axes: PusherAxesOption = "",
    log_time: Annotated[bool, typer.Option("--log-time", help="Take the times of recording, not the stamps.")] = False,
    time_offset: TimeOffsetOption = 0.0,
    pusher_frame: PusherFrameOption = "",
    wrench_axes: WrenchAxesOption = "",
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
    """Bags with other topics than those of the contract: say which topic holds what. Several become one, in order of their starts."""
    options = RecordingOptions(
        radius=radius,
        object_id=object_id,
        position_std=position_std,
        yaw_std=yaw_std,
        lifted_above=lifted_above,
        time_offset=time_offset,
        pusher_frame=_pose(pusher_frame),
    )
    source = RosbagTopics(
        bag=bags[0],
        more_bags=tuple(bags[1:]),
        topics=parse_map(map_),
        outline=outline,
        options=options,
        length=_SI[length_unit],
        pusher_length=None if pusher_length_unit is None else _SI[pusher_length_unit],
        outline_length=_SI[outline_length_unit],
        cell_size=cell_size,
        axes=parse_axes(axes, "--axes"),
        pusher_axes=parse_axes(pusher_axes or axes, "--pusher-axes"),
        log_time=log_time,
        wrench_axes=parse_axes(wrench_axes, "--wrench-axes") if wrench_axes else None,
        wrench_on_sensor=wrench_on_sensor,
        frame=frame.strip("/"),
    )
    run_import(lambda: import_rosbag(source, out), out, _names(bags), page, json)


def run_import(importer: Callable[[], ImportReport], out: Path, source: str, page: Path | None, json: Path | None) -> None:
    """Run an importer that writes the bag `out`, and show what came of it; `page`: by default beside the bag.

    Where the pusher never comes near the object, there is no bag, and the page shows where the pusher is instead.
    """
    need("report")
    from push_ident.bags.importers.import_page import force_warnings, write_import_page, write_refusal_page

    file = out.with_name(f"{out.stem}_import.html") if page is None else page
    try:
        report = importer()
    except OverlapError as error:
        write_refusal_page(file, error.overlap, str(error))
        say(f"page of the import: {file}")
        raise
    if report.overlap is None or report.overlap.fits:  # else no contact shows whether the forces are right
        report = replace(report, warnings=(*report.warnings, *force_warnings(report.bag)))
    write_import_page(file, report, source)
    _show(report)
    say(f"page of the import: {file}")
    write_json(json, _content(report, file))


def _show(report: ImportReport) -> None:
    distance = 1e3 * report.contact_distance[np.isfinite(report.contact_distance)]
    found = f"{np.mean(distance):.1f} ± {np.std(distance):.1f} mm" if len(distance) else "unknown"
    say(f"{report.n_pushes} pushes written to {report.bag}; distance between pusher and outline at first contact {found}")
    for note in report.notes:
        say(f"note: {note}")
    for warning in report.warnings:
        warn(f"warning: {warning}")


def _content(report: ImportReport, page: Path) -> dict[str, object]:
    return {
        "bag": str(report.bag),
        "page": str(page),
        "n_pushes": report.n_pushes,
        "contact_distance_m": report.contact_distance.tolist(),
        "tolerance_m": report.tolerance,
        "supports_m": report.supports.tolist(),
        "mass": report.mass,
        "centre_of_mass_m": None if report.centre_of_mass is None else report.centre_of_mass.tolist(),
        "surface": report.surface or None,
        "miss_m": None if report.overlap is None else report.overlap.miss,
        "causes": [] if report.overlap is None else [cause.text for cause in report.overlap.causes],
        "notes": list(report.notes),
        "warnings": list(report.warnings),
    }
