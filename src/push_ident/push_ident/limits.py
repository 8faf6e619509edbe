"""How much the package takes from outside, in messages and in bags: what claims more is refused by its claim, before memory or time is
spent on it. A cell on a table needs far less than any of these."""

from __future__ import annotations

import math
import re
from typing import Final

from push_ident.errors import InputError

__all__ = [
    "MAX_CELLS",
    "MAX_DESCRIPTION",
    "MAX_FORCE",
    "MAX_GRID_ENTRIES",
    "MAX_JOINTS",
    "MAX_LENGTH",
    "MAX_NAME",
    "MAX_PIXELS",
    "MAX_POSES",
    "MAX_STAMP",
    "MAX_TEXT",
    "MAX_VERTICES",
    "check_count",
    "check_object_id",
    "check_stamp",
    "plain_text",
]

MAX_CELLS: Final = 2_500
"""Cells of one object. 2,000 is the most that `cell_count` aims at; the covariance of the maps then has 4,000 x 4,000 entries."""
MAX_GRID_ENTRIES: Final = 1_000_000
"""Entries of the grid that holds the cells of one object, empty ones included: a thin object that lies diagonally has many of those."""
MAX_VERTICES: Final = 5_000
"""Vertices of one outline: contact is searched over all of its edges at every step."""
MAX_PIXELS: Final = 8_300_000
"""Pixels of a depth image: 3840 x 2160, above any depth camera on the market."""
MAX_JOINTS: Final = 100
"""Joints in one joint state or trajectory."""
MAX_POSES: Final = 10_000
"""Poses of one path, or points of one trajectory: 100 s at 100 Hz."""
MAX_LENGTH: Final = 100.0
"""Largest coordinate or length of anything in the cell [m]. Beyond, squares and products lose the millimetres."""
MAX_FORCE: Final = 1e5
"""Largest component of a force [N]."""
MAX_STAMP: Final = 2**31 - 1
"""Latest stamp [s]: seconds are 32-bit integers in ROS."""
MAX_NAME: Final = 100
"""Characters of an id or a name. ROS allows 255 for a whole topic name."""
MAX_TEXT: Final = 400
"""Characters of foreign text that are repeated in a log, a status or a page."""
MAX_DESCRIPTION: Final = 5_000_000
"""Characters of a robot description."""

_ID: Final = re.compile(r"[A-Za-z0-9_]+")
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ud800-\udfff\ufeff]")


def check_count(what: str, got: int, most: int, least: int = 0) -> None:
    """Raise InputError unless `least` <= `got` <= `most`; `what` begins the text, such as `Cells of object_o1`."""
    if not least <= got <= most:
        raise InputError(f"{plain_text(what)}: {got:,}, expected {least:,} to {most:,}.")


def check_stamp(seconds: float) -> None:
    """Raise InputError for a stamp [s] that no clock of ROS can give."""
    if not (math.isfinite(seconds) and 0 <= seconds < MAX_STAMP + 1):
        raise InputError(f"Stamp is {seconds:g} s, expected 0 to {MAX_STAMP} s; check the clock of its source.")


def check_object_id(text: str) -> str:
    """The same text; raises InputError unless it can stand in the name of a topic: letters, digits and underscores."""
    if len(text) > MAX_NAME or not _ID.fullmatch(text):
        raise InputError(
            f"Object id is {plain_text(text, 60)!r}, expected at most {MAX_NAME} letters, digits and underscores, as in a topic's name."
        )
    return text


def plain_text(text: str, most: int = MAX_TEXT) -> str:
    """Foreign text for one line of a log or a status: no control characters, at most `most` characters."""
    shown = _CONTROL.sub("\N{REPLACEMENT CHARACTER}", text[: most + 1])
    return shown if len(text) <= most else shown[: most - 1] + "…"
