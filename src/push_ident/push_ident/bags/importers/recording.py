"""Tracked poses of an object and a pusher, from whatever file, as a bag of the contract: cut into pushes, written, and checked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.bags.importers.report import ImportReport
from push_ident.bags.importers.shapes import pose_covariance
from push_ident.bags.pushes import PAUSE
from push_ident.bags.records import FIRST_STAMP, LATE
from push_ident.bags.writer import BagWriter
from push_ident.checking.contact import Contact, contact_of, contact_tolerance, contact_warnings
from push_ident.checking.overlap import Overlap, Streams, overlap_of
from push_ident.errors import BagError, InputError
from push_ident.limits import LIMITS, check_object_id
from push_ident.pushing.pose_noise import LEAST_POSITION_STD, LEAST_YAW_STD, PoseNoise, pusher_moves
from push_ident.types import BoolArray, Float64Array, ObjectShape

_JUMP: Final = 3.0
"""Speed of a jump to where a lost body is put, over any speed before or after it [-]."""
_CLEARANCE: Final = 2.0
"""Least time from the end of a recording to the beginning of the next one that is joined to it [s]: longer than any pause."""
_AROUND: Final = 5
"""Steps before and after a jump with which it is compared: a body that begins to move reaches most of its speed in them."""


class OverlapError(BagError):
    """The pusher never comes near the object. `overlap` shows what was found, for a picture."""

    def __init__(self, text: str, overlap: Overlap) -> None:
        super().__init__(text)
        self.overlap = overlap


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """What a user knows of a recording, and its files do not say."""

    radius: float
    """Of the pusher [m]."""
    object_id: str = "1"
    position_std: float | None = None
    """Standard deviation of a position of the object [m]; None: from the scatter at rest."""
    yaw_std: float | None = None
    """Standard deviation of a yaw of the object [rad]; None: from the scatter at rest."""
    lifted_above: float | None = None
    """Height of the tool tip above which it is lifted and pushes nothing [m]."""
    time_offset: float = 0.0
    """Added to the times of the pusher and of the force, to bring them to the clock of the poses [s]."""
    pusher_frame: Float64Array | None = None
    """Pose (x, y, yaw) of the frame in which the pusher was recorded, in that of the object's poses [m, m, rad]; None: they are one."""
    noise_option: str = "--position-std and --yaw-std"
    """What the caller has to give where the noise of a pose is unknown, in words."""

    def check(self) -> None:
        """Raise InputError for an option that is out of its range."""
        check_object_id(self.object_id)
        LIMITS.PUSHER_RADIUS.check(self.radius, "the pusher", remedy="Give --radius in metres.")
        if self.radius < 0:
            raise InputError(f"radius of the pusher is {self.radius:g} m, expected a length >= 0.")
        if not np.isfinite(self.time_offset):
            raise InputError(f"time offset is {self.time_offset} s, expected a finite number.")


@dataclass(frozen=True, slots=True)
class Recording:
    """The streams of one recording, in metres, radians and seconds of their clocks."""

    poses: Float64Array
    """Rows (time, x, y, yaw) of the object, shape (n, 4), n at least 2, time strictly increasing."""
    pusher: Float64Array
    """Rows (time, x, y, z) of the axis of the pusher, shape (m, 4), m at least 2, time strictly increasing."""
    shape: ObjectShape
    numbers: Float64Array | None = None
    """Number of the push of each row of `pusher`, shape (m,), negative or NaN for none; None: pauses separate pushes."""
    force: Float64Array = field(default_factory=lambda: np.zeros((0, 3)))
    """Rows (time, fx, fy) of the force on the object [s, N, N], shape (l, 3)."""
    names: tuple[str, str] = ("poses", "pusher")
    """Of poses and pusher, for messages."""
    notes: tuple[str, ...] = ()
    unit_options: frozenset[str] = frozenset()
    """Of `--angle-unit` and `--time-unit`, those that mean something for these files."""
    pusher_axes: Float64Array = field(default_factory=lambda: np.eye(3))
    """Rotation from the axes in which the pusher was recorded to those of `pusher`, shape (3, 3); for messages."""
    parts: tuple[tuple[str, float], ...] = ()
    """Name and start [s] of each recording of one push that was joined to this one, in order of time."""


_Push = tuple[Float64Array, Contact]
"""Samples of the pusher, rows (time, x, y, z) [s, m], and its contact."""


def import_recording(recording: Recording, options: RecordingOptions, out_bag: Path) -> ImportReport:
    """Write a recording as a new contract bag, with a push record for each push, and check that pusher and object meet.

    Pushes are the runs of one number. Without numbers a pause ends a push: the pusher stays within 0.5 mm for more than 0.5 s, has no
    samples for so long, or is lifted. Motions in which the pusher does not reach the object are left out. Every pose is written. Times are
    kept; those of a recording that begins before 1 s are moved to begin there.

    Raises:
        InputError: An option is out of range, or the noise of a pose is neither given nor shown.
        OverlapError: The pusher never comes near the object; no bag is written.
        BagError: The streams have no time in common, or times or coordinates that a bag cannot hold.
    """
    notes = list(recording.notes)
    shape, numbers = recording.shape, recording.numbers
    poses, pusher, force = _on_one_clock(recording, options)
    runs = _numbered(pusher, numbers) if numbers is not None else _motions(pusher, options.lifted_above)
    position_std, yaw_std = _noise(poses, runs, recording.names[0], options, notes)
    covariance = pose_covariance(position_std, yaw_std)
    tolerance = contact_tolerance(shape, position_std=position_std, yaw_std=yaw_std)
    units = frozenset({"length", *(("angle",) if "--angle-unit" in recording.unit_options else ())})
    streams = Streams(poses, runs, shape, options.radius, tolerance, units, recording.pusher_axes)
    spans = _pushes(streams)
    if numbers is None:
        spans = _with_contact(spans, tolerance, notes)
    if not spans:
        overlap = overlap_of(streams)
        span = 1e3 * float(np.ptp(pusher[:, 1:3], axis=0).max())
        remedy = overlap.remedy() if runs else f"all it spans is {span:.2g} mm: are lengths in metres, and was another --length-unit given?"
        raise OverlapError(
            f"{recording.names[1]}: no push in it: in none of {len(runs)} motions the pusher comes within {1e3 * tolerance:.1f} mm of the "
            f"object; {remedy}",
            overlap,
        )
    LIMITS.PUSHES.check(len(spans), recording.names[1], error=BagError, remedy="Split the recording.")
    _write(out_bag, options, streams, force, spans, covariance)
    contacts = [contact for _, contact in spans]
    warnings = contact_warnings(dict(enumerate(contacts)), tolerance)
    overlap = overlap_of(replace(streams, runs=[run for run, _ in spans]))
    if not overlap.fits:
        warnings = (*warnings, overlap.explanation())
    warnings = (*warnings, *_not_one_push(recording.parts, spans))
    return ImportReport(
        bag=out_bag,
        n_pushes=len(spans),
        contact_distance=np.array([contact.distance for contact in contacts]),
        tolerance=tolerance,
        notes=tuple(notes),
        warnings=warnings,
        overlap=overlap,
    )


def joined(recordings: Sequence[Recording], options: RecordingOptions) -> tuple[Recording, RecordingOptions]:
    """Recordings of the pushes of one object as one, in order of their starts, and the options that it still needs.

    A recording that starts less than 2 s after the end of the one before it, as where a clock was reset, is moved there, with a note. The
    pusher counts while there are poses. Raises InputError for a recording that is given twice, BagError as `import_recording`.
    """
    if len(recordings) == 1:
        return recordings[0], options
    order = sorted(((one, _on_one_clock(one, options)) for one in recordings), key=lambda item: _span(item[1])[0])
    notes, parts, end = _notes_of(recordings), list[tuple[str, float]](), -np.inf
    known: dict[bytes, str] = {}
    streams: list[tuple[Float64Array, Float64Array, Float64Array]] = []
    for one, (poses, pusher, force) in order:
        name = one.names[0]
        if (same := known.setdefault(poses[:, 1:].tobytes(), name)) != name:
            raise InputError(f"{name}: the same poses as in {same}, expected another push in each bag; give each once.")
        pusher = pusher[(pusher[:, 0] >= poses[0, 0]) & (pusher[:, 0] <= poses[-1, 0])]
        if len(pusher) < 2:
            raise BagError(f"{one.names[1]}: {len(pusher)} rows while the object has poses, expected at least 2; record both together.")
        start, last = _span((poses, pusher, force))
        shift = max(0.0, end + _CLEARANCE - start)
        if shift > 0:
            notes.append(f"{name}: starts less than {_CLEARANCE:g} s after the end of {parts[-1][0]}; its times are moved by {shift:.6g} s")
        for rows in (poses, pusher, force):
            rows[:, 0] += shift
        streams.append((poses, pusher, force))
        parts.append((name, start + shift))
        end = last + shift
    names = (f"{parts[0][0]} and {len(parts) - 1} more", f"{order[0][0].names[1]} and {len(parts) - 1} more")
    poses, pusher, force = (np.concatenate(stream) for stream in zip(*streams, strict=True))
    whole = replace(recordings[0], poses=poses, pusher=pusher, force=force, names=names, notes=tuple(notes), parts=tuple(parts))
    return whole, replace(options, time_offset=0.0, pusher_frame=None)


def _notes_of(recordings: Sequence[Recording]) -> list[str]:
    """Each note once, with the name of the first recording that has it."""
    names: dict[str, list[str]] = {}
    for one in recordings:
        for note in one.notes:
            names.setdefault(note, []).append(one.names[0])
    return [f"{first}{f' and {len(more)} more' if more else ''}: {note}" for note, (first, *more) in names.items()]


def _span(streams: Sequence[Float64Array]) -> tuple[float, float]:
    """First and last time of streams with time [s] first; one of them may have no rows."""
    return min(float(rows[0, 0]) for rows in streams if len(rows)), max(float(rows[-1, 0]) for rows in streams if len(rows))


def _not_one_push(parts: Sequence[tuple[str, float]], spans: list[_Push]) -> list[str]:
    """A warning for each of the joined recordings that has not one push."""
    part = np.searchsorted([start for _, start in parts], [run[0, 0] for run, _ in spans], side="right") - 1
    numbers = np.bincount(np.maximum(part, 0), minlength=len(parts)).tolist()
    none = "no push in it, expected one: the pusher does not reach the object; it is left out"
    several = "{} pushes in it, expected one; all are kept. A pause of more than 0.5 s divides a push"
    return [f"{name}: {several.format(n) if n else none}" for (name, _), n in zip(parts, numbers, strict=False) if n != 1]


def ascending(samples: Float64Array) -> Float64Array:
    """Samples, shape (n, n_columns), time [s] in the first column, without those whose time does not advance."""
    return samples[np.append(True, np.diff(np.maximum.accumulate(samples[:, 0])) > 0)] if len(samples) else samples


def without_lost(rows: Float64Array, what: str, notes: list[str]) -> Float64Array:
    """Rows with time [s] first and a position next, shape (n, n_columns), with NaN where tracking was lost.

    Trackers write a lost body as zeros: all of a quaternion, the last four of eight columns, or the position without any turn. A body may
    be at the origin: it is lost there where it gets there and leaves by jumps, several times as fast as it moves before and after.
    """
    values = rows[:, 1:]
    has_turn = values.shape[1] == 7
    is_lost: BoolArray = np.asarray(~values[:, 3:].any(axis=1)) if has_turn else np.zeros(len(rows), dtype=np.bool_)
    at_origin: BoolArray = np.asarray(~values[:, : 6 if has_turn else None].any(axis=1))
    if has_turn:
        at_origin = at_origin & (np.abs(values[:, 6]) == 1.0)
    position = values[:, : 3 if has_turn else 2]
    is_usable = ~is_lost & (np.abs(position) < LIMITS.COORDINATE.value).all(axis=1)
    if _is_jump(rows[is_usable, 0], position[is_usable], at_origin[is_usable]):
        is_lost = np.asarray(is_lost | at_origin)
    if is_lost.all() or not is_lost.any():
        return rows
    notes.append(f"{what.rsplit('/', 1)[-1]}: tracking was lost in {int(is_lost.sum())} of {len(rows)} rows, which are zero")
    return np.where(is_lost[:, None] & (np.arange(rows.shape[1]) > 0), np.nan, rows)


def _is_jump(time: Float64Array, position: Float64Array, at_origin: BoolArray) -> bool:
    """Whether a body gets to the origin and leaves it by jumps, much faster than it moves before and after; shapes (n,), (n, k), (n,)."""
    if len(time) < 2:
        return False
    step = np.maximum(np.diff(time), 1e-9)
    # Stamps jitter; over a pause a body may go far.
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / np.maximum(step, np.median(step))
    away = ~at_origin[:-1] & ~at_origin[1:]
    jumps = []
    for at in np.flatnonzero(at_origin[:-1] != at_origin[1:]):
        outer = slice(max(at - _AROUND, 0), at) if at_origin[at + 1] else slice(at + 1, at + 1 + _AROUND)
        jumps.append(speed[at] > _JUMP * np.max(speed[outer][away[outer]], initial=0.0))
    return len(jumps) > 0 and bool(np.mean(jumps) > 0.5)


def without_gaps(rows: Float64Array, needed: Sequence[bool], places: Sequence[object], what: str, notes: list[str]) -> Float64Array:
    """Rows with time [s] first, shape (n, n_columns), in order of time, without those that lack a `needed` number or repeat a time.

    `places`: where each row stands, `what`: file or topic, for messages; `notes` gets a line for what is left out. Rows that come late, by
    less than `records.LATE`, are sorted. Raises BagError where fewer than two rows are left, or time goes back by more.
    """
    whole: BoolArray = np.asarray(np.isfinite(rows[:, np.array(needed)]).all(axis=1))
    if int(whole.sum()) < 2:
        raise BagError(f"{what}: {int(whole.sum())} rows with all numbers, expected at least 2.")
    name = what.rsplit("/", 1)[-1]
    if lost := int(np.sum(~whole)):
        notes.append(f"{name}: {lost} of {len(rows)} rows lack a number and are left out")
    left, rows = [place for place, good in zip(places, whole.tolist(), strict=True) if good], rows[whole]
    step = np.diff(rows[:, 0])
    if (step < -LATE).any():
        at = int(np.argmax(step < -LATE))
        raise BagError(f"{what}, {left[at + 1]}: time goes back by {-step[at]:.3g} s; sort the rows, or split the recording.")
    if late := int(np.sum(step < 0)):
        notes.append(f"{name}: {late} rows come after later ones and are sorted")
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        step = np.diff(rows[:, 0])
    same_time = step == 0
    # A message that was recorded twice is left out; other rows at one time show that stamps are coarser than frames.
    if int(np.sum(same_time & (np.abs(np.diff(rows[:, 1:], axis=0)) > 0).any(axis=1))) > 0.5 * len(step):
        raise BagError(
            f"{what}: most of {len(rows)} rows repeat the time before with other numbers, expected a time for each; were times written "
            f"with too few digits (as {rows[0, 0]:.0f})? Write them with milliseconds at least."
        )
    if repeated := int(np.sum(same_time)):
        notes.append(f"{name}: {repeated} rows repeat a time and are left out")
    return np.asarray(rows[np.append(True, step > 0)])


def moved_by(pose: Float64Array | None, vectors: Float64Array, *, turn_only: bool = False) -> Float64Array:
    """Vectors of another frame, shape (n, 2), in the frame in which that one has `pose` (x, y, yaw); unchanged for None."""
    if pose is None:
        return vectors
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    turned = vectors @ np.array([[cosine, sine], [-sine, cosine]])
    return turned if turn_only else turned + pose[:2]


def _on_one_clock(recording: Recording, options: RecordingOptions) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Poses, pusher and force in one frame and on one clock that begins at 1 s or later."""
    poses, pusher, force = recording.poses.copy(), recording.pusher.copy(), recording.force.copy()
    pusher[:, 1:3] = moved_by(options.pusher_frame, pusher[:, 1:3])
    force[:, 1:] = moved_by(options.pusher_frame, force[:, 1:], turn_only=True)
    lengths = (poses[:, 1:3], recording.names[0], "--length-unit"), (pusher[:, 1:], recording.names[1], "--pusher-length-unit")
    for rows, name, option in lengths:
        remedy = f"Are lengths in millimetres or centimetres? Then give {option} mm or cm."
        LIMITS.COORDINATE.check(float(np.abs(rows).max()), name, error=BagError, remedy=remedy)
    for rows in (pusher, force):
        rows[:, 0] += options.time_offset
    streams = [rows for rows in (poses, pusher, force) if len(rows)]
    first, last = min(float(rows[0, 0]) for rows in streams), max(float(rows[-1, 0]) for rows in streams)
    shift = max(0.0, FIRST_STAMP - first)
    is_table = "--time-unit" in recording.unit_options
    remedy = "Is time in milliseconds? Then give --time-unit ms." if is_table else "Take the times of recording: --log-time."
    LIMITS.STAMP.check(last + shift, recording.names[0], error=BagError, remedy=remedy)
    if poses[-1, 0] < pusher[0, 0] or pusher[-1, 0] < poses[0, 0]:
        of_poses, of_pusher = (f"{rows[0, 0]:.10g} to {rows[-1, 0]:.10g} s" for rows in (poses, pusher))
        raise BagError(
            f"{recording.names[0]} has times {of_poses}, {recording.names[1]} {of_pusher}, expected one clock; check the units of time. "
            f"Where both began together, --time-offset {options.time_offset + poses[0, 0] - pusher[0, 0]:.6f} brings them together."
        )
    if len(force) and (force[-1, 0] < pusher[0, 0] or pusher[-1, 0] < force[0, 0]):
        of_force, of_pusher = (f"{rows[0, 0]:.10g} to {rows[-1, 0]:.10g} s" for rows in (force, pusher))
        raise BagError(
            f"the force has times {of_force}, {recording.names[1]} {of_pusher}, expected one clock; leave the force out, or stamp it by "
            "the clock of the poses."
        )
    for rows in streams:
        rows[:, 0] += shift
    return poses, pusher, force


def _numbered(pusher: Float64Array, numbers: Float64Array) -> list[Float64Array]:
    """Samples of the pusher for each run of one number that is not negative."""
    label = np.where(np.isfinite(numbers), numbers, -1.0)
    starts = np.flatnonzero(np.append(True, label[1:] != label[:-1]))
    return [pusher[a:b] for a, b in zip(starts, np.append(starts[1:], len(label)), strict=True) if label[a] >= 0 and b - a >= 2]


def _motions(pusher: Float64Array, lifted_above: float | None) -> list[Float64Array]:
    """Samples of the pusher for each motion between two pauses, in which it moves by less than its noise or 0.5 mm: 1 mm/s."""
    if lifted_above is not None:
        pusher = pusher[pusher[:, 3] <= lifted_above]
    motions = []
    for run in np.split(pusher, np.flatnonzero(np.diff(pusher[:, 0]) > PAUSE) + 1):
        if len(run) < 2:
            continue
        moving = np.flatnonzero(pusher_moves(run[:, 0], run[:, :3], PAUSE))
        if len(moving):
            motions += [run[part[0] : part[-1] + 1] for part in np.split(moving, np.flatnonzero(np.diff(moving) > 1) + 1) if len(part) >= 2]
    return motions


def _noise(poses: Float64Array, runs: list[Float64Array], name: str, options: RecordingOptions, notes: list[str]) -> tuple[float, float]:
    """Standard deviations of position [m] and yaw [rad]: as given, else from the frames at rest between the pushes."""
    if options.position_std is not None and options.yaw_std is not None:
        return options.position_std, options.yaw_std
    busy = [(run[0, 0] - 0.5 * PAUSE, run[-1, 0] + 0.5 * PAUSE) for run in runs]
    noise = PoseNoise()
    for start, end in _between(busy, float(poses[0, 0]), float(poses[-1, 0])):
        noise.end_rest()
        for time, *pose in poses[(poses[:, 0] >= start) & (poses[:, 0] <= end)].tolist():
            noise.add(time, np.array(pose), moves=False, pause=PAUSE)
    if (scatter := noise.scatter()) is None:
        raise InputError(
            f"{name}: fewer than 10 poses at rest between the pushes, so the noise of a pose is unknown; give {options.noise_option}. "
            f"Poses are {np.median(np.diff(poses[:, 0])):.3g} s apart in the median; where they are not, check the unit of time."
        )
    position, yaw = scatter
    position_std = max(float(position), LEAST_POSITION_STD) if options.position_std is None else options.position_std
    yaw_std = max(float(yaw), LEAST_YAW_STD) if options.yaw_std is None else options.yaw_std
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


def _pushes(streams: Streams) -> list[_Push]:
    spans, time = [], streams.poses[:, 0]
    for run in streams.runs:
        # As a bag is cut into pushes: the poses around the run, and where there is none at rest the nearest one on that side.
        start, end = run[0, 0], run[-1, 0]
        low = min(np.searchsorted(time, start - PAUSE), max(np.searchsorted(time, start, side="right") - 1, 0))
        high = max(np.searchsorted(time, end + PAUSE, side="right"), np.searchsorted(time, end) + 1)
        part = streams.poses[low:high]
        contact = contact_of(part[:, 0], part[:, 1:], run[:, :3], shape=streams.shape, radius=streams.radius, tolerance=streams.tolerance)
        spans.append((run, contact))
    return spans


def _with_contact(spans: list[_Push], tolerance: float, notes: list[str]) -> list[_Push]:
    """The motions in which the object moves or the pusher reaches it."""
    touching = [(run, contact) for run, contact in spans if contact.moved or contact.nearest <= tolerance]
    if missed := len(spans) - len(touching):
        notes.append(f"{missed} motions in which the pusher does not reach the object are left out")
    return touching


def _write(
    out_bag: Path, options: RecordingOptions, streams: Streams, force: Float64Array, spans: list[_Push], covariance: Float64Array
) -> None:
    poses = streams.poses
    first = float(min(poses[0, 0], spans[0][0][0, 0]))
    with BagWriter(out_bag) as writer:
        writer.write_shape(options.object_id, streams.shape, first)
        writer.write_pusher_shape(first, options.radius)
        for time, *pose in poses.tolist():
            writer.write_pose(options.object_id, time, pose, covariance)
        for number, (run, _) in enumerate(spans, 1):
            for time, x, y, z in run.tolist():
                writer.write_pusher(time, (x, y), z=z)
            start, end = float(run[0, 0]), float(run[-1, 0])
            for time, *newtons in force[(force[:, 0] >= start) & (force[:, 0] <= end)].tolist():
                writer.write_wrench(time, newtons)
            writer.write_push_record(number, options.object_id, start, end)
