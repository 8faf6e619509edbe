"""Run the notebook of the documentation and store it with its outputs: python tools/run_notebook.py [NOTEBOOK] [--out FILE]."""

from __future__ import annotations

import argparse
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOK = ROOT / "docs" / "examples" / "bag_to_next_push.ipynb"
LONGEST = 300
"""Of one cell [s]; kernels may have to be compiled first."""


def executed(path: Path) -> nbformat.NotebookNode:
    """The notebook with the outputs of a run from its own folder. Raises `nbclient.exceptions.CellExecutionError` where a cell fails."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=LONGEST, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}).execute()
    for cell in notebook.cells:  # when it ran differs each time
        cell.metadata.pop("execution", None)
    notebook.metadata["language_info"] = {"name": "python"}
    return notebook


def main() -> None:
    """Run it and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("notebook", nargs="?", type=Path, default=NOTEBOOK)
    parser.add_argument("--out", type=Path, help="default: over the notebook itself")
    given = parser.parse_args()
    nbformat.write(executed(given.notebook), given.out or given.notebook)


if __name__ == "__main__":
    main()
