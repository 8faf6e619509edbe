"""The page of the decision policy, from `diagnosis/policy.py`: `.venv/bin/python tools/document_policy.py`."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from push_ident.diagnosis import policy as module
from push_ident.diagnosis.policy import DecisionPolicy

HEAD = """# Decision policy

Made from `diagnosis/policy.py`. How the stages use these numbers: [How a diagnosis decides](../concepts/diagnosis.md).
"""


def meanings() -> dict[str, dict[str, str]]:
    """Of the fields of each class, from the texts below them; the text of the class itself under its own name."""
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    found: dict[str, dict[str, str]] = {}
    for node in tree.body:
        if not isinstance(node, ast.ClassDef):
            continue
        texts = {node.name: ast.get_docstring(node) or ""}
        for field, text in zip(node.body, node.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
                texts[field.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
        found[node.name] = texts
    return found


def shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{number:g} {unit or '(no unit)'}" for unit, number in value.items())
    return ", ".join(f"{number:g}" for number in (value if isinstance(value, tuple) else (value,)))


def document() -> str:
    """The page in Markdown."""
    texts, policy = meanings(), DecisionPolicy()
    intro = " ".join((module.__doc__ or "").split("\n\n", 1)[1].split("\n\n", 1)[0].split())
    sources = (module.__doc__ or "").split("\n\n")[2]
    parts = [HEAD, intro, "\n" + sources, ""]
    for section in fields(policy):
        stage = getattr(policy, section.name)
        name = type(stage).__name__
        parts += [
            f"\n## {section.name.replace('_', ' ').capitalize()}",
            "",
            texts[name][name],
            "",
            "| field | value | meaning, unit, evidence |",
            "|---|---|---|",
        ]
        for field in fields(stage):
            parts.append(f"| `{field.name}` | {shown(getattr(stage, field.name))} | {texts[name].get(field.name, '')} |")
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    print(document())
