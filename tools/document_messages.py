"""The page of messages, services and actions, from their definitions: `.venv/bin/python tools/document_messages.py`."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "src" / "push_ident_msgs"
KINDS = {"msg": "Messages", "srv": "Services", "action": "Actions"}
HEAD = """# Messages, services, actions

Made from the definitions in `src/push_ident_msgs`. Everything else on the wire is a standard message; the topics are on the page
[Nodes](nodes.md). Lengths are in metres, angles in radians.
"""


def section_of(path: Path) -> str:
    """A definition as it stands, with its first comment as text."""
    lines = path.read_text(encoding="utf-8").splitlines()
    what = []
    while lines and lines[0].startswith("#"):
        what.append(lines.pop(0).lstrip("# "))
    definition = "\n".join(lines).strip("\n")
    return f"### {path.stem}\n\n{' '.join(what)}\n\n```text\n{definition}\n```\n"


def document() -> str:
    """The page in Markdown."""
    parts = [HEAD]
    for kind, title in KINDS.items():
        parts += [f"## {title}\n", *(section_of(path) for path in sorted((PACKAGE / kind).glob(f"*.{kind}")))]
    return "\n".join(parts)


if __name__ == "__main__":
    print(document())
