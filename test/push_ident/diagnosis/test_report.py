"""The page of a diagnosis: complete in one file, and readable where there is no verdict."""

from __future__ import annotations

import re
from pathlib import Path

from helpers.diagnosis import NOISE, simulated_pushes
from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.report import write_report


def test_page_says_where_why_how_far_and_what_to_do_next(tmp_path: Path) -> None:
    tilted = diagnose(simulated_pushes(8, 1, {"table_tilt": [0.02, 0.0]}))
    write_report(tmp_path / "report.html", tilted, object_id="o1", sources=["bag, push 0"])
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 2 and page.count('class="dot"') >= 3 * 8
    assert "odds of 150 to 1" in page and "°" in page and not re.search(r"\d rad\b", page)
    assert not re.findall(r"(?:src|href)=\"(?!#|data:)", page)
    parts = re.findall(r'<span class="part( negative)?" style="left:([\d.]+)%;width:([\d.]+)%', page.split('class="row"')[0])
    assert tilted.account is not None and len(parts) == len(tilted.account.parts)
    signed = sum((-1.0 if negative else 1.0) * float(width) for negative, _, width in parts)
    (total,) = re.findall(r'<span class="total" style="left:([\d.]+)%', page)
    assert abs(signed - float(total)) < 0.1
    for text in (
        "Components of the prediction error",
        "mean error on held-out pushes",
        "noise of the poses",
        "Where the gap lies",
        "What causes it",
        "Posterior probability of each cause",
        "How far the gap shrinks",
        "What to do next",
        "spirit level",
    ):
        assert text in page


def test_title_says_where_nothing_is_named_whether_that_is_known(tmp_path: Path) -> None:
    few = diagnose(simulated_pushes(4, 1, noise=NOISE / 3))
    write_report(tmp_path / "few.html", few, object_id="o1", sources=[])
    page = (tmp_path / "few.html").read_text(encoding="utf-8")
    assert few.account is not None and few.account.maps_are_open and few.first_push is not None
    assert "too few pushes to know</title>" in page and few.sentence.startswith("Nothing is found, and the pushes are too few to know")
    assert "would be needed" in page or "would tell" in page


def test_page_without_a_verdict_says_what_failed(tmp_path: Path) -> None:
    write_report(tmp_path / "untrusted.html", diagnose(simulated_pushes(2, 1)), object_id="o1", sources=[])
    page = (tmp_path / "untrusted.html").read_text(encoding="utf-8")
    assert "cannot be diagnosed" in page and "<svg" not in page
