"""Logs of stable pushes with two fingers of a gripper: a rectangle, a triangle and a butterfly on a table.

J. Zhou, M. T. Mason, "Pushing revisited: differential flatness, trajectory planning and stabilization", ISRR 2017;
github.com/robinzhoucmu/Pushing, folder `differential_flat/exp_data/robot_exp_logs`. A line holds the time [s], the pose of the object
[mm, mm, rad] as a camera saw it, the pose of the hand, and the number of the push of a run. Fingers and outlines are those of
`demo_plangraph_*.m`, without the 1 mm that these add for planning. A pose of zeros means that the object was not seen.

The robot's base frame becomes `table`: x and y unchanged. The object frame has its origin at the centroid. The fingers stand on the y axis
of the hand, which pushes along its x axis.

The poses are late, and the camera is registered to the robot within 2 mm only. Both show in the contacts: while the object moves, it
touches the fingers. No mechanics of the object enter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.bags.importers.recording import ascending
from push_ident.bags.importers.report import ImportReport
from push_ident.bags.importers.shapes import pose_covariance, shape_of_outline
from push_ident.bags.pushes import PAUSE
from push_ident.bags.records import write_records
from push_ident.checking.contact import contact_tolerance, distance_warnings
from push_ident.errors import BagError, InputError
from push_ident.files import read_regular
from push_ident.geometry.outline import signed_distance
from push_ident.limits import check_coordinates, plain_text
from push_ident.types import Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord

_OBJECT_ID: Final = "1"
RADIUS: Final = 0.0025
"""Of a finger [m]."""
_APART: Final = 0.018
"""Distance of the axes of the fingers [m]: three holes of a row with a spacing of 6 mm."""
FINGERS: Final = np.array([[0.0, 0.5 * _APART], [0.0, -0.5 * _APART]])
"""Axes of the fingers [m], frame of the hand."""
_CELL_SIZE: Final = 0.005
"""Edge of the cells of these small objects [m]."""
_RECTANGLE: Final = 0.5 * np.array([[-0.050, -0.035], [0.050, -0.035], [0.050, 0.035], [-0.050, 0.035]])
_TRIANGLE: Final = np.array([[0.058, -0.0275], [0.058, 0.055], [-0.116, -0.0275]]) / 3.0
FINGER_SHAPES: Final[dict[str, Float64Array | None]] = {"bigrect": _RECTANGLE, "tri": _TRIANGLE, "butter": None}
"""Name in the paths of the logs -> outline [m], object frame; None: not published there, to be given."""
_MOVED: Final = 0.003
"""By which an object has certainly been displaced by the fingers [m]: thirty times the scatter of its poses at rest."""
_LATEST: Final = 0.4
"""Longest delay of a pose that is considered [s]: how long each push is observed after its end."""


@dataclass(frozen=True, slots=True)
class Registration:
    """How the poses of the camera lie to those of the hand, in place and in time."""

    delay: float = 0.0
    """By which the stamps of the object are late [s]."""
    camera: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What is added to a pose of the camera (x, y, yaw) [m, m, rad]."""


@dataclass(frozen=True, slots=True)
class FingerOptions:
    """What the logs do not say."""

    shape: str = ""
    """One of `FINGER_SHAPES`; empty: by the names of files and folders."""
    outline: Float64Array | None = None
    """[m], shape (n_vertices, 2), object frame, in place of the published one."""
    registration: Registration | None = None
    """None: by the contacts of these logs."""
    position_std: float = 0.5e-3
    """Standard deviation of a position of the object [m]: the distance of fingers and outline in contact, after registration."""
    yaw_std: float = 0.015
    """Standard deviation of a yaw of the object [rad]: that distance over half the distance of the fingers, less by their number."""
    ends_only: bool = False
    """Whether only the first and the last pose of a push are kept."""


def import_cmu_fingers(paths: Sequence[Path], out_bag: Path, *, options: FingerOptions | None = None) -> ImportReport:
    """Convert logs of pushes with two fingers, or folders of them, to one new contract bag.

    All logs show one object; each of the two or three pushes of a run is one push. A push that has fewer than two poses is left out.

    Raises BagError for a file of another form, InputError for logs of several objects, an unknown shape or options out of range.
    """
    options = options or FingerOptions()
    files = finger_logs(paths)
    shape = _shape_of(files, options)
    pushes, left_out = [], []
    for file in files:
        for number, rows in enumerate(_pushes_of(file), 1):
            if len(rows) < 2:
                left_out.append(f"push {number} of {file.name} is left out: the camera saw {len(rows)} poses of it")
            else:
                pushes.append((f"{file.parent.name}/{file.stem} push {number}", rows))
    if not pushes:
        raise BagError(f"none of {len(files)} logs holds a push whose object was seen twice.")
    registration = options.registration or registration_of([rows for _, rows in pushes], shape)
    write_records(out_bag, [_record(source, rows, shape, registration, options) for source, rows in pushes])
    distances = [_finger_gaps(rows, shape, registration) for _, rows in pushes]
    distance = np.array([float(np.median(gaps)) if gaps.size else np.nan for gaps in distances])
    tolerance = contact_tolerance(shape, position_std=options.position_std, yaw_std=options.yaw_std)
    x, y, yaw = registration.camera
    return ImportReport(
        bag=out_bag,
        n_pushes=len(pushes),
        contact_distance=distance,
        tolerance=tolerance,
        notes=(
            "mass and supports of these objects are not published",
            f"poses are taken {registration.delay:.3f} s earlier than stamped, and {1e3 * x:.2f} mm, {1e3 * y:.2f} mm, "
            f"{np.degrees(yaw):.2f} degrees from where the camera saw them: so the fingers touch the object while it moves",
            *(("object poses are known before and after each push only",) if options.ends_only else ()),
            *left_out,
        ),
        warnings=distance_warnings(distance, tolerance),
    )


def finger_logs(paths: Sequence[Path]) -> list[Path]:
    """The files, those of folders and their folders by name. Raises InputError for a folder without any."""
    files: list[Path] = []
    for path in map(Path, paths):
        logs = sorted(path.rglob("log*.txt")) if path.is_dir() else [path]
        if not logs:
            raise InputError(f"{path}: no log*.txt in it; give the logs of `robot_exp_logs`, or a folder of them.")
        files += logs
    return files


def registration_of(pushes: Sequence[Float64Array], shape: ObjectShape) -> Registration:
    """Delay and displacement of the poses with which both fingers touch the object while it moves.

    Robust least squares of the distances of fingers and outline. What the pushes do not show stays near 0, by a prior of 0.1 s, 2 mm and
    0.02 rad.

    Args:
        pushes: rows (time, pose of the object, pose of the hand) [s, m, m, rad, m, m, rad], shape (n, 7), one array for each push.
        shape: of the object.
    """
    from scipy.optimize import least_squares

    units, noise = np.array([0.1, 2e-3, 2e-3, 0.02]), 0.5e-3

    def residuals(x: Float64Array) -> Float64Array:
        tried = Registration(float(x[0] * units[0]), (float(x[1] * units[1]), float(x[2] * units[2]), float(x[3] * units[3])))
        return np.concatenate([*(_finger_gaps(rows, shape, tried).ravel() / noise for rows in pushes), x])

    # From no delay, the search ends where a turn of the camera stands for it.
    start, latest = np.array([1.0, 0.0, 0.0, 0.0]), _LATEST / units[0]
    bounds = (np.array([0.0, *np.full(3, -np.inf)]), np.array([latest, *np.full(3, np.inf)]))
    x = least_squares(residuals, start, loss="soft_l1", bounds=bounds).x * units
    return Registration(float(x[0]), (float(x[1]), float(x[2]), float(x[3])))


def pushes_of_logs(paths: Sequence[Path]) -> list[Float64Array]:
    """Rows as `registration_of` takes them, one array for each push of the logs. Raises BagError for a file of another form."""
    return [rows for file in finger_logs(paths) for rows in _pushes_of(file) if len(rows) >= 2]


def published_shape(paths: Sequence[Path], options: FingerOptions | None = None) -> ObjectShape:
    """Cells and outline of the object of some logs. Raises InputError where it is not known."""
    return _shape_of(finger_logs(paths), options or FingerOptions())


def _shape_of(files: Sequence[Path], options: FingerOptions) -> ObjectShape:
    names = {name for file in files for name in FINGER_SHAPES if name in f"{file.parent.parent.name}/{file.parent.name}/{file.name}"}
    if options.shape:
        names = {options.shape}
    if len(names) > 1:
        raise InputError(f"the logs show {', '.join(sorted(names))}, expected one object; import each by itself.")
    if options.outline is not None:
        return shape_of_outline(options.outline, cell_size=_CELL_SIZE)
    known = FINGER_SHAPES.get(next(iter(names), ""))
    if known is None:
        got = plain_text(next(iter(names), "no name of an object"))
        raise InputError(f"the outline of {got} is not published with the logs; give --outline FILE, or --shape {' or '.join(_known())}.")
    return shape_of_outline(known, cell_size=_CELL_SIZE)


def _known() -> list[str]:
    return [name for name, outline in FINGER_SHAPES.items() if outline is not None]


def _pushes_of(file: Path) -> list[Float64Array]:
    """Rows (time, pose of the object, pose of the hand) of each push of a run [s, m, m, rad, m, m, rad], shape (n, 7)."""
    try:
        text = read_regular(file).decode("utf-8", errors="replace")
    except OSError as error:
        raise BagError(f"{file}: cannot be read ({error.strerror or error}).") from None
    try:
        rows = np.array([[float(word) for word in line.split(",")] for line in text.splitlines() if line.strip()])
    except ValueError as error:
        raise BagError(f"{file}: {plain_text(str(error))}; expected lines of eight numbers: time, object, hand, push.") from None
    if rows.ndim != 2 or rows.shape[1] != 8 or not np.isfinite(rows).all():
        raise BagError(f"{file}: an array of shape {rows.shape}, expected lines of eight finite numbers: time, object, hand, push.")
    seen = ~np.all(rows[:, 1:4] == 0.0, axis=1)
    pushes = []
    for part in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(rows[:, 7])) + 1):
        chosen = ascending(rows[part[seen[part]], :7])
        chosen[:, [1, 2, 4, 5]] *= 1e-3
        check_coordinates(chosen[:, [1, 2, 4, 5]], str(file), error=BagError)
        chosen[:, 3], chosen[:, 6] = np.unwrap(chosen[:, 3]), np.unwrap(chosen[:, 6])
        pushes.append(_without_stale(chosen))
    return pushes


def _without_stale(rows: Float64Array) -> Float64Array:
    """A push without what its first rows still show: the hand where it ended the push before, the object where it lay before it was put
    elsewhere."""
    if len(rows) < 2:
        return rows
    # The hand is lifted over to where the next push begins while nothing is logged.
    rows = max(np.split(rows, np.flatnonzero(np.diff(rows[:, 0]) > PAUSE) + 1), key=len)
    standing = int(np.argmax(np.append(np.hypot(*(rows[:, 4:6] - rows[0, 4:6]).T) > _MOVED, True)))
    elsewhere = np.hypot(*(rows[:standing, 1:3] - rows[max(standing - 1, 0), 1:3]).T) > _MOVED
    return rows[int(np.max(np.flatnonzero(elsewhere), initial=-1)) + 1 :]


def _finger_gaps(rows: Float64Array, shape: ObjectShape, registration: Registration) -> Float64Array:
    """Distance of each finger from the object while it moves [m], shape (n, 2)."""
    moving = np.hypot(*(rows[:, 1:3] - rows[0, 1:3]).T) > _MOVED
    going = np.append(np.hypot(*np.diff(rows[:, 4:6], axis=0).T) > 0.0, False)
    # At the highest delay, too, there is a pose of each.
    time = rows[:, 0] - rows[0, 0]  # seconds since 1970 have no digits left for a derivative
    chosen = np.flatnonzero(moving & going & (time + _LATEST < time[-1]))
    observed = [np.interp(time[chosen] + registration.delay, time, rows[:, axis]) for axis in (1, 2, 3)]
    poses, hands = np.column_stack(observed) + registration.camera, rows[chosen, 4:7]
    from_object = hands[:, None, :2] + _turned(hands[:, 2], FINGERS[None]) - poses[:, None, :2]
    tips = _turned(-poses[:, 2], from_object)
    return np.asarray(signed_distance(tips.reshape(-1, 2), shape.outline) - RADIUS).reshape(-1, 2)


def _turned(angle: Float64Array, points: Float64Array) -> Float64Array:
    """Points, shape (n or 1, m, 2), turned by each angle [rad], shape (n,)."""
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _record(source: str, rows: Float64Array, shape: ObjectShape, registration: Registration, options: FingerOptions) -> PushRecord:
    time = rows[:, 0] - rows[0, 0]
    poses, stamps = rows[:, 1:4] + registration.camera, time - registration.delay
    if options.ends_only:
        poses, stamps = poses[[0, -1]], stamps[[0, -1]]
    covariance = np.tile(pose_covariance(options.position_std, options.yaw_std), (len(poses), 1, 1))
    path = PusherPath(time, rows[:, 4:6], RADIUS, yaw=rows[:, 6], fingers=FINGERS)
    return PushRecord(_OBJECT_ID, shape, PoseTrack(stamps, poses, covariance), path, source=source)
