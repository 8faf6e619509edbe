"""Text files of single-point pushes of an aluminium triangle, as its authors published them.

J. Zhou, R. Paolini, J. A. Bagnell, M. T. Mason, "A convex polynomial force-motion model for planar sliding: identification and
application", ICRA 2016. The sets lie in the repository MLab_EXP of the first author (Apache-2.0), folder `PushExp/sensor_log`, one
folder for each surface and each set of supports. The folder names both: `30_90_30_30_30_90` are x of three supports, then y [mm];
`wood_` before it is the wooden board, nothing the black hardboard; `patch` has no supports, the block lies on its whole base.

The robot's base frame becomes `table`: x and y unchanged, z up, lengths in metres. The object frame has its origin at the right-angle
corner and its axes along the legs.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.bags.importers.recording import ascending
from push_ident.bags.importers.report import ImportReport
from push_ident.bags.importers.shapes import check_supports, pose_covariance, right_triangle
from push_ident.bags.writer import BagWriter
from push_ident.checking.contact import contact_tolerance, distance_warnings
from push_ident.errors import BagError
from push_ident.files import read_regular
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, rotation, transform_points
from push_ident.limits import LIMITS, check_coordinates
from push_ident.types import Float64Array, ObjectShape

_OBJECT_ID: Final = "1"
_LEG: Final = 0.150
"""Both legs of the triangle [m]; `PushExp/parameters/aluminium_triangle/obj_geo.txt`."""
_MASS: Final = 1.518
"""Of the triangle [kg]; `demo_multilog_robot_exp.m`, for every set."""
_POSITION_STD, _YAW_STD = 1e-3, float(np.radians(0.5))
"""Standard deviations of an object pose: 1 mm and 0.5 degrees, about the distance between tool and outline at contact.

Poses repeat better: the object lies still between two pushes, and its poses after one and before the next differ by 0.1 mm, 0.01 degrees.
The distance has errors of 0.7 mm that the poses before and after a push mostly share (correlation 0.8), as of a calibration.
"""
_TOOL_AXES: Final = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
"""Tool axes of the force sensor: turned by 45 degrees and mirrored, since the tool's z axis points down."""
_NUMBER: Final = r"\d{1,3}(?:\.\d{1,3})?"
_SUPPORTS: Final = re.compile(rf"(?P<wood>wood_)?(?P<supports>{_NUMBER}(?:_{_NUMBER}){{5}})(?:__.*)?")
_PATCH: Final = re.compile(r"(?P<wood>wood_)?patch(?:__.*)?")


@dataclass(frozen=True, slots=True)
class _Push:
    before: Float64Array
    """Object pose (x, y, yaw) in `table` [m, m, rad]."""
    after: Float64Array
    force: Float64Array
    """Rows (time, fx, fy) of the sensor [s, N, N], tool axes, with bias; no rows in a file without force."""
    robot: Float64Array
    """Rows (time, x, y, z, qw, qx, qy, qz) of the tool tip [s, mm]."""


@dataclass(frozen=True, slots=True)
class _Setup:
    """What the names of folder and file say."""

    surface: str = ""
    supports: Float64Array | None = None
    """[m], shape (3, 2); empty: whole base; None: unknown."""


def import_cmu_icra16(text_file: Path, out_bag: Path, *, supports: Float64Array | None = None) -> ImportReport:
    """Convert a text file of single-point pushes of the aluminium triangle to a new contract bag.

    The object's pose is known before and after each push only. Surface and supports are read from the name of the file or of its folder;
    `supports` [m], shape (n, 2), from the right-angle corner, replaces the latter. They are reported, a bag cannot hold them.

    Raises BagError for another file format, InputError for supports outside the triangle.
    """
    text_file = Path(text_file)
    shape = right_triangle(_LEG, _LEG)
    setup = _setup_of(text_file)
    points = setup.supports if supports is None else supports
    known = check_supports(np.zeros((0, 2)) if points is None else points, shape)
    pushes, notes = _parse(text_file)
    covariance = pose_covariance(_POSITION_STD, _YAW_STD)
    with BagWriter(out_bag) as writer:
        writer.write_shape(_OBJECT_ID, shape, pushes[0].robot[0, 0])
        writer.write_pusher_shape(pushes[0].robot[0, 0], 0.0)
        distance = np.array([_write_push(writer, push, shape, covariance) for push in pushes])
    tolerance = contact_tolerance(shape, position_std=_POSITION_STD, yaw_std=_YAW_STD)
    return ImportReport(
        bag=out_bag,
        n_pushes=len(pushes),
        contact_distance=distance,
        tolerance=tolerance,
        supports=known,
        mass=_MASS,
        centre_of_mass=np.array([_LEG, _LEG]) / 3.0,
        surface=setup.surface,
        notes=(
            "the pusher is a thin rod, modelled as a point",
            "object poses are known before and after each push only",
            *notes,
            *_notes_of(points),
        ),
        warnings=distance_warnings(distance, tolerance),
    )


def _notes_of(supports: Float64Array | None) -> tuple[str, ...]:
    if supports is None:
        return ("neither the file's name nor its folder's names the supports; give them with --supports where you know them",)
    return () if len(supports) else ("the block lies on its whole base, not on supports",)


def _setup_of(file: Path) -> _Setup:
    for name in (file.stem, file.absolute().parent.name):
        if match := _SUPPORTS.fullmatch(name):
            x, y = np.array(match["supports"].split("_"), dtype=np.float64).reshape(2, 3) * 1e-3
            return _Setup("wood" if match["wood"] else "hardboard", np.column_stack([x, y]))
        if match := _PATCH.fullmatch(name):
            return _Setup("wood" if match["wood"] else "hardboard", np.zeros((0, 2)))
    return _Setup()


def _write_push(writer: BagWriter, push: _Push, shape: ObjectShape, covariance: Float64Array) -> float:
    """Write one push; returns the distance of the tool to the outline at first contact [m], NaN without contact."""
    robot = push.robot
    writer.write_pose(_OBJECT_ID, robot[0, 0], push.before, covariance)
    for time, x, y, z, *_ in robot:
        writer.write_pusher(time, (x * 1e-3, y * 1e-3), z=z * 1e-3)
    distance = np.nan
    if len(push.force):
        force = _force(push.force[:, 1:], yaw_tool=2.0 * np.arctan2(robot[0, 7], robot[0, 4]))
        for time, newtons in zip(push.force[:, 0], force, strict=True):
            writer.write_wrench(time, newtons)
        touching = np.linalg.norm(force, axis=1) > 0.2  # [N]; the noise is 0.02 N, sliding friction 4 N
        if touching.any():
            contact = push.force[np.argmax(touching), 0]
            position = np.array([np.interp(contact, robot[:, 0], robot[:, axis]) for axis in (1, 2)]) * 1e-3
            distance = float(signed_distance(transform_points(inverse(push.before), position[None]), shape.outline)[0])
    writer.write_pose(_OBJECT_ID, robot[-1, 0], push.after, covariance)
    return distance


def _force(raw: Float64Array, *, yaw_tool: float) -> Float64Array:
    """Force on the object in `table` [N], shape (n, 2): the sensor measures its reaction, in tool axes, with the bias of the first 20."""
    return -(raw - raw[:20].mean(axis=0)) @ _TOOL_AXES.T @ rotation(yaw_tool).T


class _Numbers:
    def __init__(self, file: Path) -> None:
        self.file = file
        if not file.exists():
            raise BagError(f"{file}: there is no such file; give the recording's text file.")
        try:
            self.all = np.array(read_regular(file, LIMITS.TEXT_FILE.value).split(), dtype=np.float64)
        except (OSError, ValueError) as error:
            raise BagError(f"{file}: not a text file of numbers ({str(error)[:100]}); give the recording's text file.") from error
        if not np.isfinite(self.all).all():
            raise BagError(f"{file}: number {int(np.argmin(np.isfinite(self.all)))} is not finite; download it again.")
        self.at = 0

    @property
    def left(self) -> int:
        return len(self.all) - self.at

    def take(self, rows: int, columns: int) -> Float64Array:
        """The next rows; raises BagError where the file has not so many numbers."""
        if rows < 0 or rows * columns > self.left:
            raise BagError(f"{self.file}: ends after {len(self.all)} numbers, or is not a recording of pushes; download it again.")
        block = self.all[self.at : self.at + rows * columns].reshape(rows, columns)
        self.at += rows * columns
        return block

    def count(self, least: int) -> int:
        """The next number, a count; raises BagError for another number."""
        value = float(self.take(1, 1)[0, 0])
        if not (value.is_integer() and least <= value < 2**31):
            raise BagError(f"{self.file}: a count is {value:g}, expected a whole number from {least}; not a recording of this format.")
        return int(value)


def _check_times(time: Float64Array, file: Path) -> None:
    """Raise BagError unless times [s], in order, are such that a bag can hold."""
    if len(time) and not (time[0] > 0 and time[-1] <= LIMITS.STAMP.value):
        raise BagError(f"{file}: times are {time[0]:g} to {time[-1]:g} s, expected Unix time; not a recording of this format.")


def _parse(file: Path) -> tuple[list[_Push], list[str]]:
    """The pushes of a file, and notes. Some published files were broken off: they hold fewer pushes than they announce."""
    numbers = _Numbers(file)
    announced = numbers.count(1)
    LIMITS.PUSHES.check(announced, str(file), error=BagError)
    pushes: list[_Push] = []
    for _ in range(announced):
        if pushes and not numbers.left:
            break
        poses = numbers.take(2, 7)
        before, after = (np.array([x * 1e-3, y * 1e-3, 2.0 * np.arctan2(qz, qw)]) for x, y, _, qw, _, _, qz in poses)
        force, robot = ascending(numbers.take(numbers.count(0), 3)), ascending(numbers.take(numbers.count(1), 8))
        check_coordinates(np.vstack([poses[:, :3], robot[:, 1:4]]) * 1e-3, str(file), error=BagError)
        _check_times(force[:, 0], file)
        _check_times(robot[:, 0], file)
        pushes.append(_Push(before, after, force, robot))
    if numbers.left:
        raise BagError(f"{file}: {numbers.left} numbers follow after {len(pushes)} pushes; not a recording of this format.")
    notes = [f"the file announces {announced} pushes and holds {len(pushes)}: it was broken off"] if len(pushes) < announced else []
    if silent := sum(not len(push.force) for push in pushes):
        notes.append(f"{silent} pushes have no force: where their contact begins is unknown")
    return pushes, notes
