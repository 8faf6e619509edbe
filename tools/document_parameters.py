"""Write docs/parameters.md from the tables in the nodes: `.venv/bin/python tools/document_parameters.py`; `--check` only compares."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from push_ident.nodes.executables import NODES
from push_ident_sim.executables import NODES as SIM_NODES

TARGET = Path(__file__).resolve().parent.parent / "docs" / "parameters.md"


def table_of(node: str, module: str) -> str:
    lines = [f"## {node}", "", "| parameter | default | range | what |", "|---|---|---|---|"]
    for row in importlib.import_module(module).PARAMETERS:
        limits = ", ".join(row.choices) or ("" if row.minimum is None else f"{row.minimum:g} … {row.maximum:g}")
        fixed = " (read-only)" if row.read_only else ""
        lines.append(f"| `{row.name}` | `{row.default}` | {limits} | {row.description}{fixed} |")
    return "\n".join(lines)


def document() -> str:
    head = "# Parameters of the nodes\n\nWritten by `tools/document_parameters.py` from the tables in the nodes.\n"
    return "\n".join([head, *(table_of(node, module) + "\n" for node, module in {**NODES, **SIM_NODES}.items())])


def main() -> None:
    if "--check" in sys.argv:
        sys.exit(0 if TARGET.is_file() and TARGET.read_text(encoding="utf-8") == document() else f"{TARGET} is out of date; run {__file__}")
    TARGET.write_text(document(), encoding="utf-8")


if __name__ == "__main__":
    main()
