"""The page of the notebook: its text, its code, and the outputs that are stored in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat

NOTEBOOK = Path(__file__).resolve().parent.parent / "docs" / "examples" / "bag_to_next_push.ipynb"


def document() -> str:
    """Markdown of the page, made without running anything; `tools/run_notebook.py` stores the outputs."""
    parts = []
    for cell in nbformat.read(NOTEBOOK, as_version=4).cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
        else:
            parts.append(f"```python\n{cell.source}\n```")
            parts += [_output(output) for output in cell.outputs]
    return "\n\n".join(parts) + f"\n\nThe notebook itself: [{NOTEBOOK.name}]({NOTEBOOK.name})\n"


def _output(output: Any) -> str:
    """One output; of several forms that which a browser shows best."""
    if output.output_type == "stream":
        return f"```text\n{output.text.rstrip()}\n```"
    data = output.data
    if "image/png" in data:
        return f'<img alt="{data["text/plain"].strip("<>")}" src="data:image/png;base64,{"".join(data["image/png"].split())}">'
    return str(data["text/html"]) if "text/html" in data else f"```text\n{data['text/plain']}\n```"
