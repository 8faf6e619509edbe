"""The gap of somebody else's simulator on one page: what each correction removes, and every push before and after."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.pages.chart import Mark, Row, Series, row_chart
from push_ident.pages.outline_chart import Placed, outline_panel
from push_ident.pages.page import FigureSection, write_page
from push_ident.simulators.gap import SimulatorGap
from push_ident.types import Float64Array

_MOST_PUSHES: Final = 12
"""That are drawn, those with the largest error first."""
_NOTE: Final = (
    "From above, all of one scale, the largest errors first. Grey: before the push; black: the recorded end; long and short dashes: the "
    "end in the simulator as it is; even dashes: with all that it can have corrected, by fits that have not seen the push."
)


def write_gap_page(path: Path, gap: SimulatorGap, outline: Float64Array, words: Sequence[str]) -> None:
    """Write the page (HTML). `outline` of the object, shape (n_vertices, 2) [m]; `words`: what was written and what it takes.

    Raises InputError where it cannot be written.
    """
    before, after = (1e3 * float(errors.mean()) for errors in (gap.errors[0], gap.corrected))
    context = {
        "title": f"{gap.name} against {gap.errors.shape[1]} recorded pushes: {before:.1f} mm, corrected {after:.1f} mm",
        "parts": [(name, f"{1e3 * size:.1f} ± {1e3 * std:.1f} mm") for name, size, std in zip(gap.parts, gap.sizes, gap.stds, strict=True)],
        "total": f"{before:.1f} mm",
        "chart": _stages(gap),
        "section": FigureSection("The pushes in this engine, before and after", _pushes(gap, outline), _NOTE),
        "left_out": gap.left_out,
        "words": words,
    }
    write_page(path, __package__, "gap.html.j2", context)


def _stages(gap: SimulatorGap) -> str:
    """Error at each stage: single pushes, and their mean as a bar."""
    rows = []
    for name, errors in zip(gap.stages, 1e3 * gap.errors, strict=True):
        marks = tuple(Mark(0, float(error), f"push {push + 1}: {error:.1f} mm") for push, error in enumerate(errors))
        rows.append(Row(name.removeprefix("with "), marks, float(errors.mean())))
    pushes = Series("one push", "ring", "var(--ink)")
    return row_chart("Error after each correction", rows, (pushes,), "mm", axis="cell error at the end; bar: mean")


def _pushes(gap: SimulatorGap, outline: Float64Array) -> list[tuple[str, str]]:
    """Caption and drawing of pushes, the one with the largest error first."""
    drawn = []
    for push in np.argsort(-gap.errors[0])[:_MOST_PUSHES]:
        ways = [
            (gap.observed[0, push], "before", "before"),
            (gap.observed[1, push], "seen", "recorded"),
            (gap.ends[0, push], "other", "in the simulator as it is"),
            (gap.ends[1, push], "predicted", "corrected"),
        ]
        placed = [Placed(transform_points(pose, outline), style, text) for pose, style, text in ways]
        caption = f"push {push + 1}: {1e3 * gap.errors[0, push]:.1f} mm, corrected {1e3 * gap.corrected[push]:.1f} mm"
        drawn.append((caption, placed, np.vstack([one.corners for one in placed])))
    half = 0.5 * np.max([np.ptp(corners, axis=0) for *_, corners in drawn], axis=0)

    def frame(corners: Float64Array) -> Float64Array:
        middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        return np.array([middle - half, middle + half])

    return [(caption, outline_panel(caption, placed, frame(corners))) for caption, placed, corners in drawn]
