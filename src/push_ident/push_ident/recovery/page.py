"""The page of a self-test."""

from __future__ import annotations

from pathlib import Path

from push_ident.pages.page import write_page
from push_ident.recovery.run import SelfTest
from push_ident.recovery.wording import can_tell, cannot_tell, effect_rows, proof_text, quantity_rows, selftest_json, would_help


def write_selftest_page(path: Path, test: SelfTest, *, title: str = "these pushes") -> None:
    """Write the page (HTML). Raises InputError where it cannot be written."""
    context = selftest_json(test) | {
        "title": f"What {title} can tell",
        "lists": (("What they tell", can_tell(test)), ("What they do not tell", cannot_tell(test)), ("What would help", would_help(test))),
        "rows": quantity_rows(test),
        "effect_rows": effect_rows(test),
        "proof_texts": [proof_text(proof) for proof in test.proofs],
    }
    write_page(path, __package__, "selftest.html.j2", context)
