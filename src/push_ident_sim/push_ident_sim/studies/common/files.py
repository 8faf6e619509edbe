"""Results as JSON files."""

from __future__ import annotations

import json
import os
from pathlib import Path

from push_ident.errors import InputError, PushIdentError
from push_ident_sim.studies.common.base import Json

__all__ = ["read_json", "write_json"]


def write_json(path: Path, content: Json) -> None:
    """Write whole or not at all. Raises PushIdentError where it cannot be written, ValueError for numbers that are not finite."""
    partial = path.with_suffix(f".{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(json.dumps(content, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise PushIdentError(f"Cannot write {path}: {error.strerror}; choose a folder with write permission.") from None


def read_json(path: Path) -> Json:
    """Read a result. Raises InputError where it cannot be read."""
    try:
        content: Json = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the result {path}: {error}; delete it and run the study again.") from None
    return content
