"""`push-ident import`: recordings of others as bags of the contract, one command for each format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from push_ident.bags.importers import (
    MIT_SHAPES,
    MitOptions,
    MocapObject,
    import_cmu_icra16,
    import_cmu_mocap,
    import_mit,
)
from push_ident.bags.importers.tables import read_table
from push_ident.cli.checks import above_zero
from push_ident.cli.identify import read_camera
from push_ident.cli.import_report import BagOption, PageOption, run_import
from push_ident.cli.importing_tracked import PositionStdOption, YawStdOption, csv_command, rosbag_command
from push_ident.cli.output import JsonOption
from push_ident.errors import InputError
from push_ident.limits import plain_text
from push_ident.types import Float64Array

__all__ = ["import_app"]

import_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Convert own tables and bags, or published recordings, to a bag that all commands read.",
)

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


import_app.command("csv")(csv_command)
import_app.command("rosbag")(rosbag_command)


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
    radius: Annotated[float, typer.Option(callback=above_zero, help="Radius of the probe [m].")] = _MIT.radius,
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
    source = files[0].name + (f" and {len(files) - 1} more" if len(files) > 1 else "")
    run_import(lambda: import_mit(files, out, options=options), out, source, page, json)


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
