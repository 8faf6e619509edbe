"""The reach of an arm as a picture: the table from above, one panel for each heading."""

from __future__ import annotations

from io import BytesIO
from typing import Any, Final

import numpy as np

from push_ident.pushing.robot.reach import AXES, Outcome, Reach
from push_ident.pushing.robot.robot_file import Robot
from push_ident.types import Float64Array

__all__ = ["draw_reach"]

_LOOK: Final = {
    Outcome.POSSIBLE: ("#009e73", "", "possible"),
    Outcome.LIMIT: ("#e69f00", "//", "beyond a limit"),
    Outcome.UNREACHABLE: ("#d55e00", "xx", "out of reach"),
}
"""Colour of Okabe and Ito, pattern and word of each outcome: none is told by its colour alone."""
_SIZE: Final = (10.0, 4.4)
"""Of the picture [inch]: two tables of 1.2 m by 0.8 m side by side."""


def draw_reach(reach: Reach, robot: Robot) -> bytes:
    """PNG: at each place of the grid whether the tool can push along the heading of the panel, at pushing height."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=_SIZE, layout="compressed")
    FigureCanvasAgg(figure)
    file = robot.file
    figure.suptitle(f"{file.name}: where the tool can push, {1e3 * file.push_height:.0f} mm above the table")
    for axis, (panel, name) in enumerate(zip(figure.subplots(1, len(AXES), sharey=True), AXES, strict=True)):
        _draw_panel(panel, reach, axis)
        _draw_cell(panel, robot)
        possible = 100 * reach.share(axis, Outcome.POSSIBLE)
        panel.set(title=f"along {name}: {possible:.0f} % of the workspace", xlabel="x of the table frame [m]", aspect="equal")
    figure.axes[0].set_ylabel("y of the table frame [m]")
    looks = [Patch(facecolor=colour, hatch=hatch, edgecolor="white", label=word) for colour, hatch, word in _LOOK.values()]
    figure.legend(handles=looks, loc="outside lower center", ncols=len(looks), frameon=False)
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=130)
    return picture.getvalue()


def _draw_panel(panel: Any, reach: Reach, axis: int) -> None:
    """A tile for each place, as far as it lies in the workspace, and the heading as one arrow."""
    from matplotlib.patches import Rectangle

    x_edges, y_edges = _edges(reach.x), _edges(reach.y)
    for i, j in np.ndindex(len(reach.x), len(reach.y)):
        colour, hatch, _ = _LOOK[Outcome(int(reach.outcome[axis, i, j]))]
        width, height = float(np.diff(x_edges)[i]), float(np.diff(y_edges)[j])
        corner = float(x_edges[i]), float(y_edges[j])
        panel.add_patch(Rectangle(corner, width, height, facecolor=colour, hatch=hatch, edgecolor="white", linewidth=0.8))
    middle = np.array([x_edges[[0, -1]].mean(), y_edges[[0, -1]].mean()])
    half = 0.3 * np.eye(2)[axis] * min(np.ptp(x_edges), np.ptp(y_edges))
    arrow = {"arrowstyle": "-|>", "linewidth": 3.0, "color": "black", "mutation_scale": 18.0}
    panel.annotate("", middle + half, middle - half, arrowprops=arrow)


def _edges(places: Float64Array) -> Float64Array:
    """Borders between the places, and the first and last of these [m], shape (n + 1,)."""
    return np.concatenate([places[:1], 0.5 * (places[1:] + places[:-1]), places[-1:]])


def _draw_cell(panel: Any, robot: Robot) -> None:
    """Workspace, base and camera around it."""
    from matplotlib.patches import Rectangle

    file = robot.file
    x_min, x_max, y_min, y_max = file.workspace
    panel.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, fill=False, edgecolor="black", linewidth=1.5))
    marks = [("camera", file.camera.position, "v")]
    if file.base is not None:
        marks.append(("base", file.base.position, "s"))
    for name, (x, y, _), marker in marks:
        panel.plot(x, y, marker, color="black", markersize=8)
        panel.annotate(name, (x, y), xytext=(0, 9), textcoords="offset points", ha="center")
    panel.margins(0.12)
