"""Folders of effects beside those of this package: `PUSH_IDENT_EFFECTS`, a list of folders separated as in PATH.

Every `.py` file in such a folder holds one effect as `EFFECT`, like the files of `effects/`, and is a full member of the catalogue. The
variable has to be set before the first import of this package, in every process that simulates.
"""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["VARIABLE", "extra_effect_files", "extra_effect_folders"]

VARIABLE = "PUSH_IDENT_EFFECTS"


def extra_effect_folders() -> list[Path]:
    """The folders that the environment names.

    Raises:
        ImportError: one of them does not exist.
    """
    folders = [Path(part).expanduser().resolve() for part in os.environ.get(VARIABLE, "").split(os.pathsep) if part]
    for folder in folders:
        if not folder.is_dir():
            raise ImportError(f"{VARIABLE} names {folder}, which is no folder; correct the variable, or unset it.")
    return folders


def extra_effect_files() -> list[Path]:
    """The files in those folders, in a fixed order."""
    return [file for folder in extra_effect_folders() for file in sorted(folder.glob("*.py"))]
