"""Figures of pages as SVG that follow the page: its colours, also in the dark, and text that stays readable on a telephone.

A figure is at most as wide as a telephone in units of CSS pixels, and is scaled little; wide pages place figures beside one another.
Every mark has a `<title>`: browsers show it under the pointer, and screen readers read it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np

from push_ident.limits import printable
from push_ident.types import Float64Array

VIRIDIS: Final = ("#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725")
"""Ends and steps of a scale that is as bright as its value, also for colour-blind readers (after matplotlib's viridis)."""
BLUES: Final = ("#f4f7fb", "#c6d6e8", "#8fb0d4", "#4f83bb", "#1f5fa8", "#123a68")
"""White to blue: from known to unknown."""
HEAT: Final = ("#fff7e0", "#fdd68a", "#f6a14d", "#e3652f", "#b62a1f")
"""Light to red: from expected to large."""

WIDTH: Final = 320.0
"""Of every figure [units of the drawing]; a telephone is 360 to 430 CSS pixels wide."""
MARGIN: Final = 10.0
"""Around a drawing, in its units."""
SCALE: Final = 34.0
"""Height of the scale, or the bar of length, under a map."""
HEAD: Final = 24.0
"""Height of the name of the vertical axis of a chart."""
FOOT: Final = 38.0
"""Height of labels and name of the horizontal axis."""


@dataclass(frozen=True, slots=True)
class Arrow:
    """A push on a map of cells [m]."""

    start: Float64Array
    end: Float64Array
    radius: float
    """Of the pusher."""


@dataclass(frozen=True, slots=True)
class CellPanel:
    """A map of cells; lengths in metres, object frame."""

    title: str
    """What the figure shows."""
    centres: Float64Array
    """Shape (n_cells, 2)."""
    cells: Sequence[Sequence[Float64Array]]
    """Closed lines around each cell, each shape (n, 2)."""
    outline: Float64Array
    """Shape (n_vertices, 2)."""
    values: Float64Array
    """Of each cell, shape (n_cells,); without cells only the outline is drawn."""
    unit: str
    colours: tuple[str, ...] = VIRIDIS
    region: Float64Array | None = None
    """A closed line to mark, such as the 90 % region of a centre, shape (n, 2)."""
    arrow: Arrow | None = None
    top: float | None = None
    """Value of the last colour, where maps are compared; None: the largest of these values."""


@dataclass(frozen=True, slots=True)
class Series:
    """One kind of mark of a chart of rows."""

    name: str
    style: str
    """`dot`, `ring` or `tick`."""
    colour: str
    """Of CSS."""


@dataclass(frozen=True, slots=True)
class Mark:
    """One value in a row."""

    series: int
    """Its place among the series."""
    value: float
    """NaN: nothing is drawn."""
    text: str
    """Shown under the pointer."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a chart."""

    label: str
    marks: tuple[Mark, ...]
    bar: float = 0.0
    """Length of a bar from zero; 0: none."""
    colour: str = "var(--bar, #9fb8d6)"
    """Of the bar."""


def shade(share: float, colours: Sequence[str]) -> str:
    """Colour at `share` (0 to 1) of a scale; values that are not finite are grey."""
    if not math.isfinite(share):
        return "#b0b0b0"
    at = min(max(share, 0.0), 1.0) * (len(colours) - 1)
    low = min(int(at), len(colours) - 2)
    ends = [[int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in colours[low : low + 2]]
    return "#" + "".join(f"{round(a + (at - low) * (b - a)):02x}" for a, b in zip(*ends, strict=True))


def text_on(colour: str) -> str:
    """Black or white, whichever is easier to read on a colour (relative luminance of WCAG 2, without its gamma)."""
    red, green, blue = (int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return "#000000" if 0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.45 else "#ffffff"


def cell_panel(panel: CellPanel) -> str:
    """A map of cells with its scale and a bar of length, in millimetres."""
    extra = [] if panel.arrow is None else [panel.arrow.start - panel.arrow.radius, panel.arrow.start + panel.arrow.radius, panel.arrow.end]
    points = np.vstack([panel.outline, *extra])
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (WIDTH - 2 * MARGIN) / float(max(high[0] - low[0], 0.6 * (high[1] - low[1])))
    height = scale * float(high[1] - low[1]) + 2 * MARGIN + SCALE
    left = 0.5 * (WIDTH - scale * float(high[0] - low[0]))

    def place(point: Float64Array) -> tuple[float, float]:
        return left + scale * float(point[0] - low[0]), MARGIN + scale * float(high[1] - point[1])

    bottom, top = float(np.nanmin([0.0, *panel.values])), float(np.nanmax([0.0, *panel.values]))
    top = top if panel.top is None else panel.top
    parts = []
    for number, (centre, lines, value) in enumerate(zip(panel.centres, panel.cells, panel.values, strict=True), 1):
        path = "".join("M" + " ".join(f"{x:.1f},{y:.1f}" for x, y in map(place, line)) + "Z" for line in lines)
        colour = shade((float(value) - bottom) / (top - bottom or 1.0), panel.colours)
        at = f"({1e3 * centre[0]:.0f}, {1e3 * centre[1]:.0f}) mm"
        parts.append(
            f'<path class="cell" d="{path}" fill="{colour}">'
            f"<title>{clean(f'cell {number} at {at}: {value:.3g} {panel.unit}')}</title></path>"
        )
    parts.append(titled_polygon(panel.outline, place, "outline"))
    if panel.region is not None:
        parts.append(titled_polygon(panel.region, place, "region"))
    if panel.arrow is not None:
        parts += _arrow(panel.arrow, place, scale)
    if len(panel.values):
        parts += _scale_of_colours(panel, bottom, top, height - SCALE + 12)
    parts += bar_of_length(scale, height - SCALE + 12)
    return svg_of(panel.title, height, parts)


def field_panel(title: str, points: Float64Array, vectors: Float64Array, factor: float, frame: Float64Array) -> str:
    """Small displacements [m], shape (n, 2), at points of the table [m], shape (n, 2), drawn `factor` times as long, in millimetres.

    `frame`: positions that the drawing has room for [m], shape (m, 2).
    """
    ends, low, high = points + factor * vectors, frame.min(axis=0), frame.max(axis=0)
    scale = (WIDTH - 2 * MARGIN) / max(float(np.max(high - low)), 1e-6)
    height = scale * float(high[1] - low[1]) + 2 * MARGIN + SCALE

    def place(point: Float64Array) -> tuple[float, float]:
        return MARGIN + scale * float(point[0] - low[0]), MARGIN + scale * float(high[1] - point[1])

    parts = []
    for start, end, vector in zip(points, ends, vectors, strict=True):
        (x, y), (to_x, to_y) = place(start), place(end)
        parts.append(
            f"<g><title>{1e3 * float(np.linalg.norm(vector)):.1f} mm at ({1e3 * start[0]:.0f}, {1e3 * start[1]:.0f}) mm</title>"
            f'<circle class="at" cx="{x:.1f}" cy="{y:.1f}" r="1.6"/>'
            f'<line class="vector" x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}"/></g>'
        )
    parts += bar_of_length(scale, height - SCALE + 12)
    return svg_of(title, height, parts)


def titled_polygon(
    points: Float64Array, place: Callable[[Float64Array], tuple[float, float]], style: str, text: str = "", *, closed: bool = True
) -> str:
    """A line through points [m], shape (n, 2), with its name, or without one.

    `place`: from metres to units of the drawing; `style`: class of the page's styles; `text`: shown under the pointer; `closed`: whether it
    ends where it begins.
    """
    where = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(point) for point in points))
    shape = "polygon" if closed else "polyline"
    return f'<{shape} class="{style}" points="{where}"' + (f"><title>{clean(text)}</title></{shape}>" if text else "/>")


def _arrow(arrow: Arrow, place: Callable[[Float64Array], tuple[float, float]], scale: float) -> list[str]:
    (x, y), (to_x, to_y) = place(arrow.start), place(arrow.end)
    angle = math.degrees(math.atan2(to_y - y, to_x - x))
    radius = max(2.0, scale * arrow.radius)
    return [
        f'<circle class="pusher" cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}"><title>pusher before the push</title></circle>',
        f'<line class="pusher" x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}"/>',
        f'<path class="tip" d="M0,0 L-10,-4.5 L-10,4.5 Z" transform="translate({to_x:.1f},{to_y:.1f}) rotate({angle:.1f})"/>',
    ]


def _scale_of_colours(panel: CellPanel, low: float, high: float, y: float) -> list[str]:
    """A strip of colours between its least and its largest value."""
    steps, x, width = 24, MARGIN, 130.0
    strip = [
        f'<rect x="{x + i * width / steps:.1f}" y="{y:.1f}" width="{width / steps + 0.5:.1f}" height="7" '
        f'fill="{shade((i + 0.5) / steps, panel.colours)}"/>'
        for i in range(steps)
    ]
    return [
        *strip,
        f'<text x="{x:.1f}" y="{y + 19:.1f}">{low:.3g}</text>',
        f'<text x="{x + width:.1f}" y="{y + 19:.1f}" text-anchor="end">{clean(f"{high:.3g} {panel.unit}".rstrip())}</text>',
    ]


def bar_of_length(scale: float, y: float) -> list[str]:
    """A round length of about a quarter of the figure, at the height `y`; `scale` is in units of the drawing per metre."""
    length = round_below(0.25 * WIDTH / scale * 1e3)
    right, left = WIDTH - MARGIN, WIDTH - MARGIN - scale * 1e-3 * length
    return [
        f'<line class="axis" x1="{left:.1f}" y1="{y + 4:.1f}" x2="{right:.1f}" y2="{y + 4:.1f}"/>',
        f'<text x="{right:.1f}" y="{y + 19:.1f}" text-anchor="end">{length:g} mm</text>',
    ]


def row_chart(title: str, rows: Sequence[Row], series: Sequence[Series], unit: str, *, axis: str, limit: float | None = None) -> str:
    """Values in rows, from top to bottom, over one horizontal axis that begins at zero; `series` are in the legend, `limit` is a dashed
    line.
    """
    values = [mark.value for row in rows for mark in row.marks if math.isfinite(mark.value)] + [row.bar for row in rows]
    top = max([*values, *([limit] if limit else []), 1e-9]) * 1.05
    labels, letters, row_height = 92.0, 15, 20.0  # width of the labels of rows, and the letters for which they have room
    width = WIDTH - labels - 2 * MARGIN
    legend = _legend(series)
    first = MARGIN + 16.0 * len(legend)
    bottom = first + row_height * len(rows)

    def x_of(value: float) -> float:
        return labels + MARGIN + width * max(0.0, value) / top

    parts = [f'<g transform="translate(0,{MARGIN + 16.0 * y:.1f})">{"".join(lines)}</g>' for y, lines in enumerate(legend)]
    step = round_below(top / 4) or top
    for k in range(int(top / step) + 1):
        x = x_of(k * step)
        parts.append(f'<line class="grid" x1="{x:.1f}" y1="{first:.1f}" x2="{x:.1f}" y2="{bottom:.1f}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 14:.1f}" text-anchor="middle">{k * step:g}</text>')
    if limit is not None:
        parts.append(f'<line class="limit" x1="{x_of(limit):.1f}" y1="{first:.1f}" x2="{x_of(limit):.1f}" y2="{bottom:.1f}"/>')
    for number, row in enumerate(rows):
        y = first + row_height * (number + 0.5)
        label = row.label if len(row.label) <= letters else row.label[: letters - 1] + "…"
        parts.append(f'<text x="{labels:.1f}" y="{y + 4:.1f}" text-anchor="end">{clean(label)}<title>{clean(row.label)}</title></text>')
        if row.bar > 0:
            length = x_of(row.bar) - x_of(0.0)
            parts.append(f'<rect x="{x_of(0):.1f}" y="{y - 6:.1f}" width="{length:.1f}" height="12" style="fill:{row.colour}"/>')
        parts += [_mark(series[m.series], x_of(m.value), y, m.text) for m in row.marks if math.isfinite(m.value)]
    parts.append(
        f'<text x="{WIDTH - MARGIN:.1f}" y="{bottom + 30:.1f}" text-anchor="end">{clean(f"{axis} [{unit}]" if unit else axis)}</text>'
    )
    return svg_of(title, bottom + FOOT, parts)


def _legend(series: Sequence[Series]) -> list[list[str]]:
    """One line for each kind of mark."""
    return [[_mark(one, MARGIN + 6, 4.0, one.name), f'<text x="{MARGIN + 18:.1f}" y="8">{clean(one.name)}</text>'] for one in series]


def _mark(series: Series, x: float, y: float, text: str) -> str:
    title, colour = f"<title>{clean(text)}</title>", series.colour
    if series.style == "tick":
        return f'<rect x="{x - 1.2:.1f}" y="{y - 6:.1f}" width="2.4" height="12" style="fill:{colour}">{title}</rect>'
    filled = f"fill:{colour}" if series.style == "dot" else f"fill:none;stroke:{colour};stroke-width:1.6"
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.2" style="{filled}">{title}</circle>'


def round_below(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `value`."""
    if not value > 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))


def svg_of(title: str, height: float, parts: Sequence[str]) -> str:
    """A whole figure of its parts; `height` in units of the drawing, of which it is `WIDTH` wide."""
    body = "".join(parts)
    return (
        f'<svg class="chart" role="img" viewBox="0 0 {WIDTH:g} {height:.0f}" xmlns="http://www.w3.org/2000/svg" font-size="12">'
        f"<title>{clean(title)}</title>{body}</svg>"
    )


def clean(text: str) -> str:
    """Foreign text as that of an element."""
    return escape(printable(text))
