"""Exports of OptiTrack Motive (CSV, Format Version 1.2x).

The first line has names and values in turn. Then follow a row each for the type and the name of what a column belongs to (ID and parent by
version), whether the column is rotation or position, and its axis. Rigid bodies are read; markers, errors and bones are not.

Angles are in degrees, about axes that turn with the body: XYZ is Rx Ry Rz. y is up, unless the export was given other axes, of which the
file says nothing. Source: docs.optitrack.com, "Data Export: CSV"; the order of angles is that of other readers of these files.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from pathlib import Path
from typing import Final

from push_ident.bags.importers.motion_capture.export import Attitude, Columns, Export
from push_ident.bags.importers.tables import UNITS, cells_of
from push_ident.errors import BagError
from push_ident.limits import plain_text

_LENGTHS: Final = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm"}
_ORDERS: Final = tuple("".join(order) for order in permutations("XYZ"))


def recognises(lines: Sequence[str]) -> bool:
    """Whether a file begins as an export, or as one whose head was cut off."""
    cells = lines[0].split(",")
    return cells[0] == "Format Version" or (cells[:2] == ["Frame", "Time (Seconds)"] and len(set(cells)) < len(cells))


def read(file: Path, lines: Sequence[str]) -> Export:
    """Rigid bodies of an export. Raises BagError for one of another form."""
    rows = cells_of(lines, ",", file)
    at_type = next((at for at, row in enumerate(rows) if "Rigid Body" in row), len(rows))
    at_axis = next((at for at, row in enumerate(rows) if row[:1] == ["Frame"] and at > at_type + 1), 0)
    at_time = next((at for at, name in enumerate(rows[at_axis]) if name.startswith("Time (")), None)
    if not at_axis or at_time is None:
        raise BagError(f"{file}: an export of Motive without a head that names rigid bodies; export it with header and rigid bodies.")
    head = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    _value(file, head, "Coordinate Space", ["Global"])
    length = UNITS[_LENGTHS[_value(file, head, "Length Units", list(_LENGTHS))]]
    kind = _value(file, head, "Rotation Type", ["Quaternion", *_ORDERS])
    columns: Columns = {}
    for at, (of, name, what, axis) in enumerate(zip(*(rows[i] for i in (at_type, at_type + 1, at_axis - 1, at_axis)), strict=False)):
        if of == "Rigid Body":
            columns.setdefault(name.strip(), {}).setdefault(f"{what} {axis}", at)

    return Export(
        columns,
        time=(at_time, 1.0),
        position={f"Position {axis}": length for axis in "XYZ"},
        attitude=Attitude(dict.fromkeys([f"Rotation {axis}" for axis in "XYZW"], 1.0)) if kind == "Quaternion" else _euler(kind),
        rows=rows[at_axis + 1 :],
        first_line=at_axis + 2,
        axes="x,-z,y",
    )


def _euler(order: str) -> Attitude:
    from scipy.spatial.transform import Rotation

    columns = dict.fromkeys([f"Rotation {axis}" for axis in order], UNITS["deg"])
    return Attitude(columns, lambda angles: Rotation.from_euler(order, angles).as_quat())


def _value(file: Path, head: dict[str, str], name: str, known: list[str]) -> str:
    got = head.get(name, "")
    if got not in known:
        raise BagError(f"{file}: {name} of Motive is `{plain_text(got)}`, expected {', '.join(known)}; export it with such a one.")
    return got
