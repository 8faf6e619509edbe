"""Figures of the diagnosis report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.next_push import SeparatingPush
from push_ident.diagnosis.residual_groups import ResidualGroup
from push_ident.diagnosis.residuals import FrameResiduals
from push_ident.diagnosis.selection import Selection
from push_ident.geometry.se2 import transform_points
from push_ident.pages.page import figure_text
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array, ObjectShape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_proposal", "draw_ranking", "draw_shrink", "draw_where"]

_ACCENT, _ACCENT_LIGHT, _GREY, _WARM, _INK = "#1f5fa8", "#6f8fb5", "#9aa5b1", "#c0561d", "#1c2430"
_EXAGGERATION = 10.0
"""Factor on the arrows on the table."""
_N_RANKED = 12
_BOLD_P_VALUE = 0.01
"""Residuals with a smaller p-value are printed in bold."""
_N_SECTORS = 8


def draw_where(frames: FrameResiduals, groups: dict[str, list[ResidualGroup]]) -> Figure:
    """Heat table by push, arrows on the table, polar plots by heading."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 3.9), layout="constrained")
    _draw_heat_table(figure.add_subplot(1, 4, 1), groups["push"])
    _draw_arrows(figure.add_subplot(1, 4, 2), frames)
    limit = max(2.0, float(np.abs(frames.standardized).mean()) * 2)
    for place, (name, heading) in enumerate((("table", frames.heading_in_table), ("object", frames.heading_in_object))):
        polar = figure.add_subplot(1, 4, 3 + place, projection="polar", rlabel_position=22.5)
        _draw_by_heading(polar, frames, heading)
        polar.set_ylim(-limit, limit)
        polar.set_yticks([0.0, limit], ["0", f"{limit:.0f}"])
        polar.set_title(f"heading in the {name}", fontsize=9)
        polar.tick_params(labelsize=7)
        if place == 1:
            polar.legend(fontsize=7, loc="lower right", bbox_to_anchor=(1.3, -0.15))
    return figure


def _draw_heat_table(ax: Axes, pushes: list[ResidualGroup]) -> None:
    values = np.array([g.rms for g in pushes])
    image = ax.imshow(values, cmap="YlOrRd", vmin=0.0, vmax=max(3.0, float(values.max())), aspect="auto")
    ax.set_xticks(range(3), ["along", "across", "rotation"])
    ax.set_yticks(range(len(pushes)), [g.name for g in pushes])
    ax.set_ylabel("push")
    for (row, column), value in np.ndenumerate(values):
        bold = pushes[row].p_value[column] < _BOLD_P_VALUE
        ax.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=7, fontweight="bold" if bold else "normal")
    ax.figure.colorbar(image, ax=ax, shrink=0.7)


def _draw_arrows(ax: Axes, frames: FrameResiduals) -> None:
    cos, sin = np.cos(frames.heading_in_table), np.sin(frames.heading_in_table)
    along, across = frames.difference[:, 0], frames.difference[:, 1]
    quiver = ax.quiver(
        frames.position[:, 0],
        frames.position[:, 1],
        _EXAGGERATION * (cos * along - sin * across),
        _EXAGGERATION * (sin * along + cos * across),
        frames.speed,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.006,
        cmap="viridis",
    )
    ax.set_aspect("equal")
    ax.margins(0.2)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.figure.colorbar(quiver, ax=ax, shrink=0.7, label="speed [m/s]")


def _draw_by_heading(polar: Axes, frames: FrameResiduals, heading: Float64Array) -> None:
    sectors = range(_N_SECTORS)
    sector = np.round(heading / (2 * np.pi / _N_SECTORS)).astype(int) % _N_SECTORS
    for column, (label, colour) in enumerate((("along", _ACCENT), ("across", _WARM))):
        mean = [float(np.mean(frames.standardized[sector == s, column])) if np.any(sector == s) else 0.0 for s in sectors]
        angles = np.arange(_N_SECTORS + 1) * (2 * np.pi / _N_SECTORS)
        polar.plot(angles, [*mean, mean[0]], color=colour, label=label, marker=".")


def draw_ranking(selection: Selection, min_log_bayes_factor: float, *, figure: Figure | None = None) -> Figure:
    """Log Bayes factors of the effects beside the base model."""
    from matplotlib.figure import Figure

    first = selection.steps[0]
    refitted = {c.name: c.log_bayes_factor for c in first.candidates}
    values = {s.name: refitted.get(s.name, s.expected_log_bayes_factor) for s in first.scores}
    ranked = sorted(first.scores, key=lambda s: -values[s.name])[:_N_RANKED]
    figure = figure or Figure(figsize=(9.0, 0.32 * len(ranked) + 0.9), layout="constrained")
    ax = figure.subplots()
    colours = [_colour(name, values[name] >= min_log_bayes_factor, selection) for name in (s.name for s in ranked)]
    ax.barh([figure_text(s.name) for s in ranked], np.maximum([values[s.name] for s in ranked], 0.0), color=colours)
    ax.invert_yaxis()
    ax.axvline(min_log_bayes_factor, color="black", linewidth=0.8, linestyle="--")
    right = max(max(values[s.name] for s in ranked), 2 * min_log_bayes_factor)
    for row, score in enumerate(ranked):
        value, is_detected = values[score.name], values[score.name] >= min_log_bayes_factor
        unit = EFFECTS[score.name].parameters[0].unit
        size = f"{score.smallest_detectable:.2g} {unit}".rstrip()
        smallest = f"detectable from {size}" if np.isfinite(score.smallest_detectable) else "not detectable at any size"
        # Beside the line, not across it.
        place = (value if is_detected else min_log_bayes_factor) + 0.01 * right
        text, colour = (f"{value:.1f}", "#333333") if is_detected else (f"not detected; {smallest}", _GREY)
        ax.text(place, row, text, va="center", fontsize=8, color=colour)
    ax.set_xlim(0.0, 1.3 * right)
    ax.set_xlabel("log Bayes factor [nat]")
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def _colour(name: str, is_detected: bool, selection: Selection) -> str:
    if name in selection.found:
        return _ACCENT
    return _ACCENT_LIGHT if is_detected else _GREY


def draw_shrink(gap: Gap, found: tuple[str, ...]) -> Figure:
    """Cell error on held-out pushes: base model, with one effect more each, noise. Every push is a dot; dotted lines show the column
    before."""
    from matplotlib.figure import Figure

    stages = [("base model", gap.before, _GREY), *(("with " + name, errors, _ACCENT_LIGHT) for name, errors in gap.stages.items())]
    if found:
        stages.append(("with " + ",\n".join(found), gap.after, _ACCENT))
    columns = [*stages, ("pose noise", gap.noise, "#c9d1d9")]
    figure = Figure(figsize=(1.6 + 1.6 * len(columns), 3.2), layout="constrained")
    ax = figure.subplots()
    rng = np.random.default_rng(0)
    means = [1e3 * float(np.mean(errors)) for _, errors, _ in columns]
    for place, (_, errors, colour) in enumerate(columns):
        ax.bar(place, means[place], width=0.55, color=colour)
        if place > 0:
            # The mean of the column before, as in a waterfall.
            ax.plot([place - 0.725, place + 0.275], [means[place - 1]] * 2, color=_INK, linewidth=0.8, linestyle=":")
        ax.plot(
            place + rng.uniform(-0.15, 0.15, len(errors)),
            1e3 * errors,
            linestyle="none",
            marker="o",
            markersize=3.5,
            color=_INK,
            alpha=0.6,
        )
    ax.set_xticks(range(len(columns)), [f"{name}\n{mean:.1f} mm" for (name, _, _), mean in zip(columns, means, strict=True)])
    ax.set_ylabel("cell error at the end [mm]")
    ax.set_ylim(bottom=0.0)
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def draw_proposal(proposal: SeparatingPush, shape: ObjectShape) -> Figure:
    """The push on the object where it lies."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Polygon

    figure = Figure(figsize=(4.4, 3.4), layout="constrained")
    ax = figure.subplots()
    plan, pusher = proposal.push.plan, proposal.push.pusher
    ax.add_patch(Polygon(transform_points(proposal.push.pose_object_in_table, shape.outline), facecolor="#dfe4ea", edgecolor="black"))
    if plan is not None:
        start = plan.tool_start(0.0)
        ax.add_patch(Circle((float(start[0]), float(start[1])), pusher.radius, fill=False, edgecolor=_ACCENT, linewidth=1.5))
        end = start + plan.distance * plan.heading
        arrow = {"arrowstyle": "-|>", "color": _ACCENT, "lw": 2.0}
        ax.annotate("", xy=(float(end[0]), float(end[1])), xytext=(float(start[0]), float(start[1])), arrowprops=arrow)
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.margins(0.1)
    ax.set_xlabel("x of the table [m]")
    ax.set_ylabel("y [m]")
    return figure
