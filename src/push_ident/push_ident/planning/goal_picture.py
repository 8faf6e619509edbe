"""Picture of the pushes to a goal: where the object lay, where each push was predicted to bring it, and where it was seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from push_ident.errors import InputError
from push_ident.files import replaced
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.pages.page import figure_text
from push_ident.planning.goal import Goal
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_goal_pushes"]

_COLUMNS: Final = 4
"""Panels in a row."""
_MARGIN: Final = 0.02
"""Around all outlines [m]."""


def draw_goal_pushes(
    path: Path,
    outline: Float64Array,
    start: Float64Array,
    pushes: Sequence[tuple[Float64Array | None, Float64Array]],
    goal: Goal,
    *,
    title: str = "",
) -> None:
    """Draw a panel for each push.

    Args:
        path: PNG to write.
        outline: of the object [m], shape (n_vertices, 2), object frame.
        start: pose before the first push, shape (3,), table frame.
        pushes: predicted pose, or None where a push explored, and pose seen after it, each of shape (3,), table frame.
        goal: where the object shall be.
        title: of the figure.
    """
    from matplotlib.figure import Figure

    n_columns = min(_COLUMNS, max(len(pushes), 1))
    n_rows = -(-max(len(pushes), 1) // n_columns)
    figure = Figure(figsize=(3.4 * n_columns, 3.6 * n_rows + 0.4), layout="constrained")
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    poses = [start, goal.pose, *(pose for push in pushes for pose in push if pose is not None)]
    points = np.vstack([transform_points(pose, outline) for pose in poses])
    before = start
    for number, (ax, (expected, seen)) in enumerate(zip(panels, pushes, strict=False), 1):
        _draw(ax, outline, before, seen, fill=True)
        _draw(ax, outline, goal.pose, None, colour="tab:green", style=":", label="goal")
        if expected is not None:
            _draw(ax, outline, expected, None, colour="tab:blue", style="--", label="predicted")
        _draw(ax, outline, seen, None, colour="black", style="-", label="seen")
        distance, angle = goal.error(seen)
        ax.set_title(f"push {number}{_missed(expected, seen)}\n{1e3 * distance:.1f} mm, {np.degrees(angle):.1f}° from the goal", fontsize=9)
        before = seen
    for ax in panels:
        ax.set_aspect("equal")
        ax.set_xlim(points[:, 0].min() - _MARGIN, points[:, 0].max() + _MARGIN)
        ax.set_ylim(points[:, 1].min() - _MARGIN, points[:, 1].max() + _MARGIN)
        ax.tick_params(labelsize=7)
        ax.set_xlabel("x [m]", fontsize=8)
    for ax in panels[len(pushes) :]:
        ax.set_visible(False)
    if pushes:
        panels[len(pushes) - 1].legend(fontsize=7, loc="best")
    if title:
        figure.suptitle(figure_text(title), fontsize=11)
    with replaced(path, "the picture", error=InputError) as file:
        figure.savefig(file, dpi=110)


def _draw(
    ax: Axes,
    outline: Float64Array,
    pose: Float64Array,
    after: Float64Array | None,
    *,
    colour: str = "0.8",
    style: str = "-",
    label: str | None = None,
    fill: bool = False,
) -> None:
    """One outline; with `after`, an arrow to where its origin went."""
    from matplotlib.patches import Polygon

    face = {"facecolor": colour, "fill": True} if fill else {"fill": False}
    ax.add_patch(Polygon(transform_points(pose, outline), edgecolor=colour, linestyle=style, linewidth=1.2, label=label, **face))
    if after is not None:
        ax.annotate("", xy=(after[0], after[1]), xytext=(pose[0], pose[1]), arrowprops={"arrowstyle": "->", "color": "0.4"})


def _missed(expected: Float64Array | None, seen: Float64Array) -> str:
    if expected is None:
        return ", explores"
    off = seen - expected
    return f", predicted to {1e3 * float(np.hypot(off[0], off[1])):.1f} mm, {np.degrees(abs(float(wrap_angle(off[2])))):.1f}°"
