"""The page of a check of the calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from push_ident.calibration.check import CalibrationCheck
from push_ident.calibration.contacts import N_UNKNOWNS, gaps_of
from push_ident.calibration.wording import HEADINGS, rows_of, sentences_of
from push_ident.pages.chart import Mark, Row, Series, row_chart
from push_ident.pages.page import write_page


def write_calibration_page(path: Path, check: CalibrationCheck, *, title: str) -> None:
    """Write the page (HTML). Raises InputError where it cannot be written."""
    context = {
        "title": title,
        "sentences": sentences_of(check),
        "headings": HEADINGS,
        "rows": rows_of(check),
        "warnings": check.warnings,
        "gaps": _gaps(check),
    }
    write_page(path, __package__, "calibration.html.j2", context)


def _gaps(check: CalibrationCheck) -> str:
    series = Series("as configured", "ring", "var(--warm, #b54a12)"), Series("corrected", "dot", "var(--accent, #1f5fa8)")
    rows = []
    for contacts in check.contacts:
        sizes = [1e3 * float(np.sqrt(np.mean(gaps_of(contacts, u).gap ** 2))) for u in (np.zeros(N_UNKNOWNS), check.unknowns)]
        towards = -np.mean(gaps_of(contacts, check.unknowns).outward, axis=0)
        label = f"{contacts.record.order + 1} to {np.degrees(np.arctan2(towards[1], towards[0])):.0f}°"
        rows.append(Row(label, tuple(Mark(k, size, f"{size:.2f} mm") for k, size in enumerate(sizes))))
    return row_chart("Gap between tool and outline", rows, series, "mm", axis="gap between tool and outline")
