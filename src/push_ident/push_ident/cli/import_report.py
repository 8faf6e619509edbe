"""What every import prints, and its picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from push_ident.bags.importers import ImportReport
from push_ident.bags.importers.overlap import Overlap
from push_ident.cli.checks import new_bag
from push_ident.cli.output import console, warn, write_json

__all__ = ["BagOption", "draw_import", "show_import"]

BagOption = Annotated[Path, typer.Option("--out", metavar="BAG", help="New bag.", callback=new_bag, show_default=False)]


def draw_import(overlap: Overlap | None, out: Path, picture: Path | None) -> None:
    """Draw pusher and object while the object moves, by default beside the bag `out`, and say where the picture is."""
    from push_ident.bags.importers.overlap_picture import draw_overlap

    if overlap is None:
        return
    file = out.with_name(f"{out.stem}_overlap.png") if picture is None else picture
    draw_overlap(file, overlap)
    console.print(f"picture of pusher and object: {file}", highlight=False, soft_wrap=True)


def show_import(report: ImportReport, json: Path | None) -> None:
    """Print what was imported, with notes and warnings; write it as JSON."""
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
                "miss_m": None if report.overlap is None else report.overlap.miss,
                "causes": [] if report.overlap is None else [cause.text for cause in report.overlap.causes],
                "notes": list(report.notes),
                "warnings": list(report.warnings),
            },
        )
