"""Tracked poses of object and pusher in text files (CSV), as motion capture, a fiducial tracker or an own program writes them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.bags.importers.axes import parse_axes, planar_of
from push_ident.bags.importers.motion_capture import read_body
from push_ident.bags.importers.recording import Recording, RecordingOptions, import_recording, without_gaps, without_lost
from push_ident.bags.importers.report import ImportReport
from push_ident.bags.importers.shapes import CELL_SIZE, shape_of_outline
from push_ident.bags.importers.tables import Table, TableFormat, read_table
from push_ident.errors import BagError
from push_ident.limits import LIMITS
from push_ident.types import Float64Array, ObjectShape

POSE_ROLES: Final = ("time", "x", "y", "yaw", "z", "qx", "qy", "qz", "qw")
PUSHER_ROLES: Final = ("time", "x", "y", "z", "push")
FORCE_ROLES: Final = ("time", "fx", "fy")
_QUATERNION: Final = ("qx", "qy", "qz", "qw")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedPoses(RecordingOptions):
    """The files of one recording, and what they do not say."""

    poses: Path
    """Table of the object's poses in `table`: time, x, y, yaw; or time, x, y, z, qx, qy, qz, qw of a body with z up. Or an export of a
    motion capture program, with the name of the body as `FILE#BODY`."""
    pusher: Path
    """Table of the pusher's axis in `table`: time, x, y, optionally z and push. Or such an export."""
    outline: Path
    """Table of the outline's vertices x, y, object frame, in the order around it."""
    wrench: Path | None = None
    """Table of the force of the pusher on the object in `table`: time, fx, fy [N]."""
    pose_format: TableFormat = field(default_factory=TableFormat)
    """Of `poses`."""
    pusher_format: TableFormat = field(default_factory=TableFormat)
    """Of `pusher`; its unit of time is that of `wrench` too."""
    outline_length: float | None = None
    """[m] per unit of `outline`; None: as in `poses`."""
    axes: Float64Array | None = None
    """Rotation from the axes of `poses` to those of `table`, shape (3, 3), see `parse_axes`; None: z up, or those of the program."""
    pusher_axes: Float64Array | None = None
    """Likewise of `pusher`; None: `axes`, if they are given."""
    cell_size: float = CELL_SIZE
    """[m]"""


def import_tracked_poses(tables: TrackedPoses, out_bag: Path) -> ImportReport:
    """Convert tables of tracked poses to a new contract bag, with a push record for each push; see `import_recording`.

    Raises BagError for files of another form, InputError for options out of range.
    """
    tables.check()
    shape = read_outline(tables.outline, length=tables.outline_length or tables.pose_format.length, cell_size=tables.cell_size)
    notes: list[str] = []
    poses, has_yaw = _read_poses(tables, notes)
    pusher, numbers, axes = _read_pusher(tables, notes)
    force = _read_force(tables, notes)
    options = frozenset({"--time-unit", *(("--angle-unit",) if has_yaw else ())})
    recording = Recording(poses, pusher, shape, numbers, force, (str(tables.poses), str(tables.pusher)), tuple(notes), options, axes)
    return import_recording(recording, tables, out_bag)


def read_outline(file: Path, *, length: float, cell_size: float) -> ObjectShape:
    """Outline and cells from a table x,y [`length` m]. Raises BagError for a file of another form, InputError for no polygon."""
    table = read_table(file)
    form = TableFormat(length=length)
    outline = np.column_stack([table.column(axis, {}) * form.factor(table, axis) for axis in ("x", "y")])
    if len(outline) < 3 or not np.isfinite(outline).all():
        raise BagError(f"{file}: {len(outline)} vertices, expected at least 3, all with numbers x and y.")
    if np.array_equal(outline[0], outline[-1]):
        outline = outline[:-1]
    return shape_of_outline(outline, cell_size=cell_size, what=str(file))


def _read_poses(tables: TrackedPoses, notes: list[str]) -> tuple[Float64Array, bool]:
    """Rows (time, x, y, yaw) of the object [s, m, m, rad], shape (n, 4), and whether the file has a yaw, not a quaternion."""
    table, form = read_body(tables.poses), tables.pose_format
    axes = parse_axes(table.axes, str(table.file)) if tables.axes is None else tables.axes
    has_z = table.has("z", form.columns)
    position = ("x", "y", *(("z",) if has_z else ()))
    has_yaw = table.has("yaw", form.columns) or not any(table.has(role, form.columns) for role in _QUATERNION)
    if not has_yaw:
        rows = _rows(table, ("time", *position, *_QUATERNION), form, notes, is_pose=True)
        yaw = planar_of(rows[:, -4:], axes, str(tables.poses), notes)
    else:
        rows = _rows(table, ("time", *position, "yaw"), form, notes, is_pose=True)
        # Turned about the vertical axis of the file, which may point down.
        yaw = rows[:, -1] * axes[2].sum()
    turned = _turned(rows[:, 1 : 1 + len(position)], axes, table)[:, :2]
    return np.column_stack([rows[:, 0], turned, np.unwrap(yaw)]), has_yaw


def _turned(position: Float64Array, axes: Float64Array, table: Table) -> Float64Array:
    """Positions in the axes of the table frame, shape (n, 3), from those of a file, shape (n, 2) without z or (n, 3)."""
    if position.shape[1] == 2:
        if axes[:2, 2].any():
            raise BagError(f"{table.file}: no column `z`, which the axes of the table need; name it, or give other axes.")
        position = np.column_stack([position, np.zeros(len(position))])
    return np.asarray(position @ axes.T)


def _read_pusher(tables: TrackedPoses, notes: list[str]) -> tuple[Float64Array, Float64Array | None, Float64Array]:
    """Rows (time, x, y, z) of the pusher [s, m]; the numbers of the column `push`, None without it; the axes of the file."""
    table, form = read_body(tables.pusher), tables.pusher_format
    axes = tables.axes if tables.pusher_axes is None else tables.pusher_axes
    axes = parse_axes(table.axes, str(table.file)) if axes is None else axes
    has_z, has_push = table.has("z", form.columns), table.has("push", form.columns)
    if tables.lifted_above is not None and not has_z:
        raise BagError(f"{tables.pusher}: no column `z`, which --lifted-above needs; leave the option out, or name the column.")
    position = ("x", "y", *(("z",) if has_z else ()))
    rows = _rows(table, ("time", *position, *(("push",) if has_push else ())), form, notes, is_pose=not has_push)
    pusher = np.column_stack([rows[:, 0], _turned(rows[:, 1 : 1 + len(position)], axes, table)])
    return pusher, rows[:, -1] if has_push else None, axes


def _read_force(tables: TrackedPoses, notes: list[str]) -> Float64Array:
    """Rows (time, fx, fy) of the force on the object [s, N, N], shape (n, 3); no rows without a file."""
    if tables.wrench is None:
        return np.zeros((0, 3))
    rows = _rows(read_table(tables.wrench), FORCE_ROLES, TableFormat(time=tables.pusher_format.time), notes)
    LIMITS.FORCE.check(float(np.abs(rows[:, 1:]).max()), str(tables.wrench), error=BagError)
    return rows


def _rows(table: Table, roles: tuple[str, ...], form: TableFormat, notes: list[str], *, is_pose: bool = False) -> Float64Array:
    """Columns of a table in metres, radians and seconds, shape (n, n_roles), in order of time, without rows that lack a number.

    A row in which tracking was lost is empty. Of the column `push` a cell may be empty.
    """
    rows = np.column_stack([form.factor(table, role) * table.column(role, form.columns, form.option) for role in roles])
    if is_pose:
        rows = without_lost(rows, str(table.file), notes)
    return without_gaps(rows, [role != "push" for role in roles], [f"line {line}" for line in table.lines], str(table.file), notes)
