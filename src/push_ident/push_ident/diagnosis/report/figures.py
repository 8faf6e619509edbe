"""Figures of the diagnosis report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.next_push import SeparatingPush
from push_ident.diagnosis.residuals import Frames, Group
from push_ident.diagnosis.selection import Selection
from push_ident.geometry.se2 import transform_points
from push_ident.physics.effects import EFFECTS
from push_ident.types import ObjectShape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_proposal", "draw_ranking", "draw_shrink", "draw_where"]

_ACCENT, _GREY, _WARM = "#1f5fa8", "#9aa5b1", "#c0561d"
_STRETCH = 10.0
_N_RANKED = 12
_RARE = 0.01
"""Residuals that chance would make less often stand out."""


def draw_where(frames: Frames, groups: dict[str, list[Group]]) -> Figure:
    """Heat table by push, arrows on the table, polar plots by heading."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 3.9), layout="constrained")
    heat, arrows = figure.add_subplot(1, 4, 1), figure.add_subplot(1, 4, 2)
    pushes = groups["push"]
    values = np.array([g.rms for g in pushes])
    image = heat.imshow(values, cmap="YlOrRd", vmin=0.0, vmax=max(3.0, float(values.max())), aspect="auto")
    heat.set_xticks(range(3), ["along", "across", "rotation"])
    heat.set_yticks(range(len(pushes)), [g.name for g in pushes])
    heat.set_ylabel("push")
    for (row, column), value in np.ndenumerate(values):
        rare = pushes[row].by_chance[column] < _RARE
        heat.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=7, fontweight="bold" if rare else "normal")
    figure.colorbar(image, ax=heat, shrink=0.7)
    heading = frames.heading_in_table
    cos, sin = np.cos(heading), np.sin(heading)
    along, across = frames.off[:, 0], frames.off[:, 1]
    quiver = arrows.quiver(
        frames.position[:, 0],
        frames.position[:, 1],
        _STRETCH * (cos * along - sin * across),
        _STRETCH * (sin * along + cos * across),
        frames.speed,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.006,
        cmap="viridis",
    )
    arrows.set_aspect("equal")
    arrows.margins(0.2)
    arrows.set_xlabel("x [m]")
    arrows.set_ylabel("y [m]")
    figure.colorbar(quiver, ax=arrows, shrink=0.7, label="speed [m/s]")
    for place, (name, angle) in enumerate((("in the table", frames.heading_in_table), ("in the body", frames.heading_in_body))):
        polar = figure.add_subplot(1, 4, 3 + place, projection="polar", rlabel_position=22.5)
        sector = np.round(angle / (np.pi / 4)).astype(int) % 8
        for column, (label, colour) in enumerate((("along", _ACCENT), ("across", _WARM))):
            mean = [float(np.mean(frames.residual[sector == s, column])) if np.any(sector == s) else 0.0 for s in range(8)]
            closed = np.append(mean, mean[0])
            polar.plot(np.append(np.arange(8), 8) * np.pi / 4, closed, color=colour, label=label, marker=".")
        limit = max(2.0, float(np.abs(frames.residual).mean()) * 2)
        polar.set_ylim(-limit, limit)
        polar.set_yticks([0.0, limit], ["0", f"{limit:.0f}"])
        polar.set_title(f"heading {name}", fontsize=9)
        polar.tick_params(labelsize=7)
        if place == 1:
            polar.legend(fontsize=7, loc="lower right", bbox_to_anchor=(1.3, -0.15))
    return figure


def draw_ranking(selection: Selection, seen: float) -> Figure:
    """Evidence of the effects beside the base model."""
    from matplotlib.figure import Figure

    first = selection.steps[0]
    refitted = {c.name: c.gain for c in first.candidates}
    ranked = sorted(first.scores, key=lambda s: -refitted.get(s.name, s.gain))[:_N_RANKED]
    gains = [refitted.get(s.name, s.gain) for s in ranked]
    figure = Figure(figsize=(9.0, 0.32 * len(ranked) + 0.9), layout="constrained")
    ax = figure.subplots()
    colours = [_ACCENT if s.name in selection.found else "#6f8fb5" if g >= seen else _GREY for s, g in zip(ranked, gains, strict=True)]
    ax.barh([s.name for s in ranked], np.maximum(gains, 0.0), color=colours)
    ax.invert_yaxis()
    ax.axvline(seen, color="black", linewidth=0.8, linestyle="--")
    right = max(float(max(gains)), 2 * seen)
    for row, (score, gain) in enumerate(zip(ranked, gains, strict=True)):
        unit = EFFECTS[score.name].parameters[0].unit
        shown = f"{score.smallest:.2g} {unit}".rstrip() if np.isfinite(score.smallest) else "no size"
        text = f"{gain:.1f}" if gain >= seen else f"not seen; {shown} would have shown"
        # Beside the line, not across it.
        place, colour = (gain, "#333333") if gain >= seen else (seen, _GREY)
        ax.text(place + 0.01 * right, row, text, va="center", fontsize=8, color=colour)
    ax.set_xlim(0.0, 1.3 * right)
    ax.set_xlabel("evidence [nat]")
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def draw_shrink(gap: Gap, found: tuple[str, ...]) -> Figure:
    """Cell error on pushes held out: base, with each effect more, noise; every push a dot, and what each step takes away."""
    from matplotlib.figure import Figure

    stages = [("base model", gap.before, _GREY), *(("with " + name, errors, "#6f8fb5") for name, errors in gap.stages.items())]
    if found:
        stages.append(("with " + ",\n".join(found), gap.after, _ACCENT))
    columns = [*stages, ("noise of the poses", gap.noise, "#c9d1d9")]
    figure = Figure(figsize=(1.6 + 1.6 * len(columns), 3.2), layout="constrained")
    ax = figure.subplots()
    rng = np.random.default_rng(0)
    means = [1e3 * float(np.mean(errors)) for _, errors, _ in columns]
    for place, (_, errors, colour) in enumerate(columns):
        ax.bar(place, means[place], width=0.55, color=colour)
        if place > 0:
            # What has gone since the column before, as in a waterfall.
            ax.plot([place - 0.725, place + 0.275], [means[place - 1]] * 2, color="#1c2430", linewidth=0.8, linestyle=":")
        ax.plot(
            place + rng.uniform(-0.15, 0.15, len(errors)),
            1e3 * errors,
            linestyle="none",
            marker="o",
            markersize=3.5,
            color="#1c2430",
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
