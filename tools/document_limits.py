"""The page of the limits of what comes from outside, from `push_ident/limits.py`: `.venv/bin/python tools/document_limits.py`."""

from __future__ import annotations

import ast
import inspect

from push_ident import limits as module
from push_ident.limits import LIMITS, Limit

HEAD = """# Limits

Made from `push_ident/limits.py`. What a message, a bag or a file claims is compared with its limit before memory is taken or a loop
is started for it. What is beyond is refused with a line that names the limit; a node counts it in `/diagnostics`. No limit bounds the
length of a recording.
"""


def sections() -> dict[str, list[str]]:
    """Names of the limits by the comment lines that divide them in the source."""
    source = inspect.getsource(module)
    (body,) = (node for node in ast.parse(source).body if isinstance(node, ast.ClassDef) and node.name == LIMITS.__name__)
    names = {node.lineno: node.target.id for node in body.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)}
    found: dict[str, list[str]] = {}
    title = ""
    for number, line in enumerate(source.splitlines(), start=1):
        if line.strip().startswith("# ----"):
            title = line.strip(" #-")
        elif number in names:
            found.setdefault(title, []).append(names[number])
    return found


def shown(limit: Limit) -> str:
    return f"{limit.value:,} {limit.unit}".replace(",", "\N{NARROW NO-BREAK SPACE}", f"{limit.value:,}".count(","))


def document() -> str:
    """The page in Markdown."""
    parts = [HEAD]
    for title, names in sections().items():
        parts += [f"\n## {title.capitalize()}", "", "| name | at most | meaning | why |", "|---|---|---|---|"]
        for name in names:
            limit = getattr(LIMITS, name)
            parts.append(f"| `{name}` | {shown(limit)} | {limit.meaning.removesuffix(' is').removesuffix(' has')} | {limit.source} |")
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    print(document())
