"""Write files that are complete at any moment, and JSON that every reader accepts."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

from push_ident.errors import ModelFileError

__all__ = ["finite", "json_text", "write_whole"]


def write_whole(path: Path, text: str, what: str) -> None:
    """Replace `path` by `text` at once, on the disk before it returns. Raises ModelFileError, naming `what`, where it cannot be written."""
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise ModelFileError(f"Cannot write {what} to {path}: {error.strerror}; choose a place that can be written to.") from None


def json_text(content: dict[str, Any]) -> str:
    """JSON in which numbers that are not finite are null: JSON has no others."""
    return json.dumps(finite(content), indent=1) + "\n"


def finite(value: Any) -> Any:
    """The same with None in the place of numbers that are not finite."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
