"""The robot description from a file, for nodes whose parameter `robot_description_file` names one."""

from __future__ import annotations

from pathlib import Path

from push_ident.errors import InputError
from push_ident.files import read_regular
from push_ident.limits import LIMITS, plain_text

__all__ = ["description_in"]


def description_in(file: str) -> str:
    """Text of a URDF. Raises InputError where the file cannot be read."""
    try:
        return read_regular(Path(file), LIMITS.DESCRIPTION.value).decode()
    except (OSError, ValueError) as error:
        raise InputError(f"Parameter robot_description_file is {plain_text(file)}: {plain_text(str(error))}; give a URDF.") from None
