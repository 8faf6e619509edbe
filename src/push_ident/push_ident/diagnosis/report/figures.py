"""Figures of the diagnosis report: drawings as SVG, tables and bars as values for the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.next_push import SeparatingPush
from push_ident.diagnosis.residual_groups import N_SECTORS, ResidualGroup
from push_ident.diagnosis.residuals import FrameResiduals
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.wording import detectable_size, in_mm
from push_ident.geometry.se2 import transform_points
from push_ident.pages.chart import HEAT, Arrow, CellPanel, cell_panel, field_panel, shade, text_on
from push_ident.types import Float64Array, ObjectShape

__all__ = ["EXAGGERATION", "Bar", "HeatCell", "HeatRow", "draw_proposal", "draw_residuals", "heat_of_headings", "heat_of_pushes",
           "ranking_bars", "shrink_bars"]  # fmt: skip

EXAGGERATION = 10.0
"""Factor on the residuals that are drawn on the table."""


@dataclass(frozen=True, slots=True)
class HeatCell:
    """A number on a coloured ground."""

    text: str
    colour: str
    ink: str
    """Colour of the text."""
    bold: bool = False


@dataclass(frozen=True, slots=True)
class HeatRow:
    """One line of a table of such numbers."""

    name: str
    cells: tuple[HeatCell, ...]


@dataclass(frozen=True, slots=True)
class Bar:
    """A bar with its name and its value; positions are in percent of the width."""

    name: str
    text: str
    """The value, or why there is none."""
    width: float
    highlighted: bool = False
    """Whether it stands out."""
    dots: tuple[float, ...] = ()
    """Of single pushes."""


def heat_of_pushes(pushes: Sequence[ResidualGroup]) -> list[HeatRow]:
    """Root mean square of the standardized residuals in every push, along, across and in rotation.

    Pushes are counted from 1; what noise makes in one of a hundred is printed in bold.
    """
    return [
        HeatRow(
            f"{int(push.name) + 1}",
            tuple(_heat(f"{value:.1f}", value - 1.0, p < 0.01) for value, p in zip(push.rms, push.p_value, strict=True)),
        )
        for push in pushes
    ]


def heat_of_headings(frames: FrameResiduals) -> list[HeatRow]:
    """Mean standardized residual along and across the motion by its heading in the table and in the object."""
    rows = []
    sectors = [
        np.round(heading / (2 * np.pi / N_SECTORS)).astype(int) % N_SECTORS
        for heading in (frames.heading_in_table, frames.heading_in_object)
    ]
    for k in range(N_SECTORS):
        values = [
            float(np.mean(frames.standardized[sector == k, column])) if np.any(sector == k) else np.nan
            for sector in sectors
            for column in (0, 1)
        ]
        cells = (_heat(_signed(value), abs(value)) for value in values)
        rows.append(HeatRow(f"{360 * k // N_SECTORS}°", tuple(cells)))
    return rows


def _signed(value: float) -> str:
    text = f"{value:+.1f}"
    return "–" if not np.isfinite(value) else "0.0" if text in ("+0.0", "-0.0") else text


def _heat(text: str, value: float, bold: bool = False) -> HeatCell:
    # The strongest colour is that of three times the noise.
    colour = shade(value / 3.0, HEAT) if np.isfinite(value) else "#e3e6ea"
    return HeatCell(text, colour, text_on(colour), bold)


def draw_residuals(frames: FrameResiduals) -> str:
    """Observed minus simulated position at every frame, on the table."""
    cos, sin = np.cos(frames.heading_in_table), np.sin(frames.heading_in_table)
    along, across = frames.difference[:, 0], frames.difference[:, 1]
    vectors = np.column_stack([cos * along - sin * across, sin * along + cos * across])
    return field_panel("Observed minus simulated position on the table", frames.position, vectors, EXAGGERATION)


def ranking_bars(selection: Selection, min_log_bayes_factor: float) -> tuple[list[Bar], float]:
    """Log Bayes factors of the effects beside the base model, the largest first, and the position of the least one that counts."""
    first = selection.steps[0]
    refitted = {c.name: c.log_bayes_factor for c in first.candidates}
    values = {s.name: refitted.get(s.name, s.expected_log_bayes_factor) for s in first.scores}
    ranked = sorted(first.scores, key=lambda s: -values[s.name])[:12]
    right = max(*(values[s.name] for s in ranked), 2 * min_log_bayes_factor)
    bars = []
    for score in ranked:
        value = values[score.name]
        size = detectable_size(score)
        quiet = f"not detected; would be from {size} on" if size else "not detected; not detectable at any size"
        text = f"{value:.1f}" if value >= min_log_bayes_factor else quiet
        bars.append(Bar(score.name, text, 100.0 * max(0.0, value) / right, score.name in selection.selected))
    return bars, 100.0 * min_log_bayes_factor / right


def shrink_bars(gap: Gap, selected: Sequence[str]) -> list[Bar]:
    """Cell error on held-out pushes: base model, with one effect more each, noise of the poses. Every push is a dot."""
    stages = [("base model", gap.before), *(("with " + name, errors) for name, errors in gap.stages.items())]
    if selected:
        stages.append(("with " + ", ".join(selected), gap.after))
    right = 1.03 * max(float(np.max(errors)) for _, errors in (*stages, ("", gap.noise))) or 1.0
    last = len(stages) - 1 if selected else -1
    return [
        Bar(name, in_mm(float(np.mean(errors))), 100.0 * float(np.mean(errors)) / right, k == last, _dots(errors, right))
        for k, (name, errors) in enumerate((*stages, ("noise of the poses alone", gap.noise)))
    ]


def _dots(errors: Float64Array, right: float) -> tuple[float, ...]:
    return tuple(100.0 * float(error) / right for error in errors)


def draw_proposal(proposal: SeparatingPush, shape: ObjectShape) -> str:
    """The push on the object where it lies."""
    plan = proposal.push.plan
    arrow = None
    if plan is not None:
        start = plan.tool_start(0.0)
        arrow = Arrow(start, start + plan.distance * plan.heading, proposal.push.pusher.radius)
    outline = transform_points(proposal.push.pose_object_in_table, shape.outline)
    return cell_panel(CellPanel("Next push on the table", np.empty((0, 2)), shape.cells.size, outline, np.empty(0), "", arrow=arrow))
