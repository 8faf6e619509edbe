"""The notebook of the documentation runs on the example bag, and its page shows what it stores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import pytest

from helpers.paths import ROOT
from helpers.tools import tool

NOTEBOOK = ROOT / "docs" / "examples" / "bag_to_next_push.ipynb"


def kinds(cells: list[Any]) -> list[list[str]]:
    """Of each cell of code what its outputs are, such as a table or a picture."""
    return [
        [next(iter(sorted(output.get("data", {"stream": 0})))) for output in cell.outputs] for cell in cells if cell.cell_type == "code"
    ]


@pytest.mark.release
def test_notebook_runs_and_gives_outputs_like_those_it_stores() -> None:
    pytest.importorskip("nbclient")
    stored, run = nbformat.read(NOTEBOOK, as_version=4), tool("run_notebook").executed(NOTEBOOK)
    nbformat.validate(run)
    assert [cell.source for cell in run.cells] == [cell.source for cell in stored.cells]
    assert kinds(run.cells) == kinds(stored.cells)
    text = "".join(output.data["text/plain"] for cell in run.cells for output in cell.get("outputs", []) if "data" in output)
    assert "Identification(converged" in text and "Proposal(touch at" in text


def test_page_of_the_notebook_shows_its_pictures_and_tables_and_names_no_folder_of_this_machine() -> None:
    page, stored = tool("document_notebook").document(), NOTEBOOK.read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 5 and "<table>" in page and "```python\nfrom pathlib import Path" in page
    assert len(stored) < 600_000 and str(Path.home()) not in stored and "/tmp/" not in stored
