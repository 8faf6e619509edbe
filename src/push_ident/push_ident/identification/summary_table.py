"""An identification as a table for notebooks."""

from __future__ import annotations

from push_ident.identification.identifiability import identifiability
from push_ident.identification.quantity_text import before_text, value_text
from push_ident.identification.result import Identification
from push_ident.pages.tables import html_table

__all__ = ["summary_table"]


def summary_table(result: Identification) -> str:
    """The named quantities, each with its standard deviation before and after the pushes; first how the solve ended."""
    known = identifiability(result.posterior)
    rows = [(q.name, value_text(q), before_text(q), q.knowledge.value.partition(":")[0]) for q in known.quantities]
    return html_table(
        f"{len(result.model.mass)} cells, {result.method}: {result.status.value}",
        ("quantity", "value", "before the pushes", "identifiability"),
        rows,
        note=f"Of {len(known.combinations)} combinations of the cells, {known.n_pinned} are pinned down and {known.n_open} hardly "
        f"constrained. {result.n_simulations} simulations in {result.time_s:.2f} s.",
    )
