"""Pictures and tables in one style."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError
from push_ident.files import replaced

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "COLOURS",
    "dots",
    "draw_cells",
    "label_below",
    "log_millimetres",
    "markdown_table",
    "mean_in_millimetres",
    "millimetres",
    "new_figure",
    "save",
]

COLOURS: Final = defaultdict(
    lambda: "#e69f00",
    {
        "gauss_newton": "#0072b2",
        "with_forces": "#56b4e9",
        "fast_gradient": "#d55e00",
        "autograd": "#009e73",
        "finite_differences": "#cc79a7",
        "random_search": "#7f7f7f",
        "weighted_sampling": "#b8860b",
        "scalar": "#9a9a9a",
        "uniform": "#c9c9c9",
        "truth": "#000000",
    },
)
"""Each solver has one colour in all pictures, distinct for readers with red-green blindness; solvers without an entry share one."""


def new_figure(columns: int, rows: int = 1, width: float = 4.6, height: float = 3.8) -> tuple[Figure, list[Axes]]:
    """A figure and its panels, row by row; `width` and `height` of a panel in inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def dots(ax: Axes, position: float, values_m: Sequence[float], colour: str, *, width: float = 0.3, label: str | None = None) -> None:
    """Every value as a dot [mm] beside `position`, spread sideways evenly, with a bar at their mean."""
    n = len(values_m)
    # Multiples of the golden section separate neighbours without randomness.
    across = [position + width * ((i * 0.6180339887498949) % 1.0 - 0.5) for i in range(n)]
    ax.plot(across, [1e3 * v for v in values_m], ".", color=colour, markersize=3.5, alpha=0.5, markeredgewidth=0)
    mean = 1e3 * sum(values_m) / n
    ax.plot([position - 0.6 * width, position + 0.6 * width], [mean, mean], color=colour, linewidth=2.5, label=label)


def log_millimetres(ax: Axes, label: str, low: float = 0.1, high: float = 200.0) -> None:
    """Logarithmic axis of errors [mm] from `low` to `high` with plain numbers."""
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)


def label_below(ax: Axes, columns: int) -> None:
    """Legend below the panel, where it covers nothing."""
    ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=columns, frameon=False)


def draw_cells(ax: Axes, centres: NDArray[np.float64], size: float, values: Sequence[float], top: float, title: str) -> None:
    """One colour a cell, from 0 to `top`; `centres` [m] of shape (n_cells, 2)."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    squares = [Rectangle((x - size / 2, y - size / 2), size, size) for x, y in centres]
    patches = PatchCollection(squares, cmap="viridis", edgecolor="white", linewidth=0.3)
    patches.set_array(np.asarray(values))
    patches.set_clim(0.0, top)
    ax.add_collection(patches)
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_title(title, fontsize=10)
    ax.figure.colorbar(patches, ax=ax, shrink=0.8).ax.tick_params(labelsize=7)


def save(figure: Figure, path: Path) -> None:
    """Write a PNG that is the same each time; raises InputError where it cannot be written."""
    with replaced(path, "the picture", error=InputError) as file:
        figure.savefig(file, dpi=110, metadata={"Software": None})


def millimetres(metres: float | None, digits: int = 2) -> str:
    """A length for a table; a dash where there is none."""
    return "–" if metres is None or not math.isfinite(metres) else f"{1e3 * metres:.{digits}f}"


def mean_in_millimetres(row: Mapping[str, float | None]) -> str:
    """Mean and standard error of `measuring.error_row`, for a table."""
    spread = row["standard_error_m"]
    return millimetres(row["mean_m"]) + ("" if spread is None else f" ± {millimetres(spread)}")


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Aligned for the eye, too. The first column is text, the others are numbers."""
    lines = [list(head), *(list(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    padded = [
        "| " + " | ".join([line[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(line[1:], widths[1:], strict=True))]) + " |"
        for line in lines
    ]
    rule = "|" + "|".join(["-" * (widths[0] + 2), *("-" * (w + 1) + ":" for w in widths[1:])]) + "|"
    return "\n".join([padded[0], rule, *padded[1:]])
