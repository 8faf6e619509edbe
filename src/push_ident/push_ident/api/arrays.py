"""Pushes from arrays: what motion capture or an own program has in memory, as the records that all other functions take."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from push_ident.bags.importers.recording import Recording, RecordingOptions, import_recording, without_gaps
from push_ident.bags.importers.shapes import shape_of_outline
from push_ident.errors import InputError
from push_ident.geometry.outline import polygon_area
from push_ident.geometry.shape_check import check_pusher_radius
from push_ident.offline.loading import LoadedPushes, load_pushes
from push_ident.types import Float64Array, PushRecord

_CELLS: Final = 100
"""Cells of an object whose edge is not given: in the middle of the 50 to 150 for which the model is made."""


class Details(TypedDict, total=False):
    """What is known of a recording besides; all optional."""

    push: ArrayLike
    """Number of the push of each sample of the path, negative for none, shape (m,). Without it pauses of the pusher separate pushes."""
    pose_std: tuple[float, float]
    """Standard deviations of a position and a yaw [m, rad]. Without them the scatter at rest between the pushes."""
    cell_size: float
    """Edge of a cell [m]. Without it about 100 cells."""
    object_id: str
    """Name of the object; `1` without it."""


def records(
    time: ArrayLike,
    pose: ArrayLike,
    pusher_time: ArrayLike,
    pusher: ArrayLike,
    *,
    outline: ArrayLike,
    radius: float,
    wrench: ArrayLike | None = None,
    **details: Unpack[Details],
) -> LoadedPushes:
    """Cut a long recording into pushes. Arrays, lists, and frames and series of pandas are taken; rows with NaN are left out.

    Args:
        time: of the poses [s], shape (n,), one clock for all.
        pose: (x, y, yaw) of the object in a frame with z up [m, m, rad], shape (n, 3).
        pusher_time: of the path [s], shape (m,).
        pusher: axis of the pusher in the same frame [m], shape (m, 2).
        outline: vertices in the object frame [m], shape (k, 2), in either sense.
        radius: of the pusher [m].
        wrench: (time, fx, fy): force of the pusher on the object in the same frame [s, N, N], shape (l, 3).
        details: optional. `push`: number of the push of each sample of the path, negative for none, shape (m,). `pose_std`: (position,
            yaw), standard deviations of a pose [m, rad]. `cell_size`: edge of a cell [m]. `object_id`: name of the object.

    Returns:
        The pushes, as `load` gives them from a bag, cells and all.

    Raises:
        InputError: an array has another shape, or the noise is neither given nor shown.
        BagError: pusher and object never meet, or a number is beyond its limits.
    """
    notes: list[str] = []
    poses = _rows("pose", time, pose, ("x", "y", "yaw"), notes)
    numbers = _array("push", details["push"], 1) if "push" in details else None
    path = _rows("pusher", pusher_time, pusher, ("x", "y"), notes, numbers)
    forces = np.zeros((0, 3)) if wrench is None else _array("wrench", wrench, 2, ("time", "fx", "fy"))
    forces = _rows("wrench", forces[:, 0], forces[:, 1:], (), notes) if len(forces) else forces
    vertices = _array("outline", outline, 2, ("x", "y"))
    if len(vertices) < 3 or not np.isfinite(vertices).all():
        raise InputError(f"`outline` has {len(vertices)} vertices, expected at least 3, all with numbers x and y.")
    size = details.get("cell_size", float(np.sqrt(abs(polygon_area(vertices)) / _CELLS)))
    poses[:, 3] = np.unwrap(poses[:, 3])
    at_table = np.column_stack([path[:, :3], np.zeros(len(path))])
    shape, of_push = shape_of_outline(vertices, cell_size=size), None if numbers is None else path[:, 3]
    recording = Recording(poses, at_table, shape, of_push, forces, notes=tuple(notes))
    position_std, yaw_std = _pose_std(details.get("pose_std"))
    check_pusher_radius(radius)
    options = RecordingOptions(
        float(radius), details.get("object_id", "1"), position_std, yaw_std, noise_option="pose_std=(position, yaw) [m, rad]"
    )
    # As a bag: whatever is done with the pushes of a bag is done with these.
    with tempfile.TemporaryDirectory() as folder:
        report = import_recording(recording, options, bag := Path(folder) / "arrays")
        loaded = load_pushes([bag])
    return LoadedPushes(loaded.object_id, loaded.records, [*report.notes, *report.warnings, *loaded.notes], loaded.nuisances)


def record(
    time: ArrayLike, pose: ArrayLike, pusher_time: ArrayLike, pusher: ArrayLike, *, outline: ArrayLike, radius: float, **details: Any
) -> PushRecord:
    """One push; the arguments of `records`, except `push`. Raises as `records` does."""
    one = np.zeros(len(_array("pusher_time", pusher_time, 1)))
    return records(time, pose, pusher_time, pusher, outline=outline, radius=radius, push=one, **details)[0]


def _pose_std(given: object) -> tuple[float | None, float | None]:
    """Standard deviations of a position and a yaw; none where none are given. Raises InputError for another form."""
    if given is None:
        return None, None
    std = _array("pose_std", given, np.ndim(np.asarray(given, dtype=object)))
    if std.shape != (2,) or not np.all(np.isfinite(std) & (std > 0)):
        raise InputError(f"`pose_std` is {given}, expected two numbers above 0: standard deviations of a position [m] and of a yaw [rad].")
    return float(std[0]), float(std[1])


def _rows(
    name: str, time: ArrayLike, values: ArrayLike, columns: Sequence[str], notes: list[str], numbers: Float64Array | None = None
) -> Float64Array:
    """Rows (time, values, number if there are some), in order of time and without gaps, shape (n, n_columns)."""
    array, stamps = _array(name, values, 2, columns), _array(f"time of {name}", time, 1)
    for what, length in (("time", len(stamps)), ("push", len(array) if numbers is None else len(numbers))):
        if length != len(array):
            raise InputError(f"`{name}` has {len(array)} rows, its {what} {length}; give one for each.")
    rows = np.column_stack([stamps, array, *(() if numbers is None else (numbers,))])
    return without_gaps(rows, [True] * rows.shape[1], range(len(rows)), name, notes)


def _array(name: str, values: Any, dimensions: int, columns: Sequence[str] = ()) -> Float64Array:
    """Real numbers; of a frame of pandas the named columns, where it has them. Raises InputError for another form."""
    if columns and set(columns) <= set(getattr(values, "columns", ())):
        values = values[list(columns)]
    expected = f"(n, {len(columns)}): {', '.join(columns)}" if columns else "(n,)"
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"`{name}` is a {type(values).__name__}, expected an array of numbers of shape {expected}.") from None
    if array.ndim != dimensions or (columns and array.shape[1] != len(columns)):
        raise InputError(f"`{name}` has shape {array.shape}, expected {expected}.")
    return array
