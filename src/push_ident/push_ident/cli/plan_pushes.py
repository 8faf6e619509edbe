"""`push-ident plan-pushes`: which pushes to make with an object, from its outline alone."""

from __future__ import annotations

import json as json_module
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer

from push_ident.bags.importers.shapes import CELL_SIZE, shape_of_outline
from push_ident.bags.importers.tracked_poses import read_outline
from push_ident.cli.checks import writable_folder
from push_ident.cli.identify import FrictionOption, PusherFrictionOption
from push_ident.cli.importing import RadiusOption
from push_ident.cli.output import JsonOption, console, millimetres, number_table, progress, say, write_json
from push_ident.errors import InputError
from push_ident.extras import need
from push_ident.files import write_whole
from push_ident.geometry.outline import polygon_centroid
from push_ident.identification.predicting.planned import PUSHER_RADIUS
from push_ident.identification.predicting.push_page import write_push_page
from push_ident.identification.predicting.push_sequence import PushSequence, plan_pushes
from push_ident.identification.unknowns.prior import Prior
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, ObjectShape

_NOMINAL: Final = Prior()
_COLUMNS: Final = ("x_m", "y_m", "direction_rad", "distance_m", "speed_m_s")
_FILES: Final = ("pushes.csv", "pushes.html")

_OutlineOption = Annotated[
    Path | None, typer.Option("--outline", metavar="FILE", help="Table x,y of the outline [m], object frame.", show_default=False)
]
_LookOption = Annotated[
    Path | None,
    typer.Option("--look", metavar="FILE", help="What `push-ident look --json FILE` wrote.", show_default=False),
]
_ObjectOption = Annotated[
    str, typer.Option("--object", metavar="ID", help="Of the objects of --look. Default: the only one.", show_default=False)
]
_OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", callback=writable_folder, help="Folder for table and page.")]


def plan_pushes_command(
    outline: _OutlineOption = None,
    look: _LookOption = None,
    object_id: _ObjectOption = "",
    pushes: Annotated[int, typer.Option(min=1, max=20, help="Number of pushes.")] = 6,
    radius: RadiusOption = PUSHER_RADIUS,
    friction: FrictionOption = _NOMINAL.friction,
    pusher_friction: PusherFrictionOption = _NOMINAL.pusher_friction,
    seed: Annotated[int, typer.Option(min=0, help="Of the candidates.")] = 0,
    out: _OutOption = Path("out/plan"),
    json: JsonOption = None,
) -> None:
    """Plan the pushes after which an object is expected to be known best, and the causes of a gap told apart, from its outline alone.

    Each is given in the object frame, so that it can be made wherever the object then lies: as a table, a page with drawings, and the
    command for a live cell.
    """
    need("report")
    if outline is not None and look is not None:
        raise InputError("--outline and --look both say what the object is; give one of them.")
    name, shape, place = _given(outline, object_id) if look is None else _seen(look, object_id)
    prior = Prior(friction=friction, pusher_friction=pusher_friction)
    settings = PushSettings(pusher_radius=radius, workspace=(-np.inf, np.inf, -np.inf, np.inf))
    with progress() as report:
        sequence = plan_pushes(shape, pushes, settings, prior=prior, first_pose=place, seed=seed, on_progress=report)
    rows = [_row(sequence, number) for number in range(pushes)]
    commands = [_command(row, name) for row in rows]
    table, page = (out / file for file in _FILES)
    lines = [",".join(_COLUMNS), *(",".join(f"{row[key]:.4f}" for key in _COLUMNS) for row in rows)]
    write_whole(table, "\n".join(lines) + "\n", "the table")
    write_push_page(page, sequence, commands)
    _show(sequence, rows)
    for command in commands:
        say(command)
    say(f"written: {table} and {page}")
    write_json(json, {"pushes": rows, "expected_error_m": sequence.errors.tolist(), "commands": commands})


def _given(outline: Path | None, name: str) -> tuple[str, ObjectShape, Float64Array]:
    """Name, shape and first pose of an object whose outline is in a file."""
    if outline is None:
        raise InputError("say what the object is: --outline FILE, or --look FILE.")
    return name, read_outline(outline, length=1.0, cell_size=CELL_SIZE), np.zeros(3)


def _seen(look: Path, object_id: str) -> tuple[str, ObjectShape, Float64Array]:
    """The same of an object that `push-ident look` saw: its frame lies in the centroid of its outline, as that of perception does."""
    try:
        seen = json_module.loads(look.read_text(encoding="utf-8"))["objects"]
        objects = {str(one["object_id"]): np.array(one["outline_m"], dtype=np.float64) for one in seen}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{look} is no result of `push-ident look --json`: {error}.") from None
    if object_id not in objects and (object_id or len(objects) != 1):
        raise InputError(f"{look} has the objects {', '.join(objects) or 'none'}; name one of them with --object.")
    name = object_id or next(iter(objects))
    centre = np.array(polygon_centroid(objects[name]))
    return name, shape_of_outline(objects[name] - centre, what=f"object {name}"), np.append(centre, 0.0)


def _row(sequence: PushSequence, number: int) -> dict[str, Any]:
    plan = sequence.in_object(number)
    values = (*plan.contact_point, plan.direction, plan.distance, plan.speed)
    return dict(zip(_COLUMNS, map(float, values), strict=True)) | {"expected_error_m": float(sequence.errors[number + 1])}


def _command(row: dict[str, Any], name: str) -> str:
    x, y, direction, distance, speed = (f"{row[key]:.3f}" for key in _COLUMNS)
    return f"push-ident push --in-object --object {name or 'ID'} --at={x},{y} --direction={direction} --distance {distance} --speed {speed}"


def _show(sequence: PushSequence, rows: list[dict[str, Any]]) -> None:
    table = number_table("Pushes in the object frame", "push", "touch at [mm]", "towards", "way", "speed", "then expected")
    for number, row in enumerate(rows, 1):
        at, way = f"{1e3 * row['x_m']:.0f}, {1e3 * row['y_m']:.0f}", millimetres(row["distance_m"])
        speed, error = f"{row['speed_m_s']:.2f} m/s", millimetres(row["expected_error_m"])
        table.add_row(str(number), at, f"{np.degrees(row['direction_rad']):.0f}°", way, speed, error)
    console.print(table)
    say(f"expected error of other pushes: {millimetres(float(sequence.errors[0]))} before the first")
