"""Figures of the results pages, in one style, as SVG."""

from __future__ import annotations

import io
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

from push_ident.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "label_below", "log_millimetres", "new_figure", "save"]

COLOURS: Final = defaultdict(
    lambda: "#e69f00",
    {
        "gauss_newton": "#0072b2",
        "fast_gradient": "#d55e00",
        "autograd": "#009e73",
        "finite_differences": "#cc79a7",
        "random_search": "#7f7f7f",
        "weighted_sampling": "#b8860b",
    },
)
"""Each solver has one colour in all figures, distinct for readers with red-green blindness; solvers without an entry share one."""


def new_figure(columns: int, rows: int = 1, width: float = 4.6, height: float = 3.8) -> tuple[Figure, list[Axes]]:
    """A figure and its panels, row by row; `width` and `height` of a panel in inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def log_millimetres(ax: Axes, label: str, low: float, high: float) -> None:
    """Logarithmic axis of errors [mm] from `low` to `high` with plain numbers."""
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)


def label_below(ax: Axes, columns: int) -> None:
    """Legend below the panel, where it covers nothing."""
    ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=columns, frameon=False)


def save(figure: Figure, path: Path) -> None:
    """Write an SVG that is the same each time; raises InputError where it cannot be written."""
    from matplotlib import rc_context

    text = io.StringIO()
    # Text as text, which is small and can be searched; names of parts from a fixed salt instead of a random one.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": path.name}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    write_whole(path, text.getvalue(), "the figure")
