"""What the exports of all motion capture programs have: bodies with names, of which one becomes a table of poses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from push_ident.bags.importers.tables import Table, numbers
from push_ident.errors import BagError
from push_ident.limits import plain_text
from push_ident.types import Float64Array

Columns = dict[str, dict[str, int]]
"""Name of a body -> name of a column of it -> number of that column."""


@dataclass(frozen=True, slots=True)
class Attitude:
    """How an export writes attitudes."""

    columns: Mapping[str, float]
    """Names of its columns, each with its unit [rad; 1 without]."""
    quaternions: Callable[[Float64Array], Float64Array] = lambda quaternion: quaternion
    """Quaternions (x, y, z, w), shape (n, 4), of the numbers in these columns, shape (n, n_columns); zeros for what is no attitude."""


@dataclass(frozen=True, slots=True)
class Export:
    """Content of an export."""

    columns: Columns
    """Of each body."""
    time: tuple[int, float]
    """Number of the column of time, and its unit [s]."""
    position: Mapping[str, float]
    """Names of the columns of x, y, z, each with its unit [m]."""
    attitude: Attitude
    rows: Sequence[Sequence[str]]
    """Cells of each frame; one that a row lacks is empty."""
    first_line: int
    """Number of the line of the first row."""
    axes: str = "x,y,z"
    """Axes of the file that are x, y and z of the table frame, as of `parse_axes`."""

    def table(self, file: Path, body: str) -> Table:
        """Poses of the body with this name [m, s], or of the only one for ""; NaN where it was lost. Raises BagError for other names."""
        needed = {**self.position, **self.attitude.columns}
        body = self._chosen(file, body, needed)
        columns = [
            ("time", *self.time),
            *((f"{name} of {plain_text(body)}", self.columns[body][name], unit) for name, unit in needed.items()),
        ]
        lines = range(self.first_line, self.first_line + len(self.rows))
        values = np.column_stack(
            [unit * numbers([row[at] if at < len(row) else "" for row in self.rows], lines, file, name) for name, at, unit in columns]
        )
        is_tracked = np.isfinite(values).all(axis=1)
        poses = np.full((len(values), 8), np.nan)
        poses[:, 0] = values[:, 0]
        if is_tracked.any():
            quaternion = self.attitude.quaternions(values[is_tracked, 4:])
            tracked = np.column_stack([values[is_tracked, 1:4], quaternion])
            poses[is_tracked, 1:] = np.where(quaternion.any(axis=1, keepdims=True), tracked, np.nan)
        return Table(
            Path(f"{file}#{plain_text(body)}"),
            ("time [s]", "x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw"),
            poses,
            lines,
            axes=self.axes,
        )

    def _chosen(self, file: Path, body: str, needed: Collection[str]) -> str:
        bodies = [name for name, own in self.columns.items() if own.keys() >= set(needed)]
        if not bodies:
            raise BagError(f"{file}: no body has all of {', '.join(needed)}; export position and rotation of rigid bodies.")
        if body in bodies or (not body and len(bodies) == 1):
            return body or bodies[0]
        got, listed = f"no body `{plain_text(body)}`" if body else f"{len(bodies)} bodies", ", ".join(map(plain_text, bodies))
        raise BagError(f"{file}: {got}, expected one of {listed}; name it as '{file.name}#{plain_text(bodies[0])}'.")
