"""`push-ident import`: recordings of others as bags of the contract, one command for each format."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from push_ident.bags.importers import (
    MIT_SHAPES,
    ImportReport,
    MitOptions,
    MocapObject,
    TableFormat,
    TrackedPoses,
    import_cmu_icra16,
    import_cmu_mocap,
    import_mit,
    import_tracked_poses,
)
from push_ident.bags.importers.shapes import CELL_SIZE
from push_ident.bags.importers.tables import parse_columns, read_table
from push_ident.bags.importers.tracked_poses import POSE_ROLES, PUSHER_ROLES
from push_ident.cli.identify import read_camera
from push_ident.cli.output import JsonOption, console, warn, write_json
from push_ident.errors import InputError
from push_ident.limits import plain_text
from push_ident.types import Float64Array

__all__ = ["import_app"]

import_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Convert a recording of others to a bag of the contract.")

_MIT = MitOptions()
FileArgument = Annotated[Path, typer.Argument(metavar="FILE", help="The recording as it was published.", show_default=False)]
BagOption = Annotated[Path, typer.Option("--out", metavar="BAG", help="New bag.", show_default=False)]
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
PositionStdOption = Annotated[
    float | None, typer.Option("--position-std", help="Standard deviation of an object position [m].", show_default=False)
]
YawStdOption = Annotated[float | None, typer.Option("--yaw-std", help="Standard deviation of an object yaw [rad].", show_default=False)]


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


@import_app.command("cmu-icra16")
def icra16_command(file: FileArgument, out: BagOption, supports: SupportsOption = None, json: JsonOption = None) -> None:
    """Text file of single-point pushes of an aluminium triangle (CMU, ICRA 2016), any of the published sets."""
    _show(import_cmu_icra16(file, out, supports=_points(supports)), json)


@import_app.command("cmu-mocap")
def mocap_command(
    file: FileArgument,
    out: BagOption,
    supports: SupportsOption = None,
    mass: Annotated[float | None, typer.Option(help="Mass of the object, if it was weighed [kg].", show_default=False)] = None,
    outline: OutlineOption = None,
    frame_in_body: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Object frame in the tracked body (4x4 numbers, text, in mm), for another object.",
            show_default=False,
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """ROS 1 bag of many pushes of a wooden triangle under motion capture (CMU)."""
    body = MocapObject(_outline(outline), read_camera(frame_in_body), _points(supports), mass)
    _show(import_cmu_mocap(file, out, body=body), json)


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
    radius: Annotated[float, typer.Option(help="Radius of the probe [m].")] = _MIT.radius,
    position_std: PositionStdOption = None,
    yaw_std: YawStdOption = None,
    ends_only: Annotated[bool, typer.Option("--ends-only", help="Keep only the poses before and after each push.")] = False,
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
    _show(import_mit(files, out, options=options), json)


@import_app.command("csv")
def csv_command(
    pusher: Annotated[
        Path, typer.Option(metavar="FILE", help="Table time,x,y of the axis of the pusher, optionally with z and push.", show_default=False)
    ],
    outline: Annotated[Path, typer.Option(metavar="FILE", help="Table x,y of the outline, object frame.", show_default=False)],
    radius: Annotated[float, typer.Option(help="Radius of the pusher [m].", show_default=False)],
    out: BagOption,
    poses: Annotated[
        Path | None,
        typer.Argument(metavar="POSES", help="Table time,x,y,yaw or time,x,y,z,qx,qy,qz,qw of the object.", show_default=False),
    ] = None,
    object_: Annotated[
        str,
        typer.Option(
            "--object", metavar="ID", help="Id of the object in the bag; without POSES the file of its poses.", show_default=False
        ),
    ] = "",
    wrench: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Table time,fx,fy of the force on the object [N].", show_default=False)
    ] = None,
    columns: Annotated[str, typer.Option(metavar="ROLE=NAME,…", help="Other names of the columns of POSES.", show_default=False)] = "",
    pusher_columns: Annotated[
        str, typer.Option(metavar="ROLE=NAME,…", help="Other names of the columns of --pusher.", show_default=False)
    ] = "",
    length_unit: Annotated[LengthUnit, typer.Option(help="Unit of lengths in all files.")] = LengthUnit.m,
    angle_unit: Annotated[AngleUnit, typer.Option(help="Unit of yaw.")] = AngleUnit.rad,
    time_unit: Annotated[TimeUnit, typer.Option(help="Unit of time in all files.")] = TimeUnit.s,
    position_std: PositionStdOption = None,
    yaw_std: YawStdOption = None,
    lifted_above: Annotated[
        float | None, typer.Option(help="Height z of the pusher above which it is lifted [m].", show_default=False)
    ] = None,
    cell_size: Annotated[float, typer.Option(help="Edge of the cells of the object [m].")] = CELL_SIZE,
    json: JsonOption = None,
) -> None:
    """Tables of tracked poses of an object and of the pusher (CSV). Options are in metres and radians whatever the units of the files."""
    if poses is None and not object_:
        raise InputError("no file of the object's poses is given; name it before the options.")
    units = {"length": length_unit.metres, "angle": angle_unit.radians, "time": time_unit.seconds}
    recording = TrackedPoses(
        poses=Path(object_) if poses is None else poses,
        pusher=pusher,
        outline=outline,
        radius=radius,
        wrench=wrench,
        object_id=object_ if poses is not None and object_ else "1",
        pose_format=TableFormat(parse_columns(columns, POSE_ROLES, "--columns"), **units),
        pusher_format=TableFormat(parse_columns(pusher_columns, PUSHER_ROLES, "--pusher-columns"), **units),
        position_std=position_std,
        yaw_std=yaw_std,
        lifted_above=lifted_above,
        cell_size=cell_size,
    )
    _show(import_tracked_poses(recording, out), json)


def _points(texts: tuple[str, str, str] | None) -> Float64Array | None:
    """Points `x,y` [m], shape (3, 2); raises InputError for another form."""
    if texts is None:
        return None
    try:
        points = np.array([[float(number) for number in text.split(",")] for text in texts], dtype=np.float64)
    except ValueError:
        points = np.zeros((0, 0))
    if points.shape != (3, 2) or not np.isfinite(points).all():
        raise InputError(f"--supports is {plain_text(' '.join(texts))}, expected three points such as 0.03,0.03 0.09,0.03 0.03,0.09.")
    return points


def _outline(file: Path | None) -> Float64Array | None:
    """Vertices [m], shape (n, 2), from a table x,y."""
    if file is None:
        return None
    table = read_table(file)
    outline = np.column_stack([table.column(axis, {}) for axis in ("x", "y")])
    if not np.isfinite(outline).all():
        raise InputError(f"{file}: a vertex lacks a number, expected x and y in every row.")
    return outline


def _show(report: ImportReport, json: Path | None) -> None:
    distance = 1e3 * report.contact_distance[np.isfinite(report.contact_distance)]
    found = f"{np.mean(distance):.1f} ± {np.std(distance):.1f} mm" if len(distance) else "unknown"
    console.print(
        f"{report.n_pushes} pushes written to {report.bag}; distance between pusher and outline at first contact {found}",
        highlight=False,
        soft_wrap=True,
    )
    for note in report.notes:
        console.print(f"note: {note}", highlight=False, soft_wrap=True)
    for warning in report.warnings:
        warn(f"warning: {warning}")
    if json is not None:
        write_json(
            json,
            {
                "bag": str(report.bag),
                "n_pushes": report.n_pushes,
                "contact_distance_m": report.contact_distance.tolist(),
                "supports_m": report.supports.tolist(),
                "mass": report.mass,
                "centre_of_mass_m": None if report.centre_of_mass is None else report.centre_of_mass.tolist(),
                "surface": report.surface or None,
                "notes": list(report.notes),
                "warnings": list(report.warnings),
            },
        )
