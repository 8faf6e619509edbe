"""What every import ends with: its page, lines on the console, and JSON."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from push_ident.bags.importers import ImportReport
from push_ident.bags.importers.recording import OverlapError
from push_ident.cli.checks import new_bag, writable_file
from push_ident.cli.output import console, warn, write_json
from push_ident.extras import need

__all__ = ["BagOption", "PageOption", "run_import"]

BagOption = Annotated[Path, typer.Option("--out", metavar="BAG", help="New bag.", callback=new_bag, show_default=False)]
PageOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", callback=writable_file, help="Page (HTML) about the import. Default: beside the bag.", show_default=False),
]


def run_import(importer: Callable[[], ImportReport], out: Path, source: str, page: Path | None, json: Path | None) -> None:
    """Run an importer, and show what came of it.

    Where the pusher never comes near the object, there is no bag, and the page shows where the pusher is instead.

    Args:
        importer: writes the bag.
        out: the bag.
        source: the recording, for the page.
        page: file of the page; by default beside the bag.
        json: file of the result; by default none.
    """
    need("report")
    from push_ident.bags.importers.import_page import write_import_page, write_refusal_page

    file = out.with_name(f"{out.stem}_import.html") if page is None else page
    try:
        report = importer()
    except OverlapError as error:
        write_refusal_page(file, error.overlap, str(error))
        _say_page(file)
        raise
    write_import_page(file, report, source)
    _show(report)
    _say_page(file)
    if json is not None:
        write_json(json, _content(report, file))


def _say_page(file: Path) -> None:
    console.print(f"page of the import: {file}", highlight=False, soft_wrap=True)


def _show(report: ImportReport) -> None:
    """Print what was imported, with notes and warnings."""
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
