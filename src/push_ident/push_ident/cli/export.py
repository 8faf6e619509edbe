"""`push-ident export`: a model as a description for a simulator."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from push_ident.cli.checks import above_zero, writable_file
from push_ident.cli.output import say, warn
from push_ident.cli.units import in_unit
from push_ident.errors import InputError
from push_ident.identification.export.description import DEFAULT_HEIGHT, describe
from push_ident.identification.export.files import SUFFIXES, write_description
from push_ident.identification.results.model_file import failure_of_model, load_model

_CELLS = {"sliding": True, "fixed": False}


def export_command(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="Model file, as `identify --out DIR` writes it (DIR/model.json).", show_default=False)
    ],
    format_name: Annotated[str, typer.Option("--format", metavar="|".join(SUFFIXES), help="Gazebo, Bullet or MuJoCo.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", callback=writable_file, help="Default: beside the model.", show_default=False)
    ] = None,
    height: Annotated[
        float,
        typer.Option(
            metavar="M", parser=in_unit("m"), callback=above_zero, help="Height of the object, which pushes do not determine [m]."
        ),
    ] = DEFAULT_HEIGHT,
    cells: Annotated[
        str,
        typer.Option(metavar="|".join(_CELLS), help="sliding: each cell carries its own weight. fixed: one rigid body."),
    ] = "sliding",
) -> None:
    """Write a model for a simulator: mass and friction of every cell, and the outline for the pusher.

    SDF and URDF come with a mesh of the outline beside them. A comment in the file lists the settings that the simulator needs.
    """
    if format_name not in SUFFIXES:
        raise InputError(f"The format `{format_name}` is unknown, expected one of {', '.join(SUFFIXES)}.")
    if cells not in _CELLS:
        raise InputError(f"`--cells {cells}` is unknown, expected one of {', '.join(_CELLS)}.")
    object_id, posterior = load_model(model)
    path = out or model.with_suffix(SUFFIXES[format_name])
    if os.path.exists(path) and os.path.samefile(path, model):
        raise InputError(f"{path} is the model itself; name another file with --out.")
    if failure := failure_of_model(model):
        warn(f"! the model is only the prior: {failure}")
    thing = describe(
        posterior.model, object_id=object_id, source=model.name, height=height, sliding=_CELLS[cells], effects=posterior.effects
    )
    for file in write_description(path, thing, format_name):
        say(f"written {file}")
    if thing.effects:
        text = f"note: the model has effects ({', '.join(thing.effects)}); a comment in the file lists those that it contains"
        say(text)
    if not posterior.total_mass_identifiable:
        text = f"note: the total mass, {posterior.total_mass.value:.3g} kg, is the nominal one: pushes alone do not determine it"
        say(text)
