"""A path of the pusher from a table in a text file (CSV)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from push_ident.bags.importers.tables import TableFormat, read_table
from push_ident.errors import InputError
from push_ident.identification.predicting.planned import pusher_path
from push_ident.types import PusherPath


def read_pusher_path(file: Path, radius: float, speed: float | None = None) -> PusherPath:
    """Path of the axis of a pusher from columns time, x, y, or x, y that are driven along at `speed` [m/s]; radius and lengths [m].

    Seconds and metres, unless the name of a column says another unit, as `x_mm`.

    Raises:
        BagError: the file is no such table.
        InputError: it holds no path of a push, see `pusher_path`.
    """
    table, seconds_and_metres = read_table(file), TableFormat()
    roles = ("time", "x", "y") if table.has("time", {}) else ("x", "y")
    columns = [seconds_and_metres.factor(table, role) * table.column(role, {}) for role in roles]
    try:
        return pusher_path(np.column_stack(columns), radius, speed)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
