"""Lines over time, as SVG that follows the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.pages.chart import FOOT, HEAD, MARGIN, WIDTH, clean, round_below, svg_of
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class Line:
    """One line."""

    x: Float64Array
    """Shape (n,)."""
    y: Float64Array
    """Shape (n,)."""
    style: str
    """`trace` or `missed`, a class of the page's styles."""
    text: str
    """Shown under the pointer."""


def time_chart(title: str, lines: Sequence[Line], *, x_axis: str, y_axis: str, band: float) -> str:
    """Lines, the last one on top, over a horizontal axis that begins at zero, with a band about zero in which they should stay.

    `band`: half its height, in the unit of the lines.
    """
    most = max([float(line.x.max()) for line in lines if len(line.x)], default=0.0) or 1.0
    values = np.concatenate([[-band, band], *(line.y for line in lines)])
    low, high = float(values.min()), float(values.max())
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low) or 1.0
    left, height = 40.0 + MARGIN, 190.0  # beside labels of the vertical axis
    width, bottom = WIDTH - left - MARGIN, HEAD + height

    def place(x: float, y: float) -> tuple[float, float]:
        return left + width * x / most, bottom - height * (y - low) / (high - low)

    (right, top), (_, foot) = place(most, band), place(0.0, -band)
    parts = [
        f'<text x="{MARGIN:.1f}" y="14">{clean(y_axis)}</text>',
        f'<rect class="band" x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{max(foot - top, 1.0):.1f}">'
        f"<title>{clean(f'expected: within {band:.1f} of zero')}</title></rect>",
    ]
    for tick in _ticks(low, high):
        _, y = place(0.0, tick)
        parts.append(f'<line class="grid" x1="{left:.1f}" y1="{y:.1f}" x2="{right:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{left - 6:.1f}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for tick in _ticks(0.0, most):
        x, _ = place(tick, 0.0)
        parts.append(f'<text x="{x:.1f}" y="{bottom + 15:.1f}" text-anchor="middle">{tick:g}</text>')
    for line in lines:
        where = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(float(a), float(b)) for a, b in zip(line.x, line.y, strict=True)))
        parts.append(f'<polyline class="{line.style}" points="{where}"><title>{clean(line.text)}</title></polyline>')
    parts.append(f'<text x="{right:.1f}" y="{bottom + 32:.1f}" text-anchor="end">{clean(x_axis)}</text>')
    return svg_of(title, bottom + FOOT, parts)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from `low` to `high`."""
    step = round_below((high - low) / 4) or 1.0
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
