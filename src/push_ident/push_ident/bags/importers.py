"""Published pushing recordings, converted to contract bags.

Both come from J. Zhou, R. Paolini, J. A. Bagnell, M. T. Mason, "A convex polynomial force-motion model
for planar sliding: identification and application", ICRA 2016 (data under Apache-2.0). The robot's base frame becomes `table`: x and y
unchanged, z up, lengths in metres. The object frame has its origin at the right-angle corner and its axes along the legs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.opening import open_bag
from push_ident.bags.storage.storage import open_regular
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError
from push_ident.geometry.outline import cells_in_outline, signed_distance
from push_ident.geometry.se2 import inverse, rotation, transform_points
from push_ident.limits import LIMITS
from push_ident.types import Float64Array, ObjectShape

__all__ = ["ImportReport", "import_cmu_icra16", "import_cmu_mocap"]

_MM: Final = 1e-3
_OBJECT_ID: Final = "1"
_CELL_SIZE: Final = 0.01
_COVARIANCE: Final = np.diag([1e-3**2, 1e-3**2, np.radians(0.5) ** 2])
"""Covariance of an object pose: 1 mm and 0.5 degrees, about the distance between tool and outline at contact."""


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What was imported, and published properties of the object that a bag cannot hold."""

    bag: Path
    n_pushes: int
    contact_distance: Float64Array
    """Distance of the pusher's axis to the outline at first contact of each push [m], negative inside, shape (n_pushes,)."""
    supports: Float64Array
    """Known support points [m], shape (n_supports, 2), object frame."""
    mass: float
    """[kg]"""
    centre_of_mass: Float64Array
    """[m], shape (2,), object frame."""
    notes: tuple[str, ...]


# Tool axes of the force sensor: turned by 45 degrees and mirrored, since the tool's z axis points down.
_TOOL_AXES: Final = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
_N_BIAS: Final = 20
"""Number of samples before contact from which the bias of the force sensor is estimated."""
_ICRA16_CONTACT: Final = 0.2
"""Least force in contact [N]; the noise is 0.02 N, sliding friction 4 N."""


def import_cmu_icra16(text_file: Path, out_bag: Path) -> ImportReport:
    """Convert a text file of single-point pushes (aluminium triangle on three supports) to a new contract bag.

    The object's pose is known before and after each push only. Raises BagError for another file format.
    """
    shape = _triangle(0.150, 0.150)
    pushes = _parse_icra16(Path(text_file))
    distances = []
    with BagWriter(out_bag) as writer:
        for number, (before, after, measured, robot) in enumerate(pushes):
            if number == 0:
                _write_scene(writer, shape, robot[0, 0])
            force = _icra16_force(measured[:, 1:], yaw_tool=2.0 * np.arctan2(robot[0, 7], robot[0, 4]))
            writer.write_pose(_OBJECT_ID, robot[0, 0], before, _COVARIANCE)
            for time, x, y, z, *_ in robot:
                writer.write_pusher(time, (x * _MM, y * _MM), z=z * _MM)
            for time, newtons in zip(measured[:, 0], force, strict=True):
                writer.write_wrench(time, newtons)
            writer.write_pose(_OBJECT_ID, robot[-1, 0], after, _COVARIANCE)
            contact = measured[np.argmax(np.linalg.norm(force, axis=1) > _ICRA16_CONTACT), 0]
            position = np.array([np.interp(contact, robot[:, 0], robot[:, axis]) for axis in (1, 2)]) * _MM
            distances.append(_distance(position, before, shape))
    return ImportReport(
        bag=out_bag,
        n_pushes=len(pushes),
        contact_distance=np.array(distances),
        supports=np.array([[0.03, 0.03], [0.09, 0.03], [0.03, 0.09]]),
        mass=1.518,
        centre_of_mass=np.array([0.05, 0.05]),
        notes=("the pusher is a thin rod, modelled as a point", "object poses are known before and after each push only"),
    )


def _icra16_force(raw: Float64Array, *, yaw_tool: float) -> Float64Array:
    """Force on the object in `table` [N], shape (n, 2): the sensor measures its reaction, in tool axes, with a bias."""
    return -(raw - raw[:_N_BIAS].mean(axis=0)) @ _TOOL_AXES.T @ rotation(yaw_tool).T


_Icra16Push = tuple[Float64Array, Float64Array, Float64Array, Float64Array]


def _parse_icra16(file: Path) -> list[_Icra16Push]:
    """Pose before and after (x, y, yaw) [m, m, rad], force samples (time, fx, fy), robot samples (time, x, y, z, qw, qx, qy, qz)."""
    if not file.exists():
        raise BagError(f"{file}: there is no such file; give the recording's text file.")
    try:
        with open_regular(file) as text:
            content = text.read(LIMITS.TEXT_FILE.value + 1)
        LIMITS.TEXT_FILE.check(len(content), str(file), error=BagError)
        numbers = np.array(content.split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise BagError(f"{file}: not a text file of numbers ({str(error)[:100]}); give the recording's text file.") from error
    at = 0

    def take(rows: int, columns: int) -> Float64Array:
        nonlocal at
        if rows < 1 or at + rows * columns > len(numbers):
            raise BagError(f"{file}: ends after {len(numbers)} numbers, or is not a recording of pushes; download it again.")
        block = numbers[at : at + rows * columns].reshape(rows, columns)
        at += rows * columns
        return block

    def count() -> int:
        value = float(take(1, 1)[0, 0])
        # `take` refuses an invalid count, like a count beyond the end of the file.
        return int(value) if value.is_integer() and abs(value) < 2**31 else 0

    pushes = []
    for _ in range(max(1, count())):
        ends = [np.array([x * _MM, y * _MM, 2.0 * np.arctan2(qz, qw)]) for x, y, _, qw, _, _, qz in take(2, 7)]
        measured, robot = _ascending(take(count(), 3)), _ascending(take(count(), 8))
        pushes.append((ends[0], ends[1], measured, robot))
    if at != len(numbers):
        raise BagError(f"{file}: {len(numbers) - at} numbers follow after {len(pushes)} pushes; not a recording of this format.")
    return pushes


def _ascending(samples: Float64Array) -> Float64Array:
    """Samples (time first) without those whose time does not advance."""
    return samples[np.append(True, np.diff(np.maximum.accumulate(samples[:, 0])) > 0)]


# Motion-capture body to right-angle corner of the block [mm], applied on the right of the body's pose.
_CORNER_IN_BODY: Final = np.array(
    [
        [-0.582574, 0.812668, -0.00531035, -2.38805],
        [0.00730846, 0.0198042, 0.999895, -35.7798],
        [0.812695, 0.582376, -0.0127986, -39.5608],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
_MOCAP_CONTACT: Final = 0.1
"""Least force in contact [N]; the noise is 0.01 N, sliding friction 0.4 N."""
_PAUSE: Final = 0.6
"""Shortest standstill of the robot that ends a push [s]."""
_MARGIN: Final = 0.3
"""Standstill kept at both ends of a push [s]."""
_SHORTEST: Final = 0.3
"""Shortest motion in contact that counts as a push [s]."""


def import_cmu_mocap(bag_file: Path, out_bag: Path) -> ImportReport:
    """Convert the ROS 1 bag of many consecutive pushes (wooden triangle on three supports, motion capture) to a new contract bag.

    Every motion-capture pose is kept; the pusher's path is kept where the robot moves in contact, so that its gaps separate the pushes.
    Raises BagError when the bag cannot be read or lacks a topic.
    """
    shape = _triangle(0.101, 0.099)
    time, pose, robot, measured = _read_mocap(Path(bag_file))
    force = np.linalg.norm(measured[:, 1:] - np.median(measured[: 10 * _N_BIAS, 1:], axis=0), axis=1)
    in_contact = np.interp(robot[:, 0], measured[:, 0], force) > _MOCAP_CONTACT
    distances = []
    spans = _spans_of_motion(robot, in_contact)
    with BagWriter(out_bag) as writer:
        _write_scene(writer, shape, time[0])
        for stamp, planar in zip(time, pose, strict=True):
            writer.write_pose(_OBJECT_ID, stamp, planar, _COVARIANCE)
        for start, end in spans:
            span = (robot[:, 0] >= start) & (robot[:, 0] <= end)
            for stamp, x, y, z in robot[span]:
                writer.write_pusher(stamp, (x, y), z=z)
            touching = robot[span & in_contact]
            at = _nearest(time, touching[:, 0])
            # The median over the whole contact: a single motion-capture pose has an error of about a millimetre.
            distances.append(np.median([_distance(p, pose[k], shape) for p, k in zip(touching[:, 1:3], at, strict=True)]))
    return ImportReport(
        bag=out_bag,
        n_pushes=len(spans),
        contact_distance=np.array(distances),
        supports=np.array([[0.010, 0.010], [0.084, 0.010], [0.010, 0.084]]),
        mass=0.128,
        centre_of_mass=np.array([0.0293, 0.0293]),
        notes=(
            "the pusher's axis stays within 2 mm of the outline in contact, on either side: it is modelled as a point",
            "the force is used to detect contact only: the mounting of its sensor is not recorded",
        ),
    )


def _nearest(time: Float64Array, stamps: Float64Array) -> list[int]:
    """Index of the nearest `time`, ascending, at least two, for each stamp."""
    after = np.clip(np.searchsorted(time, stamps), 1, len(time) - 1)
    return [int(k) for k in np.where(stamps - time[after - 1] <= time[after] - stamps, after - 1, after)]


def _read_mocap(file: Path) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Time of the poses [s], corner pose (x, y, yaw) in `table`, robot (time, x, y, z) [m], force sensor (time, fx, fy) [N].

    The log time is used for all: the robot's messages have no stamp, and the clock of the force sensor has an error of minutes.
    """
    rows: dict[str, list[tuple[float, ...]]] = {"/Mocap": [], "/robot_CartesianLog": [], "/netft_data": []}
    with open_bag(file) as bag:
        connections = [connection for connection in bag.topics if connection.topic in rows]
        bag.register(connections)
        for connection, log_time, message in bag.messages(connections):
            if values := _mocap_row(connection.topic, message):
                rows[connection.topic].append((log_time * 1e-9, *values))
    if missing := [topic for topic, values in rows.items() if len(values) < 2]:
        raise BagError(f"{file}: no messages of {', '.join(missing)}; not a recording of this format.")
    body, robot, measured = (_ascending(np.array(values)) for values in rows.values())
    return body[:, 0], _corner_pose(body[:, 1:4], body[:, 4:]), robot * [1.0, _MM, _MM, _MM], measured


def _mocap_row(topic: str, message: Any) -> tuple[float, ...]:
    """Numbers of one message; empty where the body was not detected."""
    if topic == "/Mocap":
        if not message.body_poses:
            return ()
        position, turn = message.body_poses[0].position, message.body_poses[0].orientation
        quaternion = (turn.x, turn.y, turn.z, turn.w)
        return (position.x, position.y, position.z, *quaternion) if 0.0 < sum(q * q for q in quaternion) < np.inf else ()
    if topic == "/robot_CartesianLog":
        return (message.x, message.y, message.z)
    return (message.wrench.force.x, message.wrench.force.y)


def _corner_pose(position: Float64Array, quaternion: Float64Array) -> Float64Array:
    """Planar pose of the right-angle corner, shape (n, 3) [m, m, rad], from poses of the motion-capture body [mm]."""
    from scipy.spatial.transform import Rotation

    body = Rotation.from_quat(quaternion).as_matrix()
    corner = body @ _CORNER_IN_BODY[:3, 3] + position
    x_axis = body @ _CORNER_IN_BODY[:3, 0]
    return np.column_stack([corner[:, :2] * _MM, np.unwrap(np.arctan2(x_axis[:, 1], x_axis[:, 0]))])


def _spans_of_motion(robot: Float64Array, in_contact: Any) -> list[tuple[float, float]]:
    """Start and end [s] of each push: the robot moves, touching the object, between two pauses."""
    moving = np.flatnonzero(np.any(np.diff(robot[:, 1:3], axis=0) != 0, axis=1))
    spans = []
    for run in np.split(moving, np.flatnonzero(np.diff(robot[moving, 0]) > _PAUSE) + 1):
        touching = run[in_contact[run]]
        if len(touching) and robot[touching[-1], 0] - robot[touching[0], 0] >= _SHORTEST:
            spans.append((float(robot[run[0], 0]) - _MARGIN, float(robot[run[-1] + 1, 0]) + _MARGIN))
    return spans


def _triangle(leg_x: float, leg_y: float) -> ObjectShape:
    """A right triangle with its right angle in the origin."""
    outline = np.array([[0.0, 0.0], [leg_x, 0.0], [0.0, leg_y]])
    return ObjectShape(cells_in_outline(outline, _CELL_SIZE), outline)


def _write_scene(writer: BagWriter, shape: ObjectShape, stamp: float) -> None:
    writer.write_shape(_OBJECT_ID, shape, stamp)
    writer.write_pusher_shape(stamp, 0.0)


def _distance(point_in_table: Float64Array, pose: Float64Array, shape: ObjectShape) -> float:
    """Signed distance of a point to the outline at a pose [m]."""
    return float(signed_distance(transform_points(inverse(pose), point_in_table[None]), shape.outline)[0])
