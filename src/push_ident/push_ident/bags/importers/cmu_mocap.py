"""ROS 1 bags of many consecutive pushes of a wooden triangle, observed by motion capture.

From the same group and repository as `cmu_icra16.py` (MLab_EXP, Apache-2.0), folder `Mocap/PythonExp/bags`. The robot's base frame
becomes `table`: x and y unchanged, z up, lengths in metres. The object frame has its origin at the right-angle corner and its axes along
the legs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.importers.recording import ascending
from push_ident.bags.importers.report import ImportReport
from push_ident.bags.importers.shapes import check_supports, pose_covariance, right_triangle, shape_of_outline
from push_ident.bags.opening import open_bag
from push_ident.bags.writer import BagWriter
from push_ident.checking.contact import contact_tolerance, distance_warnings
from push_ident.errors import BagError, InputError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.limits import check_coordinates
from push_ident.types import Float64Array, ObjectShape

_OBJECT_ID: Final = "1"
_POSITION_STD, _YAW_STD = 1e-3, float(np.radians(0.5))
"""Standard deviations of an object pose: 1 mm and 0.5 degrees, about the distance between tool and outline at contact."""
_CORNER_IN_BODY: Final = np.array(
    [
        [-0.582574, 0.812668, -0.00531035, -2.38805],
        [0.00730846, 0.0198042, 0.999895, -35.7798],
        [0.812695, 0.582376, -0.0127986, -39.5608],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Motion-capture body to right-angle corner of the wooden triangle [mm], applied on the right of the body's pose; `Tr1Reg.txt`."""
_LEGS: Final = (0.101, 0.099)
"""Of the wooden triangle along x and y [m]; `wood_triangle/obj_geo.txt`."""
_MASS: Final = 0.128
"""Of the wooden triangle [kg]; `demo_mc_ft.m`, as its centre of mass and the outer supports."""
_CENTRE_OF_MASS: Final = (0.0293, 0.0293)
_OUTER_SUPPORTS: Final = ((0.010, 0.010), (0.084, 0.010), (0.010, 0.084))
_OUTER: Final = ("3out",)
"""Parts of the file names of recordings on the three outer supports."""
_SHORTEST: Final = 0.3
"""Shortest motion in contact that counts as a push [s]."""


@dataclass(frozen=True, slots=True)
class MocapObject:
    """What a recording does not say about its object; None: as published for the wooden triangle."""

    outline: Float64Array | None = None
    """[m], shape (n_vertices, 2), object frame."""
    frame_in_body: Float64Array | None = None
    """Object frame in the frame of the motion-capture body [mm], homogeneous, shape (4, 4)."""
    supports: Float64Array | None = None
    """[m], shape (n, 2), object frame. None: those of the recordings whose name has `3out`, otherwise unknown."""
    mass: float | None = None
    """[kg]"""


def import_cmu_mocap(bag_file: Path, out_bag: Path, *, body: MocapObject | None = None) -> ImportReport:
    """Convert a ROS 1 bag of many consecutive pushes (wooden triangle, motion capture) to a new contract bag.

    Every motion-capture pose is kept, and the pusher's path where the robot moves in contact. A record of each push says where it begins
    and ends: pauses between pushes are too short to tell.
    `body` describes another object, or supports that the file's name does not tell.

    Raises BagError when the bag cannot be read or lacks a topic, InputError for a `body` that is none.
    """
    bag_file, body = Path(bag_file), body or MocapObject()
    shape = right_triangle(*_LEGS) if body.outline is None else shape_of_outline(body.outline)
    supports = _supports_of(bag_file, body, shape)
    time, pose, robot, measured = _read(bag_file, _frame_in_body(body))
    force = np.linalg.norm(measured[:, 1:] - np.median(measured[:200, 1:], axis=0), axis=1)  # the first samples show the bias
    in_contact = np.interp(robot[:, 0], measured[:, 0], force) > 0.1  # [N]; the noise is 0.01 N, sliding friction 0.4 N
    covariance = pose_covariance(_POSITION_STD, _YAW_STD)
    spans = _spans_of_motion(robot, in_contact)
    if not spans:
        raise BagError(f"{bag_file}: the robot never moves in contact with the object for {_SHORTEST} s; not a recording of pushes.")
    distances = []
    with BagWriter(out_bag) as writer:
        writer.write_shape(_OBJECT_ID, shape, time[0])
        writer.write_pusher_shape(time[0], 0.0)
        for stamp, planar in zip(time, pose, strict=True):
            writer.write_pose(_OBJECT_ID, stamp, planar, covariance)
        for number, (start, end) in enumerate(spans, 1):
            writer.write_push_record(number, _OBJECT_ID, start, end)
            span = (robot[:, 0] >= start) & (robot[:, 0] <= end)
            for stamp, x, y, z in robot[span]:
                writer.write_pusher(stamp, (x, y), z=z)
            touching = robot[span & in_contact]
            at = _nearest(time, touching[:, 0])
            # The median over the whole contact: a single motion-capture pose has an error of about a millimetre.
            distances.append(np.median([_distance(p, pose[k], shape) for p, k in zip(touching[:, 1:3], at, strict=True)]))
    published = body.outline is None
    distance = np.array(distances, dtype=np.float64)
    tolerance = contact_tolerance(shape, position_std=_POSITION_STD, yaw_std=_YAW_STD)
    return ImportReport(
        bag=out_bag,
        n_pushes=len(spans),
        contact_distance=distance,
        tolerance=tolerance,
        supports=supports,
        mass=_MASS if published and body.mass is None else body.mass,
        centre_of_mass=np.array(_CENTRE_OF_MASS) if published else None,
        notes=(
            "the radius of the pusher is not published: it is modelled as a point",
            "the force is used to detect contact only: the mounting of its sensor is not recorded",
            *(
                ()
                if len(supports)
                else ("the supports of this recording are not published; give them with --supports where you know them",)
            ),
        ),
        warnings=distance_warnings(distance, tolerance),
    )


def _supports_of(file: Path, body: MocapObject, shape: ObjectShape) -> Float64Array:
    """Supports that the user gave or that the file's name stands for [m], shape (n, 2)."""
    if body.supports is not None:
        return check_supports(body.supports, shape)
    known = body.outline is None and any(part in file.name for part in _OUTER)
    return np.array(_OUTER_SUPPORTS if known else [], dtype=np.float64).reshape(-1, 2)


def _frame_in_body(body: MocapObject) -> Float64Array:
    if body.frame_in_body is None:
        return _CORNER_IN_BODY
    turn = body.frame_in_body[:3, :3]
    if body.frame_in_body.shape != (4, 4) or not np.allclose(turn @ turn.T, np.eye(3), atol=5e-3):
        raise InputError(
            f"the object frame in the body has shape {body.frame_in_body.shape}, expected 4 x 4 with a rotation in it and lengths in mm."
        )
    return body.frame_in_body


def _nearest(time: Float64Array, stamps: Float64Array) -> list[int]:
    """Index of the nearest `time`, ascending, at least two, for each stamp."""
    after = np.clip(np.searchsorted(time, stamps), 1, len(time) - 1)
    return [int(k) for k in np.where(stamps - time[after - 1] <= time[after] - stamps, after - 1, after)]


def _read(file: Path, frame_in_body: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Time of the poses [s], object pose (x, y, yaw) in `table`, robot (time, x, y, z) [m], force sensor (time, fx, fy) [N].

    The log time is used for all: the robot's messages have no stamp, and the clock of the force sensor has an error of minutes.
    """
    rows: dict[str, list[tuple[float, ...]]] = {"/Mocap": [], "/robot_CartesianLog": [], "/netft_data": []}
    with open_bag(file) as bag:
        connections = [connection for connection in bag.topics if connection.topic in rows]
        bag.register(connections)
        for connection, log_time, message in bag.messages(connections):
            values = _numbers(connection.topic, message)
            if values and np.isfinite(values).all():
                rows[connection.topic].append((log_time * 1e-9, *values))
    if missing := [topic for topic, values in rows.items() if len(values) < 2]:
        raise BagError(f"{file}: no messages of {', '.join(missing)}; not a recording of this format.")
    body, robot, measured = (ascending(np.array(values)) for values in rows.values())
    pose, robot = _planar_pose(body[:, 1:4], body[:, 4:], frame_in_body), robot * [1.0, 1e-3, 1e-3, 1e-3]
    for lengths in (pose[:, :2], robot[:, 1:]):
        check_coordinates(lengths, str(file), error=BagError)
    return body[:, 0], pose, robot, measured


def _numbers(topic: str, message: Any) -> tuple[float, ...]:
    """Of one message; none where the body was not detected."""
    if topic == "/Mocap":
        if not message.body_poses:
            return ()
        position, turn = message.body_poses[0].position, message.body_poses[0].orientation
        quaternion = (turn.x, turn.y, turn.z, turn.w)
        return (position.x, position.y, position.z, *quaternion) if 0.0 < sum(q * q for q in quaternion) < np.inf else ()
    if topic == "/robot_CartesianLog":
        return (message.x, message.y, message.z)
    return (message.wrench.force.x, message.wrench.force.y)


def _planar_pose(position: Float64Array, quaternion: Float64Array, frame_in_body: Float64Array) -> Float64Array:
    """Planar pose of the object frame, shape (n, 3) [m, m, rad], from poses of the motion-capture body [mm]."""
    from scipy.spatial.transform import Rotation

    body = Rotation.from_quat(quaternion).as_matrix()
    origin = body @ frame_in_body[:3, 3] + position
    x_axis = body @ frame_in_body[:3, 0]
    return np.column_stack([origin[:, :2] * 1e-3, np.unwrap(np.arctan2(x_axis[:, 1], x_axis[:, 0]))])


def _spans_of_motion(robot: Float64Array, in_contact: Any) -> list[tuple[float, float]]:
    """Start and end [s] of each push: the robot moves, touching the object, between two pauses of 0.6 s, half of which is kept."""
    moving = np.flatnonzero(np.any(np.diff(robot[:, 1:3], axis=0) != 0, axis=1))
    spans = []
    for run in np.split(moving, np.flatnonzero(np.diff(robot[moving, 0]) > 0.6) + 1):
        touching = run[in_contact[run]]
        if len(touching) and robot[touching[-1], 0] - robot[touching[0], 0] >= _SHORTEST:
            spans.append((float(robot[run[0], 0]) - 0.3, float(robot[run[-1] + 1, 0]) + 0.3))
    return spans


def _distance(point_in_table: Float64Array, pose: Float64Array, shape: ObjectShape) -> float:
    """Signed distance of a point to the outline at a pose [m]."""
    return float(signed_distance(transform_points(inverse(pose), point_in_table[None]), shape.outline)[0])
