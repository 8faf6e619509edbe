"""Exports of Vicon Tracker and Nexus (CSV).

A section has a title, its rate [Hz], names of bodies (each over the first of its columns), names of columns, units, and a row for each
frame up to an empty line. Bodies are in `Objects` (Tracker) and `Segments` (Nexus); sections before them are passed over. z is up.

With RW, an attitude is a quaternion. Without it RX, RY, RZ are a rotation vector ("helical", the default) or, where the user chose so,
Euler angles Rx Ry Rz; the file does not say which. They are read as a rotation vector: where the z axis of the body is up, the yaw is the
same to second order in its tilt (within 0.1 degrees at a tilt of 2 degrees). Source: public exports and programs that read them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Final

from push_ident.bags.importers.motion_capture.export import Attitude, Columns, Export
from push_ident.bags.importers.tables import UNITS, cells_of
from push_ident.errors import BagError
from push_ident.limits import plain_text
from push_ident.types import Float64Array

_BODIES: Final = ("Objects", "Segments")
_HEAD: Final = 5
"""Lines of a section before its first frame."""
_TITLES: Final = (*_BODIES, "Trajectories", "Joints", "Model Outputs", "Devices", "Events")


def recognises(lines: Sequence[str]) -> bool:
    """Whether a file begins with the title of a section."""
    return _text(lines[0]) in _TITLES


def read(file: Path, lines: Sequence[str]) -> Export:
    """Bodies of the first section that has some. Raises BagError for a file of another form, as one of markers only."""
    start = next((at for at, line in enumerate(lines) if _text(line) in _BODIES), None)
    if start is None:
        titles = ", ".join(dict.fromkeys(text for line in lines if (text := _text(line)) in _TITLES))
        raise BagError(
            f"{file}: an export of Vicon with {titles}, expected {' or '.join(_BODIES)}, which hold attitudes; in Nexus make the markers "
            "a subject with one segment and export Segments, or export Objects from Tracker."
        )
    end = next((at for at in range(start, len(lines)) if not _text(lines[at])), len(lines))
    section = cells_of(lines[start:end], ",", file)
    if len(section) < _HEAD:
        raise BagError(f"{file}: {_text(lines[start])} of Vicon has {len(section)} lines, expected {_HEAD} and the frames; it was cut off.")
    _, rate, names, labels, units = section[:_HEAD]
    seconds = 1.0 / _rate(file, rate[0])
    unit_of = dict(zip(labels, units, strict=False))

    def unit(label: str, known: Sequence[str]) -> float:
        got = unit_of.get(label, "")
        if got not in known:
            raise BagError(
                f"{file}: unit of {label} of Vicon is `{plain_text(got)}`, expected {', '.join(known)}; export it in one of them."
            )
        return UNITS[got]

    columns: Columns = {}
    body = ""
    for at, (name, label) in enumerate(zip_longest(names, labels, fillvalue="")):
        body = name.strip().removeprefix("Global Angle ") or body
        columns.setdefault(body, {}).setdefault(label, at)
    if "RW" in labels:
        attitude = Attitude(dict.fromkeys(("RX", "RY", "RZ", "RW"), 1.0))
    else:
        attitude = Attitude({label: unit(label, ("rad", "deg")) for label in ("RX", "RY", "RZ")}, _of_rotation_vectors)
    return Export(
        columns,
        time=(0, seconds),
        position={label: unit(label, ("mm", "cm", "m")) for label in ("TX", "TY", "TZ")},
        attitude=attitude,
        rows=section[_HEAD:],
        first_line=start + _HEAD + 1,
    )


def _text(line: str) -> str:
    """Without the empty cells of a line."""
    return line.strip(', \t"')


def _rate(file: Path, text: str) -> float:
    """[Hz]"""
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0.0 < rate < math.inf:
        raise BagError(f"{file}: rate of Vicon is `{plain_text(text)}`, expected frames per second on the line after the title.")
    return rate


def _of_rotation_vectors(vectors: Float64Array) -> Float64Array:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_quat()
