"""Tables of numbers in text files (CSV): columns by name, any common separator, units as the user states them."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.errors import BagError, InputError
from push_ident.files import read_regular
from push_ident.limits import LIMITS, plain_text
from push_ident.types import Float64Array

_SEPARATORS: Final = (";", "\t", ",")
"""In the order in which they are looked for in the first line; where none is there, spaces separate."""
_STATED: Final = re.compile(r'"?sep=([;,|\t])"?', re.IGNORECASE)
"""First line with which Excel states the separator."""

_USUAL: Final[Mapping[str, tuple[str, ...]]] = {
    "time": ("t", "stamp", "timestamp"),
    "yaw": ("theta", "heading"),
    **{f"q{axis}": (f"quat_{axis}", f"orientation_{axis}", f"orientation.{axis}", f"rot_{axis}") for axis in "xyzw"},
    **{axis: (f"pos_{axis}", f"position_{axis}", f"position.{axis}", f"p{axis}", f"t{axis}") for axis in "xyz"},
}
"""Other names of a role that are understood without an option, in lower case."""
UNITS: Final[Mapping[str, float]] = {
    **{"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    **{"rad": 1.0, "deg": float(np.pi / 180.0), "°": float(np.pi / 180.0)},
    **{"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
}
"""Metres, radians or seconds of each unit."""
_UNIT: Final = re.compile(rf"(?P<name>.*?)(?:_| *\[| *\()(?P<unit>{'|'.join(UNITS)})[\])]?")


@dataclass(frozen=True, slots=True)
class TableFormat:
    """How a file names its columns, and its units."""

    columns: Mapping[str, str] = field(default_factory=dict)
    """Role (`time`, `x`, …) -> name in the file; a role that is not there has its own name."""
    length: float = 1.0
    """[m] per unit of the file, of a column whose name says none."""
    angle: float = 1.0
    """[rad] per unit of the file, likewise."""
    time: float = 1.0
    """[s] per unit of the file, likewise."""
    option: str = ""
    """Option of the command line that names the columns of the file; empty where there is none."""

    def factor(self, table: Table, role: str) -> float:
        """By what the numbers of a column are to be multiplied for metres, radians and seconds."""
        own = table.unit(role, self.columns)
        if own is not None:
            return own
        return self.time if role == "time" else self.angle if role == "yaw" else self.length if role in ("x", "y", "z") else 1.0


@dataclass(frozen=True, slots=True)
class Table:
    """Content of a file."""

    file: Path
    names: tuple[str, ...]
    rows: list[list[str]] | Float64Array
    """Cells as text, or numbers, shape (n_rows, n_names)."""
    lines: Sequence[int]
    """Number of the line of each row, from 1."""
    decimal_comma: bool = False
    axes: str = "x,y,z"
    """Axes of the file that are x, y and z of the table frame, as of `parse_axes`; a user may state others."""

    def has(self, role: str, columns: Mapping[str, str]) -> bool:
        """Whether there is a column for this role."""
        return self._at(role, columns) is not None

    def unit(self, role: str, columns: Mapping[str, str]) -> float | None:
        """Unit that the name of the column for this role ends with, as `x_mm`, `x [mm]` or `yaw (deg)` [m, rad or s]; None without."""
        at = self._at(role, columns)
        found = None if at is None else _UNIT.fullmatch(self._lower()[at])
        return UNITS[found["unit"]] if found else None

    def column(self, role: str, columns: Mapping[str, str], option: str = "") -> Float64Array:
        """Numbers of the column for this role, shape (n_rows,); NaN where a cell is empty or `nan`. `option` names other columns.

        Raises BagError where there is no such column or a cell holds something else.
        """
        at = self._at(role, columns)
        if at is None:
            name, got = plain_text(columns.get(role, role)), ", ".join(self.names[:12])
            remedy = f"Name it with {role}=NAME in {option}" if option else f"Rename the one that holds {role}"
            raise BagError(f"{self.file}: no column `{name}` for {role}; it has {got}. {remedy}.")
        if isinstance(self.rows, np.ndarray):
            return np.asarray(self.rows[:, at])
        cells = [row[at] for row in self.rows]
        if self.decimal_comma:
            cells = [cell.replace(",", ".") for cell in cells]
        return numbers(cells, self.lines, self.file, self.names[at])

    def _at(self, role: str, columns: Mapping[str, str]) -> int | None:
        """Number of the column for a role: the name that the user gives, else that of the role, else another usual one."""
        lower = self._lower()
        bare = [found["name"] if (found := _UNIT.fullmatch(name)) else name for name in lower]
        for name in [columns[role].lower()] if role in columns else [role, *_USUAL.get(role, ())]:
            for names in (lower, bare):
                if name in names:
                    return names.index(name)
        return None

    def _lower(self) -> list[str]:
        return [name.lower() for name in self.names]


def read_table(file: Path) -> Table:
    """Read a table: names of the columns in its first line, then one row a line.

    Separated by semicolons, tabs, commas or spaces; with the first two a comma may be the decimal point. Empty lines and lines that
    begin with `#` are skipped. Raises BagError for a file that is no such table or is too large.
    """
    return table_of(file, read_text(file).splitlines())


def read_text(file: Path) -> str:
    """Content of a text file in UTF-8. Raises BagError for another file, or one that is too large."""
    try:
        return read_regular(file, LIMITS.TEXT_FILE.value).decode("utf-8-sig")
    except OSError as error:
        raise BagError(f"{file}: cannot be read ({error.strerror or error}); name a text file, and split one that is larger.") from None
    except UnicodeDecodeError:
        raise BagError(f"{file}: not a text file; export the table as CSV in UTF-8.") from None


def table_of(file: Path, text: Sequence[str]) -> Table:
    """Table of the lines of a file; see `read_table`."""
    numbered = [(number, line) for number, line in enumerate(text, 1) if line.strip() and not line.lstrip().startswith("#")]
    stated = _STATED.fullmatch(numbered[0][1]) if numbered else None
    if stated:
        del numbered[0]
    if not numbered:
        raise BagError(f"{file}: is empty, expected names of columns and rows of numbers.")
    separator = stated[1] if stated else next((s for s in _SEPARATORS if s in numbered[0][1]), None)
    names, *rows = cells_of([line for _, line in numbered], separator, file)
    names = [name.strip() for name in names]
    lines = [number for number, _ in numbered[1:]]
    if all(_is_number(name) for name in names):
        raise BagError(f"{file}: the first line holds numbers, expected names of columns such as time,x,y,yaw; add such a line.")
    lower = [name.lower() for name in names]
    if twice := sorted({name for name in lower if name and lower.count(name) > 1}):
        raise BagError(f"{file}: two columns have the name `{plain_text(twice[0])}`; give each its own.")
    for line, row in zip(lines, rows, strict=True):
        if len(row) != len(names):
            raise BagError(f"{file}, line {line}: {len(row)} cells, expected {len(names)} as in the first line; it may have been cut off.")
    return Table(file, tuple(plain_text(name) for name in names), rows, lines, separator not in (None, ","))


def cells_of(lines: Sequence[str], separator: str | None, file: Path) -> list[list[str]]:
    """Cells of each line; None: spaces separate. Raises BagError where a cell does not end in its line."""
    if separator is None:
        return [line.split() for line in lines]
    try:
        rows = list(csv.reader(lines, delimiter=separator))
    except csv.Error as error:
        raise BagError(f"{file}: not a table ({error}); export it as CSV.") from None
    if len(rows) != len(lines):
        raise BagError(f"{file}: a quotation mark opens a cell of several lines; export the numbers without quotation marks.")
    return rows


def numbers(cells: Sequence[str], lines: Sequence[int], file: Path, name: str) -> Float64Array:
    """Numbers of the cells of column `name`, shape (n,); NaN where a cell is empty or `nan`. Raises BagError for another cell."""
    try:
        return np.array([cell.strip() or "nan" for cell in cells], dtype=np.float64)
    except ValueError:
        line, cell = next((line, cell) for line, cell in zip(lines, cells, strict=True) if cell.strip() and not _is_number(cell))
        raise BagError(f"{file}, line {line}: `{plain_text(cell.strip())[:40]}` in column `{name}`, expected a number.") from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def parse_columns(text: str, roles: tuple[str, ...], option: str) -> dict[str, str]:
    """`role=name,role=name` as a mapping; raises InputError for another form or an unknown role."""
    columns = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        role, equals, name = (word.strip() for word in part.partition("="))
        if not (equals and name) or role not in roles:
            raise InputError(f"{option} has `{plain_text(part)}`, expected ROLE=NAME with a role of {', '.join(roles)}.")
        columns[role] = name
    return columns
