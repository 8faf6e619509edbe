"""`push-ident export`: a model as a description for a simulator."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from push_ident.cli.checks import above_zero, writable_file
from push_ident.cli.output import say, warn, write_json
from push_ident.cli.units import in_unit
from push_ident.errors import InputError
from push_ident.identification.export.description import DEFAULT_HEIGHT, ObjectDescription, describe
from push_ident.identification.export.files import SUFFIXES, write_description, write_samples
from push_ident.identification.export.samples import drawn_objects, ranges
from push_ident.identification.results.model_file import failure_of_model, load_model
from push_ident.identification.results.posterior import ModelPosterior

_CELLS = {"sliding": True, "fixed": False}
_HeightOption = Annotated[
    float,
    typer.Option(metavar="M", parser=in_unit("m"), callback=above_zero, help="Height of the object, which pushes do not determine [m]."),
]
_SamplesOption = Annotated[
    int | None,
    typer.Option(metavar="N", min=1, help="Write so many objects that the pushes allow, instead of the mean one.", show_default=False),
]
_RangesOption = Annotated[
    Path | None,
    typer.Option(
        "--ranges", metavar="FILE", callback=writable_file, help="Write what is known of each quantity, as JSON.", show_default=False
    ),
]


def export_command(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="Model file, as `identify --out DIR` writes it (DIR/model.json).", show_default=False)
    ],
    format_name: Annotated[
        str, typer.Option("--format", metavar="|".join(SUFFIXES), help="Gazebo, Bullet or MuJoCo.", show_default=False)
    ] = "",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="PATH",
            callback=writable_file,
            help="File, or folder of samples; default: beside MODEL.",
            show_default=False,
        ),
    ] = None,
    height: _HeightOption = DEFAULT_HEIGHT,
    cells: Annotated[
        str,
        typer.Option(metavar="|".join(_CELLS), help="sliding: each cell carries its own weight. fixed: one rigid body."),
    ] = "sliding",
    samples: _SamplesOption = None,
    ranges_file: _RangesOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the samples and the ranges.")] = 0,
) -> None:
    """Write a model for a simulator: mass and friction of every cell, and the outline for the pusher.

    SDF and URDF come with a mesh of the outline beside them. A comment in the file lists the settings that the simulator needs. For domain
    randomisation, `--samples` draws objects from the posterior, total mass and effects included; `--ranges` has mean, standard deviation,
    90 % range and correlations of total mass, centres, inertia, frictions and effects.
    """
    if not format_name and (ranges_file is None or samples is not None):
        raise InputError(f"There is nothing to write: give --format with one of {', '.join(SUFFIXES)}, or --ranges FILE alone.")
    if format_name and format_name not in SUFFIXES:
        raise InputError(f"The format `{format_name}` is unknown, expected one of {', '.join(SUFFIXES)}.")
    if cells not in _CELLS:
        raise InputError(f"`--cells {cells}` is unknown, expected one of {', '.join(_CELLS)}.")
    if samples is None:
        writable_file(out)
    object_id, posterior = load_model(model)
    if failure := failure_of_model(model):
        warn(f"! the model is only the prior: {failure}")

    def described(one: ModelPosterior) -> ObjectDescription:
        return describe(one.model, object_id=object_id, source=model.name, height=height, sliding=_CELLS[cells], effects=one.effects)

    written = []
    if format_name:
        path = out or (model.with_suffix(SUFFIXES[format_name]) if samples is None else model.with_name(f"{model.stem}_samples"))
        _refuse_model(path, model)
        if samples is None:
            written += write_description(path, described(posterior), format_name)
        else:
            written += write_samples(path, drawn_objects(posterior, samples, seed), described, format_name)
    if ranges_file is not None:
        _refuse_model(ranges_file, model)
        write_json(ranges_file, ranges(posterior, seed).as_json())
        written.append(ranges_file)
    _report(written, posterior)


def _refuse_model(path: Path, model: Path) -> None:
    """Raise InputError where a file to write is the model."""
    if os.path.exists(path) and os.path.samefile(path, model):
        raise InputError(f"{path} is the model itself; name another file with --out.")


def _report(written: Sequence[Path], posterior: ModelPosterior, most: int = 4) -> None:
    """Name the files, and say what they lack."""
    for file in written[:most]:
        say(f"written {file}")
    if len(written) > most:
        say(f"and {len(written) - most} more, the last of them {written[-1]}")
    if names := posterior.effects.names:
        say(f"note: the model has effects ({', '.join(names)}); a comment in the file says of each whether the file contains it")
    if not posterior.total_mass_identifiable:
        say(f"note: the total mass, {posterior.total_mass.value:.3g} kg, is the nominal one: pushes alone do not determine it")
