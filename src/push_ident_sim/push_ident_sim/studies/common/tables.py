"""Tables in one style."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

__all__ = ["causes_text", "markdown_table", "mean_millimetres", "millimetres", "number", "share_text"]


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
