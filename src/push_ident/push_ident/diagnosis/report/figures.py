"""Figures of the diagnosis report: drawings as SVG; tables and bars as values for the page, positions in percent of the width."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from push_ident.diagnosis.account import Account
from push_ident.diagnosis.held_out import Gap, MotionGap
from push_ident.diagnosis.residuals import N_SECTORS, FrameResiduals, ResidualGroup
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.wording import detectable_size, in_mm
from push_ident.geometry.se2 import transform_points
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.pages.chart import HEAT, Arrow, CellPanel, cell_panel, field_panel, shade, text_on
from push_ident.types import ObjectShape

EXAGGERATION = 10.0
"""Factor on the residuals that are drawn on the table."""

_PARTS = {
    "noise": ("#c9d1d9", "noise of the poses"),
    "maps": ("#9fb8d6", "maps that are not known yet"),
    "model": ("#6f8fb5", "the model's own discrepancy"),
    "unexplained": ("#c0561d", "unexplained"),
}
"""Colour and name of the parts of an account."""
_EFFECT_COLOURS = ("#1f5fa8", "#16447a", "#0d2c50")
"""Of effects, in the order in which they were added."""


@dataclass(frozen=True, slots=True)
class Bar:
    """A bar with its name and its value."""

    name: str
    text: str
    """The value, or why there is none."""
    width: float
    highlighted: bool = False
    """Whether it stands out."""
    dots: tuple[float, ...] = ()
    """Of single pushes."""


def account_bar(account: Account) -> dict[str, Any]:
    """The account of a gap as a stacked bar of HTML and CSS: text keeps its size on a narrow screen, where a drawing would shrink.

    Parts go from left to right; a negative one leads back.
    """
    ends = np.cumsum([0.0, *(part.mean for part in account.parts)]).tolist()
    tips = [start + part.interval[1] for start, part in zip(ends, account.parts, strict=False)]
    unit = 100.0 / max(*ends[1:], *tips, 1e-9)
    effects = [part.name for part in account.effects]
    rows = []
    for part, start in zip(account.parts, ends, strict=False):
        colour, name = _PARTS.get(part.name, ("", part.name))
        if part.is_effect:
            colour = _EFFECT_COLOURS[effects.index(part.name) % len(_EFFECT_COLOURS)]
        elif part.mean < 0.0 and part.name == "unexplained":
            name = "predicted better than expected"
        low, high = part.interval
        left = max(0.0, start + low)
        rows.append(
            {
                "name": name,
                "colour": colour,
                "mean": in_mm(part.mean),
                "interval": f"{in_mm(low).removesuffix(' mm')} to {in_mm(high)}",
                "start": unit * min(start, start + part.mean),
                "width": unit * abs(part.mean),
                "low": unit * left,
                "spread": unit * (start + high - left),
                "is_negative": part.mean < 0.0,
            }
        )
    total = in_mm(account.before)
    words = ", ".join(f"{row['name']} {row['mean']}" for row in rows)
    return {"rows": rows, "total": total, "position": unit * account.before, "in_words": f"Mean error {total}: {words}"}


def heat_of_pushes(pushes: Sequence[ResidualGroup]) -> list[dict[str, Any]]:
    """Root mean square of the standardized residuals in every push, along, across and in rotation.

    Pushes are counted from 1; what noise makes in one of a hundred is printed in bold.
    """
    return [
        {"name": int(push.name) + 1, "cells": [_heat(f"{v:.1f}", v - 1.0, p < 0.01) for v, p in zip(push.rms, push.p_value, strict=True)]}
        for push in pushes
    ]


def heat_of_headings(frames: FrameResiduals) -> list[dict[str, Any]]:
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
        rows.append({"name": f"{360 * k // N_SECTORS}°", "cells": [_heat(_signed(value), abs(value)) for value in values]})
    return rows


def _signed(value: float) -> str:
    text = f"{value:+.1f}"
    return "–" if not np.isfinite(value) else "0.0" if text in ("+0.0", "-0.0") else text


def _heat(text: str, value: float, bold: bool = False) -> dict[str, Any]:
    """A number on a coloured ground, with the colour of its text."""
    # The strongest colour is that of three times the noise.
    colour = shade(value / 3.0, HEAT) if np.isfinite(value) else "#e3e6ea"
    return {"text": text, "colour": colour, "ink": text_on(colour), "bold": bold}


def draw_held_out(motion: MotionGap) -> list[tuple[str, str]]:
    """Observed minus predicted position at the end of every held-out push, on the table and by the direction of its motion: without the
    effects and, where there are some, with them. Captions and drawings."""
    drawn = [("without the effects", motion.displacement_before)]
    if motion.after is not motion.before:
        drawn.append(("with the effects", motion.displacement_after))
    vectors = np.concatenate([vectors for _, vectors in drawn])
    way = motion.end - motion.start
    direction = way / np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
    # A circle that the largest arrow does not cross.
    on_circle = EXAGGERATION * max(float(np.max(np.linalg.norm(vectors, axis=1))), 1e-4) * direction
    figures = []
    for where, points in (("on the table", motion.end), ("by the direction of the motion", on_circle)):
        frame = np.vstack([points, *(points + EXAGGERATION * vectors.reshape(len(drawn), -1, 2))])
        figures += [
            (f"{where}, {text}", field_panel(f"Held-out errors {where}, {text}", points, of_text, EXAGGERATION, frame=frame))
            for text, of_text in drawn
        ]
    return figures


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
        size = detectable_size(score.name, selection.smallest_detectable[score.name])
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
        Bar(name, in_mm(np.mean(errors)), 100.0 * float(np.mean(errors)) / right, k == last, tuple((100.0 * errors / right).tolist()))
        for k, (name, errors) in enumerate((*stages, ("noise of the poses alone", gap.noise)))
    ]


def draw_proposal(proposal: PlannedPush, shape: ObjectShape) -> str:
    """The push on the object where it lies."""
    plan = proposal.plan
    arrow = None
    if plan is not None:
        start = plan.tool_start(0.0)
        arrow = Arrow(start, start + plan.distance * plan.heading, proposal.pusher.radius)
    outline = transform_points(proposal.pose_object_in_table, shape.outline)
    return cell_panel(CellPanel("Next push on the table", np.empty((0, 2)), (), outline, np.empty(0), "", arrow=arrow))
