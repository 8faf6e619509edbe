"""Tables, and figures as SVG, in one style."""

from __future__ import annotations

import io
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from push_ident.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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


def number(value: float | None, form: str, factor: float = 1.0) -> str:
    """A value in a format such as `{:.1f} s`; a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else form.format(factor * value)


def millimetres(metres: float | None, digits: int = 2) -> str:
    """A length in millimetres; a dash where there is none."""
    return number(metres, f"{{:.{digits}f}}", 1e3)


def mean_millimetres(row: Mapping[str, float | None]) -> str:
    """Mean and standard error of `measuring.error_row`."""
    spread = row["standard_error_m"]
    return millimetres(row["mean_m"]) + ("" if spread is None else f"±{millimetres(spread)}")


def share_text(row: Mapping[str, Any]) -> str:
    """Of `measuring.share`, such as `39/40 (87-100%)`."""
    return f"{row['successes']}/{row['n']} ({100 * row['low']:.0f}-{100 * row['high']:.0f}%)"


def causes_text(row: Mapping[str, int]) -> str:
    """Such as `2 UNHELD, 1 FELL`."""
    return ", ".join(f"{n} {end}" for end, n in row.items()) or "none"


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
