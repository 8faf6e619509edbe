"""Picture of an import: where the pusher is while the object moves."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from push_ident.bags.importers.overlap import Overlap
from push_ident.errors import InputError
from push_ident.files import replaced
from push_ident.geometry.se2 import transform_points
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_overlap"]

_MOST_PUSHES: Final = 12
"""Pushes that are drawn; with more, circles and outlines cover each other."""


def draw_overlap(path: Path, overlap: Overlap) -> None:
    """Draw the first pushes in the table frame and in the object frame, and the distance over time, as a PNG. Raises InputError."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 4.8), layout="constrained")
    table, body, distance = figure.subplots(1, 3)
    pushes = np.unique(overlap.push)[:_MOST_PUSHES]
    first = [int(np.flatnonzero(overlap.push == push)[0]) for push in pushes]
    for k in first:
        _polygon(table, transform_points(overlap.pose[k], overlap.shape.outline), "0.5")
    _polygon(body, overlap.shape.outline, "black")
    for number, (push, k) in enumerate(zip(pushes, first, strict=True)):
        colour, own = f"C{number % 10}", overlap.push == push
        table.plot(*overlap.pusher[own].T, color=colour, linewidth=1.0)
        for ax, centre in ((table, overlap.pusher[k]), (body, _in_object(overlap, k))):
            _circle(ax, centre, overlap.radius, colour)
        distance.plot(overlap.time[own], 1e3 * overlap.distance[own], ".-", color=colour, markersize=3, linewidth=0.8)
    limit = 1e3 * overlap.tolerance
    distance.axhspan(-limit, limit, color="tab:green", alpha=0.15, label=f"noise explains up to {limit:.1f} mm")
    distance.axhline(0.0, color="black", linewidth=0.8)
    distance.legend(fontsize=9)
    distance.set_xlabel("time since the object began to move [s]")
    distance.set_ylabel("pusher's surface to outline [mm], negative: inside")
    for ax, title in ((table, "as the object begins to move, table frame"), (body, "the same in the object frame")):
        ax.set_aspect("equal")
        ax.autoscale_view()
        ax.set_xlabel("x [m]")
        ax.set_ylabel("y [m]")
        ax.set_title(title, fontsize=10)
    distance.set_title("while it moves, the pusher should lie on the outline", fontsize=10)
    figure.suptitle(_title(overlap, len(pushes)), fontsize=11, wrap=True)
    with replaced(path, "the picture", error=InputError) as file:
        figure.savefig(file, dpi=110)


def _title(overlap: Overlap, n_drawn: int) -> str:
    if not len(overlap.push):
        return "no frame shows the object in motion"
    n = len(np.unique(overlap.push))
    drawn = "" if n_drawn == n else f", the first {n_drawn} of {n} pushes"
    if overlap.fits:
        return f"pusher and object meet: {1e3 * overlap.miss:.1f} mm in the median{drawn}"
    side = "inside" if overlap.miss < 0 else "apart"
    return f"pusher and object do not meet: {1e3 * abs(overlap.miss):.1f} mm {side} in the median{drawn}"


def _in_object(overlap: Overlap, k: int) -> Float64Array:
    """Axis of the pusher in the object frame [m], shape (2,)."""
    x, y, yaw = overlap.pose[k]
    dx, dy = overlap.pusher[k] - [x, y]
    return np.array([np.cos(yaw) * dx + np.sin(yaw) * dy, -np.sin(yaw) * dx + np.cos(yaw) * dy])


def _polygon(ax: Axes, points: Float64Array, colour: str) -> None:
    from matplotlib.patches import Polygon

    ax.add_patch(Polygon(points, fill=False, edgecolor=colour, linewidth=1.2))


def _circle(ax: Axes, centre: Float64Array, radius: float, colour: str) -> None:
    from matplotlib.patches import Circle

    ax.add_patch(Circle((float(centre[0]), float(centre[1])), radius, fill=False, edgecolor=colour, linewidth=1.4))
    ax.plot(*centre, ".", color=colour, markersize=4)
