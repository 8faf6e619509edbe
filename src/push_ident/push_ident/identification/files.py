"""Files that are replaced as a whole, and JSON that every reader accepts."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

from push_ident.errors import ModelFileError

__all__ = ["finite", "json_text", "write_whole"]


def write_whole(path: Path, content: str | bytes, what: str) -> None:
    """Replace a file as a whole; the content is on the disk when the function returns. Raises ModelFileError, which names `what`."""
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise ModelFileError(f"Cannot write {what} to {path}: {error.strerror}; choose a folder with write permission.") from None


def json_text(content: dict[str, Any]) -> str:
    """JSON text; numbers that are not finite become null."""
    return json.dumps(finite(content), indent=1) + "\n"


def finite(value: Any) -> Any:
    """The value with None instead of numbers that are not finite."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
