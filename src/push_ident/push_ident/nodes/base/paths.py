"""Paths that a service is given: checked before anything is written or read."""

from __future__ import annotations

import os
from pathlib import Path

from push_ident.errors import InputError
from push_ident.identification.results.model_file import is_model_file
from push_ident.limits import LIMITS, plain_text


def file_to_write(text: str) -> Path:
    """The path of a model that a client asks to write.

    Any process that reaches the service could otherwise replace any file of the user: so the name has to end with `.json`, and what is
    there already has to be a model.

    Raises InputError: the path is another one, or the folder is not there or cannot be written to.
    """
    path = _path(text)
    if path.suffix != ".json":
        raise InputError(f"The path is {plain_text(text)!r}, expected the name of a model, which ends with .json.")
    if os.path.islink(path) or (os.path.exists(path) and not is_model_file(path)):
        raise InputError(f"{plain_text(str(path))} exists and is no model of push_ident; it is not replaced, choose another name.")
    if not os.path.isdir(path.parent):
        raise InputError(f"There is no folder {plain_text(str(path.parent))}; make it first.")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(f"Nothing may be written to {plain_text(str(path.parent))}; choose another folder.")
    return path


def file_to_read(text: str) -> Path:
    """The path; raises InputError unless it names a file that is there."""
    path = _path(text)
    if not os.path.isfile(path):
        raise InputError(f"There is no file {plain_text(str(path))}.")
    return path


def _path(text: str) -> Path:
    LIMITS.STRING.check(len(text), "Path")
    if not text.strip() or "\0" in text:
        raise InputError(f"The path is {plain_text(text)!r}, expected that of a file.")
    # Unlike those of Path, these functions raise for no text.
    path = Path(os.path.expanduser(text))
    if os.path.isdir(path):
        raise InputError(f"{plain_text(str(path))} is a folder, expected a file.")
    return path
