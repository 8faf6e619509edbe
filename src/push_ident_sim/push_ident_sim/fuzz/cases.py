"""Failures that were found once, as small files: what was sent to which node."""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path
from typing import Any

from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident_sim.fuzz.bench import Sent
from push_ident_sim.fuzz.fields import interface_class
from push_ident_sim.fuzz.session import Finding

__all__ = ["read_case", "read_cases", "write_case"]


def write_case(path: Path, finding: Finding, messages: list[Sent]) -> None:
    """Write a finding with the messages that cause it."""
    content = {
        "node": finding.node,
        "failure": finding.text.strip()[:400],
        "messages": [
            {
                "to": sent.to,
                "type": _type_of(sent),
                "cdr": base64.b64encode(zlib.compress(sent.data, 9)).decode(),
                **({"valid": True} if sent.valid else {}),
            }
            for sent in messages
        ],
    }
    write_whole(path, json.dumps(content, indent=1) + "\n", "the case")


def _type_of(sent: Sent) -> str:
    module = sent.kind.__module__.split(".")
    name = sent.kind.__name__
    for part in ("SendGoal", "GetResult"):
        name = name.replace(f"{part}Service", part)
    return f"{module[0]}/{module[1]}/{name}"


def read_case(path: Path) -> tuple[str, list[Sent]]:
    """The node and the messages of a file. Raises InputError where it is none."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        messages = [
            Sent(
                item["to"],
                interface_class(item["type"]),
                zlib.decompress(base64.b64decode(item["cdr"])),
                valid=bool(item.get("valid")),
                is_request="/msg/" not in item["type"],
            )
            for item in content["messages"]
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ImportError, zlib.error) as error:
        raise InputError(f"{path} is no case of the fuzzer: {error}.") from None
    return str(content["node"]), messages


def read_cases(folder: Path) -> dict[str, list[Sent]]:
    """All messages of the cases in a folder, by node."""
    cases: dict[str, list[Sent]] = {}
    for path in sorted(folder.glob("*.json")):
        node, messages = read_case(path)
        cases.setdefault(node, []).extend(messages)
    return cases
