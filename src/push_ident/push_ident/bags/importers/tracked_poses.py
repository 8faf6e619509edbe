"""Tracked poses of object and pusher in text files (CSV), as motion capture, a fiducial tracker or an own program writes them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.bags.importers.report import Contact, ImportReport, contact_of, contact_tolerance, contact_warnings
from push_ident.bags.importers.shapes import CELL_SIZE, pose_covariance, shape_of_outline
from push_ident.bags.importers.tables import Table, TableFormat, read_table
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError, InputError
from push_ident.limits import LIMITS, check_coordinates, check_object_id
from push_ident.types import Float64Array, ObjectShape

__all__ = ["FORCE_ROLES", "POSE_ROLES", "PUSHER_ROLES", "TrackedPoses", "import_tracked_poses"]

POSE_ROLES: Final = ("time", "x", "y", "yaw", "z", "qx", "qy", "qz", "qw")
PUSHER_ROLES: Final = ("time", "x", "y", "z", "push")
FORCE_ROLES: Final = ("time", "fx", "fy")
_QUATERNION: Final = ("qx", "qy", "qz", "qw")
_PAUSE: Final = 0.5
"""Shortest pause that separates two pushes [s], as in the bag contract."""
_STANDSTILL: Final = 0.5e-3
"""Longest way of a pusher that stands still, within `_PAUSE` [m]: 1 mm/s."""
_NOISE_FACTOR: Final = 6.0
"""Standard deviations of the pusher's noise that count as motion."""
_MOST_TILT: Final = float(np.radians(10.0))
"""Largest angle between the body's z axis and the vertical at which a planar pose is meant [rad]: 10 degrees shorten lengths by 1.5 %."""
_NOTED_TILT: Final = float(np.radians(2.0))
_REST_FRAMES: Final = 10
"""Least number of frames of a block in which the scatter at rest is measured."""
_LEAST_POSITION_STD, _LEAST_YAW_STD = 1e-4, float(np.radians(0.05))
"""Least standard deviations that are taken from the scatter at rest: the error that all poses share does not scatter."""
_FIRST: Final = 1.0
"""Earliest stamp written [s]; a stamp of zero would mean that there is none."""


@dataclass(frozen=True, slots=True)
class TrackedPoses:
    """The files of one recording, and what they do not say."""

    poses: Path
    """Table of the object's poses in `table`: time, x, y, yaw; or time, x, y, z, qx, qy, qz, qw of a body with z up."""
    pusher: Path
    """Table of the pusher's axis in `table`: time, x, y, optionally z and push."""
    outline: Path
    """Table of the outline's vertices x, y, object frame, in the order around it."""
    radius: float
    """Of the pusher [m]."""
    wrench: Path | None = None
    """Table of the force of the pusher on the object in `table`: time, fx, fy [N]."""
    object_id: str = "1"
    pose_format: TableFormat = field(default_factory=TableFormat)
    """Of `poses`; its unit of length is that of `outline` too."""
    pusher_format: TableFormat = field(default_factory=TableFormat)
    """Of `pusher`; its unit of time is that of `wrench` too."""
    position_std: float | None = None
    """Standard deviation of a position of the object [m]; None: from the scatter at rest."""
    yaw_std: float | None = None
    """Standard deviation of a yaw of the object [rad]; None: from the scatter at rest."""
    lifted_above: float | None = None
    """Height of the tool tip above which it is lifted and pushes nothing [m]."""
    cell_size: float = CELL_SIZE
    """[m]"""


@dataclass(frozen=True, slots=True)
class _Span:
    """One push: samples of the pusher, rows (time, x, y, z) [s, m]."""

    pusher: Float64Array
    contact: Contact


def import_tracked_poses(recording: TrackedPoses, out_bag: Path) -> ImportReport:
    """Convert tables of tracked poses to a new contract bag, with a push record for each push.

    Pushes are the runs of one number in the column `push` of the pusher's table; an empty cell or a negative number is no push. Without
    this column a pause ends a push: the pusher stays within 0.5 mm for more than 0.5 s, has no samples for so long, or is lifted. Motions
    in which the pusher does not reach the object are left out.

    Every pose is written. Times are kept; those of a recording that begins before 1 s are moved to begin there.

    Raises BagError for files of another form, InputError for options out of range.
    """
    check_object_id(recording.object_id)
    LIMITS.PUSHER_RADIUS.check(recording.radius, "the pusher", remedy="Give --radius in metres.")
    if recording.radius < 0:
        raise InputError(f"radius of the pusher is {recording.radius:g} m, expected a length >= 0.")
    shape = _read_outline(recording)
    notes: list[str] = []
    poses = _read_poses(recording, notes)
    pusher, numbers = _read_pusher(recording, notes)
    force = _read_force(recording, notes)
    shift = _to_positive_time([rows for rows in (poses, pusher, force) if len(rows)], recording)
    if poses[-1, 0] < pusher[0, 0] or pusher[-1, 0] < poses[0, 0]:
        of_poses, of_pusher = (f"{rows[0, 0] - shift:g} to {rows[-1, 0] - shift:g} s" for rows in (poses, pusher))
        raise BagError(
            f"{recording.poses} has times {of_poses}, {recording.pusher} {of_pusher}, expected one clock; check the units of time and the "
            "clocks of both devices."
        )
    runs = _numbered(pusher, numbers) if numbers is not None else _motions(pusher, recording.lifted_above)
    position_std, yaw_std = _noise(poses, runs, recording, notes)
    tolerance = contact_tolerance(shape, position_std=position_std, yaw_std=yaw_std)
    spans = _pushes(runs, poses, shape, recording.radius, tolerance)
    if numbers is None:
        spans = _with_contact(spans, tolerance, notes)
    if not spans:
        raise BagError(
            f"{recording.pusher}: no push in it: in none of {len(runs)} motions the pusher comes within {1e3 * tolerance:.1f} mm of the "
            "object; check frames, units and clocks."
        )
    LIMITS.PUSHES.check(len(spans), str(recording.pusher), error=BagError, remedy="Split the recording.")
    _write(out_bag, recording, shape, poses, force, spans, pose_covariance(position_std, yaw_std))
    contacts = [span.contact for span in spans]
    return ImportReport(
        bag=out_bag,
        n_pushes=len(spans),
        contact_distance=np.array([contact.distance for contact in contacts]),
        notes=tuple(notes),
        warnings=contact_warnings(contacts, tolerance),
    )


def _read_outline(recording: TrackedPoses) -> ObjectShape:
    table = read_table(recording.outline)
    outline = np.column_stack([table.column(axis, {}) for axis in ("x", "y")]) * recording.pose_format.length
    if len(outline) < 3 or not np.isfinite(outline).all():
        raise BagError(f"{recording.outline}: {len(outline)} vertices, expected at least 3, all with numbers x and y.")
    if np.array_equal(outline[0], outline[-1]):
        outline = outline[:-1]
    return shape_of_outline(outline, cell_size=recording.cell_size, what=str(recording.outline))


def _read_poses(recording: TrackedPoses, notes: list[str]) -> Float64Array:
    """Rows (time, x, y, yaw) of the object [s, m, m, rad], shape (n, 4)."""
    table, form = read_table(recording.poses), recording.pose_format
    if not table.has("yaw", form.columns) and any(table.has(role, form.columns) for role in _QUATERNION):
        rows = _planar(_rows(table, ("time", "x", "y", *_QUATERNION), form, notes), recording.poses, notes)
    else:
        rows = _rows(table, ("time", "x", "y", "yaw"), form, notes)
        rows[:, 3] *= form.angle
    rows[:, 1:3] *= form.length
    rows[:, 3] = np.unwrap(rows[:, 3])
    check_coordinates(rows[:, 1:3], str(recording.poses), error=BagError)
    return rows


def _planar(rows: Float64Array, file: Path, notes: list[str]) -> Float64Array:
    """Rows (time, x, y, yaw) from rows (time, x, y, qx, qy, qz, qw)."""
    from scipy.spatial.transform import Rotation

    length = np.linalg.norm(rows[:, 3:], axis=1)
    if wrong := int(np.sum(np.abs(length - 1.0) > 0.05)):
        raise BagError(f"{file}: {wrong} of {len(rows)} quaternions have a length other than 1; check the order qx, qy, qz, qw.")
    turn = Rotation.from_quat(rows[:, 3:]).as_matrix()
    tilt = np.arccos(np.clip(turn[:, 2, 2], -1.0, 1.0))
    if (middle := float(np.median(tilt))) > _MOST_TILT:
        raise BagError(
            f"{file}: the body's z axis is tilted by {np.degrees(middle):.0f} degrees, expected at most {np.degrees(_MOST_TILT):.0f}; "
            "define the rigid body with z up while the object lies on the table, and export with z up."
        )
    if (most := float(tilt.max())) > _NOTED_TILT:
        notes.append(f"the object tilts by up to {np.degrees(most):.1f} degrees; its planar pose is used")
    return np.column_stack([rows[:, :3], np.arctan2(turn[:, 1, 0], turn[:, 0, 0])])


def _read_pusher(recording: TrackedPoses, notes: list[str]) -> tuple[Float64Array, Float64Array | None]:
    """Rows (time, x, y, z) of the pusher [s, m], and the numbers of the column `push`, None without it."""
    table, form = read_table(recording.pusher), recording.pusher_format
    has_z, has_push = table.has("z", form.columns), table.has("push", form.columns)
    if recording.lifted_above is not None and not has_z:
        raise BagError(f"{recording.pusher}: no column `z`, which --lifted-above needs; leave the option out, or name the column.")
    rows = _rows(table, ("time", "x", "y", *(("z",) if has_z else ()), *(("push",) if has_push else ())), form, notes)
    numbers = rows[:, -1] if has_push else None
    pusher = np.column_stack([rows[:, 0], form.length * rows[:, 1:3], form.length * rows[:, 3] if has_z else np.zeros(len(rows))])
    check_coordinates(pusher[:, 1:], str(recording.pusher), error=BagError)
    return pusher, numbers


def _read_force(recording: TrackedPoses, notes: list[str]) -> Float64Array:
    """Rows (time, fx, fy) of the force on the object [s, N, N], shape (n, 3); no rows without a file."""
    if recording.wrench is None:
        return np.zeros((0, 3))
    rows = _rows(read_table(recording.wrench), FORCE_ROLES, TableFormat(time=recording.pusher_format.time), notes)
    LIMITS.FORCE.check(float(np.abs(rows[:, 1:]).max()), str(recording.wrench), error=BagError)
    return rows


def _rows(table: Table, roles: tuple[str, ...], form: TableFormat, notes: list[str]) -> Float64Array:
    """Columns of a table, shape (n, n_roles), with time in seconds, in order of time, without rows that lack a number.

    A row in which tracking was lost is empty. Of the column `push` a cell may be empty.
    """
    rows = np.column_stack([table.column(role, form.columns) for role in roles])
    needed = np.array([role != "push" for role in roles])
    whole = np.isfinite(rows[:, needed]).all(axis=1)
    if int(whole.sum()) < 2:
        raise BagError(f"{table.file}: {int(whole.sum())} rows with all numbers, expected at least 2.")
    if lost := int(np.sum(~whole)):
        notes.append(f"{table.file.name}: {lost} of {len(rows)} rows lack a number and are left out")
    lines, rows = np.array(table.lines)[whole], rows[whole]
    rows[:, 0] *= form.time
    step = np.diff(rows[:, 0])
    if (step < 0).any():
        line = int(lines[1:][step < 0][0])
        raise BagError(f"{table.file}, line {line}: time goes back by {-step[step < 0][0]:.3g} s; sort the rows, or split the recording.")
    if repeated := int(np.sum(step == 0)):
        notes.append(f"{table.file.name}: {repeated} rows repeat a time and are left out")
    return np.asarray(rows[np.append(True, step > 0)])


def _to_positive_time(streams: list[Float64Array], recording: TrackedPoses) -> float:
    """Move all streams so that the first stamp is 1 s or more, in place; returns the shift [s]. Raises BagError for times of no clock."""
    first, last = min(float(rows[0, 0]) for rows in streams), max(float(rows[-1, 0]) for rows in streams)
    shift = max(0.0, _FIRST - first)
    LIMITS.STAMP.check(last + shift, str(recording.poses), error=BagError, remedy="Is time in milliseconds? Then give --time-unit ms.")
    for rows in streams:
        rows[:, 0] += shift
    return shift


def _numbered(pusher: Float64Array, numbers: Float64Array) -> list[Float64Array]:
    """Samples of the pusher for each run of one number that is not negative."""
    label = np.where(np.isfinite(numbers), numbers, -1.0)
    starts = np.flatnonzero(np.append(True, label[1:] != label[:-1]))
    return [pusher[a:b] for a, b in zip(starts, np.append(starts[1:], len(label)), strict=True) if label[a] >= 0 and b - a >= 2]


def _motions(pusher: Float64Array, lifted_above: float | None) -> list[Float64Array]:
    """Samples of the pusher for each motion between two pauses."""
    if lifted_above is not None:
        pusher = pusher[pusher[:, 3] <= lifted_above]
    motions = []
    for run in np.split(pusher, np.flatnonzero(np.diff(pusher[:, 0]) > _PAUSE) + 1):
        if len(run) < 2:
            continue
        time = run[:, 0]
        least = max(_STANDSTILL, _NOISE_FACTOR * np.sqrt(2.0) * _path_noise(run[:, 1:3]))
        early, late = np.clip(time - 0.5 * _PAUSE, time[0], time[-1]), np.clip(time + 0.5 * _PAUSE, time[0], time[-1])
        way = [np.interp(late, time, run[:, axis]) - np.interp(early, time, run[:, axis]) for axis in (1, 2)]
        moving = np.flatnonzero(np.hypot(*way) > least)
        if len(moving):
            motions += [run[part[0] : part[-1] + 1] for part in np.split(moving, np.flatnonzero(np.diff(moving) > 1) + 1) if len(part) >= 2]
    return motions


def _path_noise(position: Float64Array) -> float:
    """Standard deviation of the noise of a path [m], shape (n, 2), from its second differences."""
    if len(position) < 3:
        return 0.0
    bend = position[2:] - 2.0 * position[1:-1] + position[:-2]
    # Median of the absolute value and variance of a second difference of independent normal numbers.
    return float(np.median(np.abs(bend)) / (0.6745 * np.sqrt(6.0)))


def _noise(poses: Float64Array, runs: list[Float64Array], recording: TrackedPoses, notes: list[str]) -> tuple[float, float]:
    """Standard deviations of position [m] and yaw [rad]: as given, else the median scatter of blocks of frames between the pushes."""
    if recording.position_std is not None and recording.yaw_std is not None:
        return recording.position_std, recording.yaw_std
    busy = [(run[0, 0] - 0.5 * _PAUSE, run[-1, 0] + 0.5 * _PAUSE) for run in runs]
    scatter = []
    for start, end in _between(busy, float(poses[0, 0]), float(poses[-1, 0])):
        rest = poses[(poses[:, 0] >= start) & (poses[:, 0] <= end)]
        for part in np.split(rest, np.flatnonzero(np.diff(rest[:, 0]) > _PAUSE) + 1):
            # Short blocks: between two pushes the object may be put elsewhere by hand, which the median then leaves out.
            for block in np.array_split(part, max(1, len(part) // _REST_FRAMES)):
                if len(block) >= _REST_FRAMES:
                    scatter.append((np.sqrt(block[:, 1:3].var(axis=0, ddof=1).mean()), block[:, 3].std(ddof=1)))
    if not scatter:
        raise InputError(
            f"{recording.poses}: fewer than {_REST_FRAMES} poses at rest between the pushes, so the noise of a pose is unknown; give "
            "--position-std and --yaw-std."
        )
    position, yaw = np.median(np.array(scatter), axis=0)
    position_std = max(float(position), _LEAST_POSITION_STD) if recording.position_std is None else recording.position_std
    yaw_std = max(float(yaw), _LEAST_YAW_STD) if recording.yaw_std is None else recording.yaw_std
    notes.append(
        f"standard deviations of a pose: {1e3 * position_std:.2f} mm, {np.degrees(yaw_std):.3f} degrees; the scatter at rest is "
        f"{1e3 * position:.3f} mm, {np.degrees(yaw):.4f} degrees"
    )
    return position_std, yaw_std


def _between(busy: list[tuple[float, float]], start: float, end: float) -> Iterator[tuple[float, float]]:
    """The times from `start` to `end` outside the busy ones, which are in order."""
    for first, last in [*busy, (end, end)]:
        if first > start:
            yield start, min(first, end)
        start = max(start, last)


def _pushes(runs: list[Float64Array], poses: Float64Array, shape: ObjectShape, radius: float, tolerance: float) -> list[_Span]:
    """The runs of the pusher with their contacts."""
    spans, time = [], poses[:, 0]
    for run in runs:
        # As a bag is cut into pushes: the poses around the run, and where there is none at rest the nearest one on that side.
        start, end = run[0, 0], run[-1, 0]
        low = min(np.searchsorted(time, start - _PAUSE), max(np.searchsorted(time, start, side="right") - 1, 0))
        high = max(np.searchsorted(time, end + _PAUSE, side="right"), np.searchsorted(time, end) + 1)
        part = poses[low:high]
        spans.append(_Span(run, contact_of(part[:, 0], part[:, 1:], run[:, :3], shape=shape, radius=radius, tolerance=tolerance)))
    return spans


def _with_contact(spans: list[_Span], tolerance: float, notes: list[str]) -> list[_Span]:
    """The motions in which the object moves or the pusher reaches it."""
    found = [span for span in spans if span.contact.moved or span.contact.nearest <= tolerance]
    if missed := len(spans) - len(found):
        notes.append(f"{missed} motions in which the pusher does not reach the object are left out")
    return found


def _write(
    out_bag: Path,
    recording: TrackedPoses,
    shape: ObjectShape,
    poses: Float64Array,
    force: Float64Array,
    spans: list[_Span],
    covariance: Float64Array,
) -> None:
    first = float(min(poses[0, 0], spans[0].pusher[0, 0]))
    with BagWriter(out_bag) as writer:
        writer.write_shape(recording.object_id, shape, first)
        writer.write_pusher_shape(first, recording.radius)
        for time, *pose in poses.tolist():
            writer.write_pose(recording.object_id, time, pose, covariance)
        for number, span in enumerate(spans, 1):
            for time, x, y, z in span.pusher.tolist():
                writer.write_pusher(time, (x, y), z=z)
            start, end = float(span.pusher[0, 0]), float(span.pusher[-1, 0])
            for time, *newtons in force[(force[:, 0] >= start) & (force[:, 0] <= end)].tolist():
                writer.write_wrench(time, newtons)
            writer.write_push_record(number, recording.object_id, start, end)
