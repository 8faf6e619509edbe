"""Which program a file is from, and the poses of one body in it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from push_ident.bags.importers.motion_capture import motive, qualisys, vicon
from push_ident.bags.importers.tables import Table, read_text, table_of
from push_ident.errors import BagError
from push_ident.limits import plain_text

_PROGRAMS: Final = (motive, vicon, qualisys)
_BODY: Final = "#"
"""Separates a file from the name of the body that is meant."""


def read_body(path: Path) -> Table:
    """Table of poses: a file with names of columns, or of a motion capture program; of one of its bodies as `FILE#BODY`.

    Raises BagError for another file, for a body that is not in it, or where several are and none is named.
    """
    file, body = _split(path)
    lines = read_text(file).rstrip("\r\n").splitlines()
    for program in _PROGRAMS:
        if lines and program.recognises(lines):
            return program.read(file, lines).table(file, body)
    if body:
        raise BagError(f"{file}: a table of one body, expected no name of a body; leave {_BODY}{plain_text(body)} out.")
    return table_of(file, lines)


def _split(path: Path) -> tuple[Path, str]:
    """File and body; a file may have the sign in its name."""
    text = str(path)
    ends = [len(text), *(at for at, sign in enumerate(text) if sign == _BODY)]
    end = next((at for at in ends if os.path.isfile(text[:at])), len(text))
    return Path(text[:end]), text[end + 1 :]
