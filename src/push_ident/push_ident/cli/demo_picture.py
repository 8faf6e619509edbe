"""The pushes of the demo over the camera's picture: where each was predicted to end before it was made, and where it ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from push_ident.errors import InputError
from push_ident.files import replaced
from push_ident.geometry.se2 import transform_points
from push_ident.identification.ways import Way
from push_ident.perception.depth import height_inside, points_in_table
from push_ident.types import DepthFrame, Float64Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

__all__ = ["PushPicture", "draw_pushes"]

_COLUMNS: Final = 4
"""Panels in a row."""
_PANEL, _CAPTION, _GAP, _ENDS = 3.3, 0.45, 0.1, 0.4
"""Width of a panel, height of its caption, space between panels, and height of the title and of the legend [in]."""
_MARGIN: Final = 20
"""Of the picture around all outlines [px]."""
_BEFORE, _PREDICTED, _OTHER, _SEEN = "white", "#56b4e9", "#e69f00", "black"
"""Sky blue and orange of Okabe and Ito; lines differ in their pattern as well."""


@dataclass
class PushPicture:
    """One push. Poses are in the table frame, shape (3,)."""

    frame: DepthFrame
    """As the camera saw it before the push."""
    camera_in_table: Float64Array
    """Of the optical frame, shape (4, 4)."""
    before: Float64Array
    outline: Float64Array
    """Of the object, as it was known before the push [m], shape (n_vertices, 2), object frame."""
    ways: list[Way] = field(default_factory=list)
    """Predicted; none for a push that nothing was known for."""
    expected_m: float = np.nan
    """Expected mean cell error [m]."""
    seen: Float64Array | None = None
    """Afterwards; None before."""
    error_m: float = np.nan
    """Mean cell error of the prediction [m]."""

    @cached_property
    def heights(self) -> NDArray[np.float32]:
        """Above the table, of each pixel [m]; NaN where the camera saw nothing."""
        return self._points[..., 2]

    @cached_property
    def top(self) -> float:
        """Height of the object [m]; 0 where it is not seen."""
        return height_inside(self._points, transform_points(self.before, self.outline)) or 0.0

    @cached_property
    def _points(self) -> NDArray[np.float32]:
        return points_in_table(self.frame, self.camera_in_table)

    def caption(self, number: int) -> str:
        """For its panel."""
        if not self.ways:
            return f"push {number}: nothing known yet\n"
        known = f"push {number}: expected to {1e3 * self.expected_m:.1f} mm"
        if len(self.ways) > 1:
            known += ", " + " or ".join(f"{way.chance:.0%}" for way in self.ways)
        return f"{known}\n" + ("" if self.seen is None else f"was {1e3 * self.error_m:.1f} mm off")


def draw_pushes(path: Path, pushes: Sequence[PushPicture], *, title: str) -> None:
    """Draw a panel for each push.

    Args:
        path: PNG to write.
        pushes: one at least.
        title: of the figure.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure()
    panels = [figure.add_axes((0.0, 0.0, 1.0, 1.0)) for _ in pushes]
    height = min((push.top for push in pushes if push.top > 0.0), default=0.0)
    shown = np.vstack([_draw(ax, height, push) for ax, push in zip(panels, pushes, strict=True)])
    (left, top), (right, bottom) = shown.min(axis=0) - _MARGIN, shown.max(axis=0) + _MARGIN
    _place(figure, panels, (bottom - top) / (right - left))
    for number, (ax, push) in enumerate(zip(panels, pushes, strict=True), 1):
        ax.set_xlim(left, right)
        ax.set_ylim(bottom, top)
        ax.set_axis_off()
        ax.set_title(push.caption(number), fontsize=9, y=1.0)
    figure.suptitle(title, fontsize=11, y=1.0 - 0.1 / figure.get_figheight(), va="top")
    lines = {label: line for ax in panels for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(lines.values(), lines.keys(), loc="lower center", ncols=min(len(lines), 2 * len(panels)), fontsize=9, facecolor="0.7")
    with replaced(path, "the picture", error=InputError) as file:
        figure.savefig(file, dpi=110)


def _place(figure: Figure, panels: Sequence[Axes], shape: float) -> None:
    """Put panels of a shape (height by width) in rows, and give the figure its size: much faster than a layout that measures texts."""
    n_columns = min(_COLUMNS, len(panels))
    n_rows = -(-len(panels) // n_columns)
    row = _CAPTION + shape * _PANEL + _GAP
    width, height = n_columns * (_PANEL + _GAP) + _GAP, n_rows * row + 2 * _ENDS
    figure.set_size_inches(width, height)
    for k, ax in enumerate(panels):
        left, top = _GAP + (k % n_columns) * (_PANEL + _GAP), _ENDS + (k // n_columns) * row + _CAPTION
        ax.set_position((left / width, 1.0 - (top + shape * _PANEL) / height, _PANEL / width, shape * _PANEL / height))


def _draw(ax: Axes, height: float, push: PushPicture) -> Float64Array:
    """The picture of the camera, higher points darker, and the outlines at a height [m]; their pixels, shape (n, 2)."""
    darkness = (-height, 3.0 * height) if height else (None, None)  # where no push saw its object, that of the picture
    ax.imshow(push.heights, cmap="gray_r", vmin=darkness[0], vmax=darkness[1], interpolation="nearest", aspect="auto")
    poses = [("before", push.before, _BEFORE, "-", 1.2)]
    if push.seen is not None:
        poses.append(("seen after it", push.seen, _SEEN, "-", 2.5))
    # Above what was seen: they cover each other where the prediction is good.
    styles = (("predicted", _PREDICTED, "--", 1.5), ("predicted, the other way", _OTHER, "-.", 1.5))
    poses += [(name, way.end, colour, style, width) for (name, colour, style, width), way in zip(styles, push.ways, strict=False)]
    drawn = []
    for label, pose, colour, style, width in poses:
        pixels = _pixels(push, transform_points(pose, push.outline), height)
        closed = np.vstack([pixels, pixels[:1]])
        ax.plot(closed[:, 0], closed[:, 1], color=colour, linestyle=style, linewidth=width, label=label)
        drawn.append(pixels)
    return np.vstack(drawn)


def _pixels(push: PushPicture, points: Float64Array, height: float) -> Float64Array:
    """Where points of the table frame, shape (n, 2), are at a height [m] in the picture, shape (n, 2)."""
    camera = push.frame.intrinsics
    seen = np.column_stack([points, np.full(len(points), height), np.ones(len(points))]) @ np.linalg.inv(push.camera_in_table).T
    return np.column_stack([camera.fx * seen[:, 0] / seen[:, 2] + camera.cx, camera.fy * seen[:, 1] / seen[:, 2] + camera.cy])
