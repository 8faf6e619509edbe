"""Outlines of an object on the table, as SVG: where it lay, where it was predicted, where it was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.pages.chart import MARGIN, SCALE, WIDTH, bar_of_length, clean, svg_of, titled_polygon
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class Placed:
    """An outline at one place."""

    corners: Float64Array
    """On the table [m], shape (n_vertices, 2); two points are a line."""
    style: str
    """A class of the page's styles, such as `before`, `predicted`, `seen` or `goal`."""
    text: str
    """Shown under the pointer."""
    closed: bool = True
    """Whether it ends where it begins."""
    label: str = ""
    """A few letters in its middle."""


def outline_panels(drawings: Sequence[tuple[str, Sequence[Placed]]]) -> list[tuple[str, str]]:
    """Title and figure of each drawing, all of one scale."""
    corners = np.vstack([one.corners for _, placed in drawings for one in placed])
    frame = np.array([corners.min(axis=0), corners.max(axis=0)])
    return [(title, outline_panel(title, placed, frame)) for title, placed in drawings]


def outline_panel(title: str, placed: Sequence[Placed], frame: Float64Array) -> str:
    """Outlines from above, the first one lowest, with a bar of length.

    `frame`: least and largest corner that is shown [m], shape (2, 2); the same for figures that are compared.
    """
    low, high = frame
    scale = (WIDTH - 2 * MARGIN) / float(max(high[0] - low[0], high[1] - low[1], 1e-6))
    left = 0.5 * (WIDTH - scale * float(high[0] - low[0]))
    height = scale * float(high[1] - low[1]) + 2 * MARGIN + SCALE

    def place(point: Float64Array) -> tuple[float, float]:
        return left + scale * float(point[0] - low[0]), MARGIN + scale * float(high[1] - point[1])

    parts = [titled_polygon(one.corners, place, one.style, one.text, closed=one.closed) for one in placed]
    for one in placed:
        if one.label:
            x, y = place(0.5 * (one.corners.min(axis=0) + one.corners.max(axis=0)))
            parts.append(f'<text x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle">{clean(one.label)}</text>')
    return svg_of(title, height, [*parts, *bar_of_length(scale, height - SCALE + 12)])
