"""Pairs of values over logarithmic axes, as SVG that follows the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from push_ident.pages.chart import FOOT, HEAD, MARGIN, WIDTH, clean, svg_of


@dataclass(frozen=True, slots=True)
class Dot:
    """One pair of values, above zero."""

    x: float
    y: float
    text: str
    """Shown under the pointer."""


def scatter(title: str, dots: Sequence[Dot], *, x_axis: str, y_axis: str) -> str:
    """Dots over two logarithmic axes of one range, with a dashed line where both values are equal.

    Dots with a value that is not finite and above zero are left out.
    """
    shown = [dot for dot in dots if 0 < dot.x < math.inf and 0 < dot.y < math.inf]
    values = [value for dot in shown for value in (dot.x, dot.y)] or [1.0]
    low, high = math.log10(min(values) / 1.25), math.log10(max(values) * 1.25)
    left = 34.0  # for labels of the vertical axis
    side = WIDTH - left - 2 * MARGIN
    bottom = HEAD + side

    def at(value: float) -> float:
        return side * (math.log10(value) - low) / (high - low)

    parts = [f'<text x="{MARGIN:.1f}" y="14">{clean(y_axis)}</text>']
    for tick in _ticks(low, high):
        x, y = left + at(tick), bottom - at(tick)
        parts += [
            f'<line class="grid" x1="{x:.1f}" y1="{HEAD:.1f}" x2="{x:.1f}" y2="{bottom:.1f}"/>',
            f'<line class="grid" x1="{left:.1f}" y1="{y:.1f}" x2="{left + side:.1f}" y2="{y:.1f}"/>',
            f'<text x="{x:.1f}" y="{bottom + 15:.1f}" text-anchor="middle">{tick:g}</text>',
            f'<text x="{left - 6:.1f}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>',
        ]
    parts.append(f'<line class="limit" x1="{left:.1f}" y1="{bottom:.1f}" x2="{left + side:.1f}" y2="{HEAD:.1f}"/>')
    parts += [
        f'<circle cx="{left + at(dot.x):.1f}" cy="{bottom - at(dot.y):.1f}" r="4.2" style="fill:var(--accent);fill-opacity:.75">'
        f"<title>{clean(dot.text)}</title></circle>"
        for dot in shown
    ]
    parts.append(f'<text x="{left + side:.1f}" y="{bottom + 32:.1f}" text-anchor="end">{clean(x_axis)}</text>')
    return svg_of(title, bottom + FOOT, parts)


def _ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten between two decimal logarithms; only the powers where they span more than two decades."""
    steps = (1, 2, 5) if high - low <= 2 else (1,)
    every = [step * 10.0**power for power in range(math.floor(low), math.ceil(high) + 1) for step in steps]
    return [tick for tick in every if low <= math.log10(tick) <= high]
