"""Pictures of maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from push_ident.errors import InputError
from push_ident.files import replaced
from push_ident.identification.identifiability import Identifiability
from push_ident.identification.result import ModelPosterior
from push_ident.pages.page import figure_text
from push_ident.types import Float64Array, ObjectModel, ObjectShape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure

__all__ = ["draw_cells", "draw_identifiability", "draw_maps", "draw_panels"]


def draw_maps(path: Path, posterior: ModelPosterior, *, title: str = "") -> None:
    """Draw mass, friction, their product and its relative standard deviation, side by side."""
    model = posterior.model
    product = model.mass * model.friction
    panels = [
        ("mass [g]", model.shape, 1e3 * model.mass),
        ("friction", model.shape, model.friction),
        ("mass x friction [g]", model.shape, 1e3 * product),
        ("standard deviation of the product [%]", model.shape, 100 * posterior.mass_friction_std / product),
    ]
    draw_panels(path, panels, centre=model, title=title)


def draw_identifiability(path: Path, posterior: ModelPosterior, known: Identifiability, *, title: str = "") -> None:
    """Draw the identifiability: ratio of posterior to prior standard deviation of named quantities and of all combinations of cells.

    The four best determined combinations are drawn as the change of the logarithm of each cell's support friction force.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14.4, 6.4), layout="constrained")
    top, bottom = figure.subfigures(2, 1, squeeze=False)[:, 0]
    bars, spectrum = top.subplots(1, 2)
    named = [q for q in known.quantities if q.prior_std > 0]
    bars.barh([figure_text(q.name) for q in named][::-1], [q.std / q.prior_std for q in named][::-1], color="tab:blue")
    bars.set_xlabel("standard deviation after / before the pushes")
    bars.set_xlim(0, 1.05)
    ratios = [c.std_ratio for c in known.combinations]
    spectrum.plot(np.arange(1, len(ratios) + 1), ratios, marker=".", color="tab:blue")
    spectrum.set_xlabel(f"combinations of the cells, best determined first ({known.n_pinned} pinned down, {known.n_open} open)")
    spectrum.set_ylabel("standard deviation after / before")
    spectrum.set_ylim(0, 1.05)
    shape = posterior.unknowns.shape
    best = known.combinations[:4]
    axes = bottom.subplots(1, len(best), squeeze=False)[0]
    for ax, combination in zip(axes, best, strict=True):
        change = combination.log_mass + combination.log_friction
        limit = float(np.abs(change).max()) or 1.0
        patches = draw_cells(ax, shape, change, "coolwarm", (-limit, limit))
        ax.set_title(f"{100 * combination.std_ratio:.0f} % of the prior deviation", fontsize=10)
        bottom.colorbar(patches, ax=ax, shrink=0.8).ax.tick_params(labelsize=7)
    if title:
        figure.suptitle(figure_text(title), fontsize=11)
    _save(figure, path)


def draw_panels(
    path: Path, panels: Sequence[tuple[str, ObjectShape, Float64Array]], *, centre: ObjectModel | None = None, title: str = ""
) -> None:
    """Draw one map per panel; panels with the same title have one colour scale.

    Args:
        path: PNG to write.
        panels: title, shape and one value per cell.
        centre: mark its centre of friction.
        title: of the figure.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.6 * len(panels), 3.4), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (name, shape, values) in zip(axes, panels, strict=True):
        same = np.concatenate([v for n, _, v in panels if n == name])
        patches = draw_cells(ax, shape, values, "viridis", (min(0.0, float(same.min())), float(same.max())))
        if centre is not None:
            ax.plot(*centre.centre_of_friction, marker="+", color="red", markersize=9)
        ax.set_title(name, fontsize=10)
        # Below: objects are often wide and low, and a scale beside them would be taller than they are.
        figure.colorbar(patches, ax=ax, orientation="horizontal", shrink=0.8, aspect=30).ax.tick_params(labelsize=7)
    if title:
        figure.suptitle(figure_text(title), fontsize=11)
    _save(figure, path)


def draw_cells(ax: Axes, shape: ObjectShape, values: Float64Array, colours: str, limits: tuple[float, float]) -> PatchCollection:
    """Colour the cells of an object by `values`, shape (n_cells,), inside its outline."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Polygon, Rectangle

    size = shape.cells.size
    squares = [Rectangle((x - size / 2, y - size / 2), size, size) for x, y in shape.cells.centres]
    patches = PatchCollection(squares, cmap=colours, edgecolor="white", linewidth=0.3)
    patches.set_array(values)
    patches.set_clim(*limits)
    ax.add_collection(patches)
    ax.add_patch(Polygon(shape.outline, fill=False, edgecolor="black", linewidth=1.0))
    ax.set_aspect("equal")
    ax.autoscale_view()
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(lambda metres, _: f"{1e3 * metres:.0f}")
    ax.set_xlabel("x [mm]", fontsize=8)
    ax.tick_params(labelsize=7)
    return patches


def _save(figure: Figure, path: Path) -> None:
    with replaced(path, "the picture", error=InputError) as file:
        figure.savefig(file, dpi=110)
