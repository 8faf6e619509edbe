"""The page of the reach of an arm: the table from above, one drawing for each heading."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from push_ident.pages.outline_chart import Placed, outline_panels
from push_ident.pages.page import FigureSection, write_page
from push_ident.pushing.robot.reach import AXES, Outcome, Reach
from push_ident.pushing.robot.robot_file import Robot
from push_ident.types import Float64Array

_STYLES: Final = {
    Outcome.POSSIBLE: ("possible", ()),
    Outcome.LIMIT: ("limited", ((0, 2),)),
    Outcome.UNREACHABLE: ("unreachable", ((0, 2), (1, 3))),
}
"""Style of a tile, and its corners that lines join: an outcome shows without its colour, too."""
_WORDS: Final = {Outcome.POSSIBLE: "possible", Outcome.LIMIT: "beyond a limit", Outcome.UNREACHABLE: "out of reach"}
_NOTE: Final = (
    "Green, plain: possible. Orange, a diagonal: the arm gets there, but a joint would be beyond a limit. Red, a cross: out of reach. "
    "From above, in the table frame, x to the right; workspace: x {:g} to {:g} m, y {:g} to {:g} m."
)
_ARROW: Final = np.array([[-0.3, 0.0], [0.3, 0.0], [0.24, 0.04], [0.3, 0.0], [0.24, -0.04]])
"""Along x, in lengths of the shorter side of the workspace."""
_MARK: Final = 0.012
"""Half the side of the squares that mark base and camera, in lengths of the cell."""


def write_reach_page(path: Path, reach: Reach, robot: Robot) -> None:
    """Write whether the tool can push along each axis at each place of the grid, at pushing height. Raises InputError where it cannot."""
    file = robot.file
    cell = _cell(robot)
    drawings = []
    for axis, name in enumerate(AXES):
        title = f"along {name}: {100 * reach.share(axis, Outcome.POSSIBLE):.0f} % of the workspace"
        drawings.append((title, [*_tiles(reach, axis), *cell, _arrow(reach, axis)]))
    title = f"{file.name}: where the tool can push, {1e3 * file.push_height:.0f} mm above the table"
    section = FigureSection("Pushes that the arm can make", outline_panels(drawings), _NOTE.format(*file.workspace))
    write_page(path, __package__, "reach.html.j2", {"title": title, "section": section})


def _tiles(reach: Reach, axis: int) -> list[Placed]:
    """A tile for each place, as far as it lies in the workspace."""
    placed = []
    x, y = _edges(reach.x), _edges(reach.y)
    for i, j in np.ndindex(len(reach.x), len(reach.y)):
        outcome = Outcome(int(reach.outcome[axis, i, j]))
        corners = np.array([(x[i], y[j]), (x[i + 1], y[j]), (x[i + 1], y[j + 1]), (x[i], y[j + 1])])
        style, lines = _STYLES[outcome]
        text = f"({reach.x[i]:.2f}, {reach.y[j]:.2f}) m: {_WORDS[outcome]}"
        placed += [Placed(corners, style, text), *(Placed(corners[list(ends)], "hatch", text, closed=False) for ends in lines)]
    return placed


def _edges(places: Float64Array) -> Float64Array:
    """Borders between the places, and the first and last of these [m], shape (n + 1,)."""
    return np.concatenate([places[:1], 0.5 * (places[1:] + places[:-1]), places[-1:]])


def _arrow(reach: Reach, axis: int) -> Placed:
    low, high = np.array([reach.x[0], reach.y[0]]), np.array([reach.x[-1], reach.y[-1]])
    points = float(np.min(high - low)) * (_ARROW if axis == 0 else _ARROW[:, ::-1])
    return Placed(0.5 * (low + high) + points, "axis", f"heading of the push, along {AXES[axis]}", closed=False)


def _cell(robot: Robot) -> list[Placed]:
    file = robot.file
    x_min, x_max, y_min, y_max = file.workspace
    placed = [Placed(np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)]), "outline", "workspace")]
    marks = {name: np.array(one.position[:2]) for name, one in (("camera", file.camera), ("base", file.base)) if one is not None}
    extent = float(np.ptp(np.vstack([placed[0].corners, *marks.values()]), axis=0).max())
    square = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    for name, at in marks.items():
        placed.append(Placed(at + _MARK * extent * square, "tip", name))
        placed.append(Placed(at + extent * (np.array([0.0, -0.06]) + 0.07 * square), "none", name, label=name))
    return placed
