"""Pictures of maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.result import ModelPosterior
from push_ident.types import Float64Array, ObjectModel, ObjectShape

__all__ = ["draw_maps", "draw_panels"]


def draw_maps(path: Path, posterior: ModelPosterior, *, title: str = "") -> None:
    """Draw mass, friction, their product and its relative deviation, side by side."""
    model = posterior.model
    product = model.mass * model.friction
    panels = [
        ("mass [g]", model.shape, 1e3 * model.mass),
        ("friction", model.shape, model.friction),
        ("mass x friction [g]", model.shape, 1e3 * product),
        ("deviation of the product [%]", model.shape, 100 * posterior.mass_friction_std / product),
    ]
    draw_panels(path, panels, centre=model, title=title)


def draw_panels(
    path: Path, panels: Sequence[tuple[str, ObjectShape, Float64Array]], *, centre: ObjectModel | None = None, title: str = ""
) -> None:
    """Draw one map a panel; panels with the same title share their colour scale.

    Args:
        path: PNG to write.
        panels: title, shape and one value a cell.
        centre: mark its centre of friction.
        title: over all.
    """
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon, Rectangle

    figure = Figure(figsize=(3.6 * len(panels), 3.4), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (name, shape, values) in zip(axes, panels, strict=True):
        size = shape.cells.size
        squares = [Rectangle((x - size / 2, y - size / 2), size, size) for x, y in shape.cells.centres]
        same = np.concatenate([v for n, _, v in panels if n == name])
        patches = PatchCollection(squares, cmap="viridis", edgecolor="white", linewidth=0.3)
        patches.set_array(values)
        patches.set_clim(min(0.0, float(same.min())), float(same.max()))
        ax.add_collection(patches)
        ax.add_patch(Polygon(shape.outline, fill=False, edgecolor="black", linewidth=1.0))
        if centre is not None:
            ax.plot(*centre.centre_of_friction, marker="+", color="red", markersize=9)
        ax.set_title(name, fontsize=10)
        ax.set_aspect("equal")
        ax.autoscale_view()
        ax.set_xlabel("x [m]", fontsize=8)
        ax.tick_params(labelsize=7)
        figure.colorbar(patches, ax=ax, shrink=0.8).ax.tick_params(labelsize=7)
    if title:
        figure.suptitle(title, fontsize=11)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise InputError(f"Cannot write the picture {path}: {error.strerror}; choose a place that can be written to.") from None
