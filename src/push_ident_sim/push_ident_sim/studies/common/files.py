"""Results as JSON files."""

from __future__ import annotations

import json
from pathlib import Path

from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident_sim.studies.common.study import Json

__all__ = ["read_json", "write_json"]


def write_json(path: Path, content: Json) -> None:
    """Write whole or not at all. Raises PushIdentError where it cannot be written, ValueError for numbers that are not finite."""
    write_whole(path, json.dumps(content, separators=(",", ":"), allow_nan=False) + "\n", "the result")


def read_json(path: Path) -> Json:
    """Read a result. Raises InputError where it cannot be read."""
    try:
        content: Json = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the result {path}: {error}; delete it and run the study again.") from None
    return content
