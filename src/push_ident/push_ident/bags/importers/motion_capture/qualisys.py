"""Exports of Qualisys Track Manager (TSV, 6DOF).

Lines of a name and its values, of which `BODY_NAMES` has the bodies; then names of columns, and a row for each frame. A body has X, Y, Z
[mm], three angles in a convention that the user chooses, a residual, and its rotation matrix column by column, `Rot[0]` to `Rot[8]`; all
are zero or empty where it was lost. The matrix is read. z is up. Source: docs.qualisys.com and public exports, whose angles show that the
matrix is written by columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.bags.importers.motion_capture.export import Attitude, Columns, Export
from push_ident.bags.importers.tables import UNITS, cells_of
from push_ident.errors import BagError
from push_ident.limits import plain_text
from push_ident.types import Float64Array

_MATRIX: Final = tuple(f"Rot[{number}]" for number in range(9))
_ROUNDING: Final = 0.05
"""Largest deviation of R R^T from the identity: the matrices have five digits."""


def recognises(lines: Sequence[str]) -> bool:
    """Whether a file begins as an export."""
    return lines[0].split("\t")[0] in ("NO_OF_FRAMES", "FILE_VERSION")


def read(file: Path, lines: Sequence[str]) -> Export:
    """Bodies of an export. Raises BagError for one of another form, as one of markers only."""
    rows = cells_of(lines, "\t", file)
    at_names = next((at for at, row in enumerate(rows) if _MATRIX[0] in row), None)
    head = {row[0]: row[1:] for row in rows[:at_names] if row}
    if at_names is None or "BODY_NAMES" not in head:
        got = ", ".join(head.get("DATA_INCLUDED", ["no 6DOF data"]))
        raise BagError(f"{file}: an export of QTM with {got}, expected 6D with header and rotation matrices; export 6DOF data to TSV.")
    names, bodies = rows[at_names], [name for name in head["BODY_NAMES"] if name]
    starts = [at - 7 for at, name in enumerate(names) if name == _MATRIX[0]]
    if len(starts) != len(bodies) or "Time" not in names:
        raise BagError(
            f"{file}: an export of QTM with columns of {len(starts)} bodies, {'a' if 'Time' in names else 'no'} column Time and "
            f"{len(bodies)} BODY_NAMES, expected Time and one of each body; export it with column headers and time data."
        )
    columns: Columns = {}
    for body, start in zip(bodies, starts, strict=True):
        labels = ("X", "Y", "Z", *names[start + 3 : start + 7], *_MATRIX)
        if start < 0 or names[start : start + len(labels)] != [f"{body} X", *labels[1:]]:
            raise BagError(f"{file}: columns of {plain_text(body)} are not X, Y, Z, angles, residual, Rot[0] to Rot[8]; export them all.")
        columns[body] = {label: start + at for at, label in enumerate(labels)}
    return Export(
        columns,
        time=(names.index("Time"), 1.0),
        position={axis: UNITS["mm"] for axis in "XYZ"},
        attitude=Attitude(dict.fromkeys(_MATRIX, 1.0), _of_matrices),
        rows=rows[at_names + 1 :],
        first_line=at_names + 2,
    )


def _of_matrices(elements: Float64Array) -> Float64Array:
    """Zero where a matrix is no rotation, as where a body was lost."""
    from scipy.spatial.transform import Rotation

    transposed = np.clip(elements, -2.0, 2.0).reshape(-1, 3, 3)  # what is far off does not overflow
    matrix = transposed.transpose(0, 2, 1)
    is_turn = (np.abs(matrix @ transposed - np.eye(3)).max(axis=(1, 2)) < _ROUNDING) & (np.linalg.det(matrix) > 0.0)
    quaternion = np.zeros((len(matrix), 4))
    quaternion[is_turn] = Rotation.from_matrix(matrix[is_turn]).as_quat()
    return quaternion
