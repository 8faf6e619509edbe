"""The page of an identification: one file, complete; it states which pushes were held out and whether the fit converged."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from helpers.objects import hammer, random_records
from push_ident.identification.identify import identify
from push_ident.identification.online.identifier import running_record
from push_ident.identification.predicting.prediction import PushErrors, push_errors
from push_ident.identification.report import Provenance, write_report
from push_ident.identification.results.result import Identification
from push_ident.types import SolveStatus

RECORDS = random_records(hammer(3), 5, 3)
RESULT = identify(RECORDS[:3])
SOURCE = Provenance("o<1>", ("bag a, push 1", "bag a, push 2", "bag a, push 3"), ("two stamps repeated",))


def test_page_is_one_file_with_every_section(tmp_path: Path) -> None:
    page = _write(tmp_path, RESULT, _errors(RESULT, [3, 4]))
    assert not re.findall(r"(?:src|href)=\"(?!#|data:)|url\(\s*['\"]?https?:", page)
    assert page.count("<svg") == 6
    for text in ("2 pushes not used in the fit", "Next push", "bag a, push 2", "two stamps repeated", "push_ident 0.1.0"):
        assert text in page
    assert "o&lt;1&gt;" in page and "o<1>" not in page
    assert "Do not use these maps" not in page
    assert page == _write(tmp_path, RESULT, _errors(RESULT, [3, 4])), "the same result gives the same page"


def test_page_shows_what_was_predicted_before_each_push(tmp_path: Path) -> None:
    scores = running_record(RECORDS[:3])
    assert [score.number for score in scores] == [1, 2, 3] and scores[2].cell_error < scores[2].uniform_cell_error
    write_report(tmp_path / "page.html", RESULT, _errors(RESULT, [0, 1, 2]), _errors(RESULT, [3]), SOURCE, 0.01, scores)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 7 and "Predictions before each push" in page and "predicted from those before" not in page
    write_report(tmp_path / "page.html", RESULT, _errors(RESULT, [0, 1, 2]), _errors(RESULT, []), SOURCE, 0.01, scores)
    errors = [1e3 * np.mean([getattr(score, name) for score in scores]) for name in ("cell_error", "uniform_cell_error")]
    headline = f"3 pushes were predicted from those before to {errors[0]:.1f} mm, by equal cells with nominal values to {errors[1]:.1f} mm."
    assert headline in (tmp_path / "page.html").read_text(encoding="utf-8"), "the score where no push was held out"


def test_page_of_a_solve_that_failed_warns_first_and_says_that_no_push_was_held_out(tmp_path: Path) -> None:
    page = _write(tmp_path, replace(RESULT, status=SolveStatus.POOR_FIT), _errors(RESULT, []))
    assert page.index("Do not use these maps") < page.index("<svg")
    assert "No push was held out" in page and "not used in the fit" not in page


def _write(folder: Path, result: Identification, test: PushErrors) -> str:
    write_report(folder / "report.html", result, _errors(result, [0, 1, 2]), test, SOURCE, 0.015)
    return (folder / "report.html").read_text()


def _errors(result: Identification, pushes: list[int]) -> PushErrors:
    return push_errors(result, RECORDS, pushes)
