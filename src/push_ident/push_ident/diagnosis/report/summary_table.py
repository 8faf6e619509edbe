"""A diagnosis as a table for notebooks."""

from __future__ import annotations

from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.wording import size_of
from push_ident.pages.tables import html_table

__all__ = ["summary_table"]


def summary_table(diagnosis: Diagnosis) -> str:
    """The verdict in words, the effects that were found, and what would resolve what is open."""
    rows = [(e.name, size_of(e), f"{e.log_bayes_factor:.1f}") for e in diagnosis.effects]
    failed = " ".join(f"{gate.found}: {gate.remedy}" for gate in diagnosis.gates if not gate.passed)
    note = " ".join(text for text in (failed, f"Without a push: {diagnosis.check}" if diagnosis.check else "") if text)
    return html_table(
        f"{diagnosis.verdict.value}: {diagnosis.sentence}",
        ("effect", "size", "log Bayes factor (5: odds of 150 to 1)"),
        rows,
        note=note,
    )
