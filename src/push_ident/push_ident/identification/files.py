"""Write files so that a reader, or a kill, never meets half of one."""

from __future__ import annotations

import os
from pathlib import Path

from push_ident.errors import ModelFileError

__all__ = ["write_whole"]


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
