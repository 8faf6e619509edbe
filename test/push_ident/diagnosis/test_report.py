"""The page of a diagnosis: complete in one file, and readable where there is no verdict."""

from __future__ import annotations

import re
from pathlib import Path

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.report import write_report


def test_page_says_where_why_how_far_and_what_to_do_next(tmp_path: Path) -> None:
    tilted = diagnose(simulated_pushes(8, 1, {"table_tilt": [0.02, 0.0]}))
    write_report(tmp_path / "report.html", tilted, object_id="o1", sources=["bag, push 0"])
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") >= 4
    assert not re.findall(r"(?:src|href)=\"(?!#|data:)", page)
    for text in ("Where the gap lies", "What causes it", "How far the gap shrinks", "What to do next", "spirit level"):
        assert text in page


def test_page_without_a_verdict_says_what_failed(tmp_path: Path) -> None:
    write_report(tmp_path / "untrusted.html", diagnose(simulated_pushes(2, 1)), object_id="o1", sources=[])
    page = (tmp_path / "untrusted.html").read_text(encoding="utf-8")
    assert "cannot be diagnosed" in page and "<svg" not in page
