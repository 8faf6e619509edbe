"""Write docs/parameters.md from the tables in the nodes: `.venv/bin/python tools/document_parameters.py`; `--check` only compares."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

TARGET = Path(__file__).resolve().parent.parent / "docs" / "parameters.md"
TABLES = {
    "perception_node": ("push_ident.nodes.perception.perception_node", "PARAMETERS"),
    "push_executor_node": ("push_ident.nodes.push_executor.parameters", "PARAMETERS"),
    "identification_node": ("push_ident.nodes.identification.identification_node", "PARAMETERS"),
    "gap_diagnosis_node": ("push_ident.nodes.gap_diagnosis.gap_diagnosis_node", "PARAMETERS"),
    "bag_player_node": ("push_ident.nodes.bag_player_node", "PARAMETERS"),
    "bag_recorder_node": ("push_ident.nodes.bag_recorder_node", "PARAMETERS"),
    "viewer_node": ("push_ident.nodes.viewer.viewer_node", "PARAMETERS"),
    "sim_cell_node": ("push_ident_sim.sim_cell_node", "PARAMETERS"),
    "sim_hand_node": ("push_ident_sim.sim_hand_node", "PARAMETERS"),
}


def table_of(node: str) -> str:
    module, name = TABLES[node]
    lines = [f"## {node}", "", "| parameter | default | range | what |", "|---|---|---|---|"]
    for row in getattr(importlib.import_module(module), name):
        limits = ", ".join(row.choices) or ("" if row.minimum is None else f"{row.minimum:g} … {row.maximum:g}")
        fixed = " (read-only)" if row.read_only else ""
        lines.append(f"| `{row.name}` | `{row.default}` | {limits} | {row.description}{fixed} |")
    return "\n".join(lines)


def document() -> str:
    head = "# Parameters of the nodes\n\nWritten by `tools/document_parameters.py` from the tables in the nodes.\n"
    return "\n".join([head, *(table_of(node) + "\n" for node in TABLES)])


def main() -> None:
    if "--check" in sys.argv:
        sys.exit(0 if TARGET.is_file() and TARGET.read_text(encoding="utf-8") == document() else f"{TARGET} is out of date; run {__file__}")
    TARGET.write_text(document(), encoding="utf-8")


if __name__ == "__main__":
    main()
