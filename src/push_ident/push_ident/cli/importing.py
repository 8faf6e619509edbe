"""`push-ident import`: published recordings as bags of the contract."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from push_ident.bags.importers import import_cmu_icra16, import_cmu_mocap
from push_ident.cli.output import JsonOption, console, write_json

__all__ = ["import_command"]


class Source(StrEnum):
    """Formats that have an importer."""

    cmu_icra16 = "cmu-icra16"
    cmu_mocap = "cmu-mocap"


def import_command(
    source: Annotated[Source, typer.Argument(help="Format of the recording.", show_default=False)],
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The recording as it was published.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", metavar="BAG", help="New bag.", show_default=False)],
    json: JsonOption = None,
) -> None:
    """Convert a published recording to a bag of the contract."""
    report = (import_cmu_icra16 if source is Source.cmu_icra16 else import_cmu_mocap)(file, out)
    distance = 1e3 * report.contact_distance
    console.print(
        f"{report.n_pushes} pushes written to {report.bag}; distance between pusher and outline at first contact "
        f"{np.mean(distance):.1f} ± {np.std(distance):.1f} mm",
        highlight=False,
        soft_wrap=True,
    )
    for note in report.notes:
        console.print(f"note: {note}", highlight=False, soft_wrap=True)
    if json is not None:
        write_json(
            json,
            {
                "bag": str(report.bag),
                "n_pushes": report.n_pushes,
                "contact_distance_m": report.contact_distance.tolist(),
                "supports_m": report.supports.tolist(),
                "mass": report.mass,
                "centre_of_mass_m": report.centre_of_mass.tolist(),
                "notes": list(report.notes),
            },
        )
