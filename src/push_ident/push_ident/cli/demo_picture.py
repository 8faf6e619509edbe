"""The pushes of the demo over the camera's picture: where each was predicted to end before it was made, and where it ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from push_ident.errors import InputError
from push_ident.files import replaced
from push_ident.geometry.se2 import transform_points
from push_ident.identification.ways import Way
from push_ident.perception.depth import points_in_table
from push_ident.types import DepthFrame, Float64Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["PushPicture", "draw_pushes", "top_of"]

_COLUMNS: Final = 4
"""Panels in a row."""
_MARGIN: Final = 20
"""Of the picture around all outlines [px]."""
_BEFORE, _PREDICTED, _OTHER, _SEEN = "white", "#56b4e9", "#e69f00", "black"
"""Sky blue and orange of Okabe and Ito; lines differ in their pattern as well."""


@dataclass(slots=True)
class PushPicture:
    """One push. Poses are in the table frame, shape (3,)."""

    frame: DepthFrame
    """As the camera saw it before the push."""
    camera_in_table: Float64Array
    """Of the optical frame, shape (4, 4)."""
    before: Float64Array
    ways: list[Way] = field(default_factory=list)
    """Predicted; none for a push that nothing was known for."""
    expected_m: float = np.nan
    """Expected mean cell error [m]."""
    seen: Float64Array | None = None
    """Afterwards; None before."""
    error_m: float = np.nan
    """Mean cell error of the prediction [m]."""

    def caption(self, number: int) -> str:
        """For its panel."""
        if not self.ways:
            return f"push {number}: nothing known yet\n"
        known = f"push {number}: expected to {1e3 * self.expected_m:.1f} mm"
        if len(self.ways) > 1:
            known += ", " + " or ".join(f"{way.chance:.0%}" for way in self.ways)
        return f"{known}\n" + ("" if self.seen is None else f"was {1e3 * self.error_m:.1f} mm off")


def top_of(frame: DepthFrame, camera_in_table: Float64Array, pose: Float64Array, outline: Float64Array) -> float:
    """Height at which an outline is seen [m]: the lower quartile over the pixels within it, since an arm may be above; 0 where none is."""
    from push_ident.geometry.outline import points_in_polygon

    points = points_in_table(frame, camera_in_table).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    inside = points_in_polygon(points[:, :2].astype(np.float64), transform_points(pose, outline))
    return float(np.quantile(points[inside, 2], 0.25)) if inside.any() else 0.0


def draw_pushes(path: Path, outline: Float64Array, pushes: Sequence[PushPicture], *, title: str) -> None:
    """Draw a panel for each push.

    Args:
        path: PNG to write.
        outline: of the object [m], shape (n_vertices, 2), object frame.
        pushes: one at least.
        title: of the figure.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    n_columns = min(_COLUMNS, len(pushes))
    n_rows = -(-len(pushes) // n_columns)
    figure = Figure(figsize=(3.4 * n_columns, 3.5 * n_rows + 0.7), layout="constrained")
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    height = min(top_of(push.frame, push.camera_in_table, push.before, outline) for push in pushes)
    shown = [_draw(ax, outline, height, push) for ax, push in zip(panels, pushes, strict=False)]
    (left, top), (right, bottom) = np.vstack(shown).min(axis=0) - _MARGIN, np.vstack(shown).max(axis=0) + _MARGIN
    for number, (ax, push) in enumerate(zip(panels, pushes, strict=False), 1):
        ax.set_xlim(left, right)
        ax.set_ylim(bottom, top)
        ax.set_axis_off()
        ax.set_title(push.caption(number), fontsize=9)
    for ax in panels[len(pushes) :]:
        ax.set_visible(False)
    figure.suptitle(title, fontsize=11)
    lines = {label: line for ax in panels for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=len(lines), fontsize=9, facecolor="0.7")
    with replaced(path, "the picture", error=InputError) as file:
        figure.savefig(file, dpi=110)


def _draw(ax: Axes, outline: Float64Array, height: float, push: PushPicture) -> Float64Array:
    """The picture of the camera and the outlines at a height [m]; their pixels, shape (n, 2)."""
    depth = push.frame.depth
    near, far = np.nanquantile(depth, [0.01, 0.99])
    ax.imshow(depth, cmap="gray_r", vmin=near - 0.3 * (far - near), vmax=far + 0.3 * (far - near), interpolation="nearest")
    poses = [("before", push.before, _BEFORE, "-", 1.2)]
    if push.seen is not None:
        poses.append(("seen after it", push.seen, _SEEN, "-", 2.5))
    # Above what was seen: they cover each other where the prediction is good.
    styles = (("predicted", _PREDICTED, "--", 1.5), ("predicted, the other way", _OTHER, "-.", 1.5))
    poses += [(name, way.end, colour, style, width) for (name, colour, style, width), way in zip(styles, push.ways, strict=False)]
    drawn = []
    for label, pose, colour, style, width in poses:
        pixels = _pixels(push, transform_points(pose, outline), height)
        closed = np.vstack([pixels, pixels[:1]])
        ax.plot(closed[:, 0], closed[:, 1], color=colour, linestyle=style, linewidth=width, label=label)
        drawn.append(pixels)
    return np.vstack(drawn)


def _pixels(push: PushPicture, points: Float64Array, height: float) -> Float64Array:
    """Where points of the table frame, shape (n, 2), are at a height [m] in the picture, shape (n, 2)."""
    camera = push.frame.intrinsics
    seen = np.column_stack([points, np.full(len(points), height), np.ones(len(points))]) @ np.linalg.inv(push.camera_in_table).T
    return np.column_stack([camera.fx * seen[:, 0] / seen[:, 2] + camera.cx, camera.fy * seen[:, 1] / seen[:, 2] + camera.cy])
