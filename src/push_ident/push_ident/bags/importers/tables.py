"""Tables of numbers in text files (CSV): columns by name, any common separator, units as the user states them."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.errors import BagError, InputError
from push_ident.files import read_regular
from push_ident.limits import LIMITS, plain_text
from push_ident.types import Float64Array

__all__ = ["Table", "TableFormat", "parse_columns", "read_table"]

_SEPARATORS: Final = (";", "\t", ",")
"""In the order in which they are looked for in the first line; where none is there, spaces separate."""


@dataclass(frozen=True, slots=True)
class TableFormat:
    """How a file names its columns, and its units."""

    columns: Mapping[str, str] = field(default_factory=dict)
    """Role (`time`, `x`, …) -> name in the file; a role that is not there has its own name."""
    length: float = 1.0
    """[m] per unit of the file."""
    angle: float = 1.0
    """[rad] per unit of the file."""
    time: float = 1.0
    """[s] per unit of the file."""


@dataclass(frozen=True, slots=True)
class Table:
    """Content of a file, as text."""

    file: Path
    names: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]
    """Number of the line of each row, from 1."""
    decimal_comma: bool

    def has(self, role: str, columns: Mapping[str, str]) -> bool:
        """Whether there is a column for this role."""
        return self._name(role, columns) in self._lower()

    def column(self, role: str, columns: Mapping[str, str]) -> Float64Array:
        """Numbers of the column for this role, shape (n_rows,); NaN where a cell is empty or `nan`.

        Raises BagError where there is no such column or a cell holds something else.
        """
        name = self._name(role, columns)
        if name not in self._lower():
            got = ", ".join(self.names[:12])
            raise BagError(f"{self.file}: no column `{name}` for {role}; it has {got}. Name it with {role}=NAME in --columns.")
        at = self._lower().index(name)
        cells = [row[at].strip() or "nan" for row in self.rows]
        if self.decimal_comma:
            cells = [cell.replace(",", ".") for cell in cells]
        try:
            return np.array(cells, dtype=np.float64)
        except ValueError:
            line, cell = next((line, cell) for line, cell in zip(self.lines, cells, strict=True) if not _is_number(cell))
            raise BagError(f"{self.file}, line {line}: `{plain_text(cell)[:40]}` in column `{name}`, expected a number.") from None

    def _name(self, role: str, columns: Mapping[str, str]) -> str:
        return columns.get(role, role).lower()

    def _lower(self) -> list[str]:
        return [name.lower() for name in self.names]


def read_table(file: Path) -> Table:
    """Read a table: names of the columns in its first line, then one row a line.

    Separated by semicolons, tabs, commas or spaces; with the first two a comma may be the decimal point. Empty lines and lines that
    begin with `#` are skipped. Raises BagError for a file that is no such table or is too large.
    """
    try:
        text = read_regular(file, LIMITS.TEXT_FILE.value).decode("utf-8-sig")
    except OSError as error:
        raise BagError(f"{file}: cannot be read ({error.strerror or error}); name a text file, and split one that is larger.") from None
    except UnicodeDecodeError:
        raise BagError(f"{file}: not a text file; export the table as CSV in UTF-8.") from None
    numbered = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip() and not line.lstrip().startswith("#")]
    if not numbered:
        raise BagError(f"{file}: is empty, expected names of columns and rows of numbers.")
    separator = next((s for s in _SEPARATORS if s in numbered[0][1]), None)
    names, *rows = _cells([line for _, line in numbered], separator, file)
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
    return Table(file, tuple(plain_text(name) for name in names), rows, lines, separator in (";", "\t"))


def _cells(lines: list[str], separator: str | None, file: Path) -> list[list[str]]:
    if separator is None:
        return [line.split() for line in lines]
    try:
        rows = list(csv.reader(lines, delimiter=separator))
    except csv.Error as error:
        raise BagError(f"{file}: not a table ({error}); export it as CSV.") from None
    if len(rows) != len(lines):
        raise BagError(f"{file}: a quotation mark opens a cell of several lines; export the numbers without quotation marks.")
    return rows


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
