"""Writing contract bags in MCAP; killing the process loses at most one second of data.

A chunk is written when it is full or one second old. A killed process leaves a file without index, from which `salvage` recovers every
written chunk.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final

import numpy as np
import yaml
from mcap.writer import Writer
from numpy.typing import ArrayLike, NDArray

from push_ident.bags.contract import Role, topic_of
from push_ident.bags.typestore import definition_of, jazzy_typestore
from push_ident.errors import BagError, InputError
from push_ident.files import open_new, write_whole
from push_ident.geometry.cut_cells import occupancy
from push_ident.geometry.frames import CAMERA_FRAME, TABLE_FRAME, object_frame
from push_ident.geometry.se2 import quaternion_of_yaw
from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.types import CameraIntrinsics, ObjectShape, PusherShape

_PLANAR: Final = (0, 1, 5)
"""Rows of x, y and yaw in a 6 x 6 covariance."""


class BagWriter:
    """Writes one bag; use it as a context manager. Not thread-safe.

    Args:
        path: A new folder (MCAP and metadata.yaml in it) or, ending in `.mcap`, a new file. Existing ones are refused.
        chunk_size: Bytes of messages after which a chunk is written.

    Stamps are in seconds. Every method raises BagError when a write fails.
    """

    def __init__(self, path: Path, *, chunk_size: int = 256 * 1024) -> None:
        self.path = Path(path)
        self._chunk_size = chunk_size
        self._file: IO[bytes] | None = None
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: dict[int, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        self._flushed = 0.0

    def __enter__(self) -> BagWriter:
        if self.path.exists():
            raise BagError(f"{self.path}: exists already and is not overwritten; choose another name.")
        try:
            self._storage.parent.mkdir(parents=True, exist_ok=True)
            self._file = open_new(self._storage)
            self._writer = Writer(self._file, chunk_size=self._chunk_size)
            self._writer.start(profile="ros2", library="push_ident")
            self._writer.flush()
        except OSError as error:
            raise self._refused(error) from error
        self._flushed = time.monotonic()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        try:
            with file:
                self._writer.finish()
            if self._storage != self.path:
                write_whole(self.path / "metadata.yaml", self._metadata(), "the metadata of the bag", error=BagError)
        except OSError as failure:
            if error is None:
                raise self._refused(failure) from failure

    @property
    def message_count(self) -> int:
        """Messages written so far."""
        return sum(self._counts.values())

    def declare(self, topic: str, msgtype: str) -> None:
        """Write that there is a topic, though it may have no message."""
        self._channel(topic, msgtype, None)

    def write_raw(
        self,
        topic: str,
        msgtype: str,
        stamp_ns: int,
        data: bytes | memoryview,
        *,
        publish_ns: int | None = None,
        definition: tuple[str, bytes] | None = None,
    ) -> None:
        """Write a serialized message.

        Args:
            topic: Full topic name.
            msgtype: As `package/msg/Name`; must be a type of ROS 2 Jazzy or push_ident_msgs unless `definition` is given.
            stamp_ns: Log time [ns], since the same epoch as the header stamps.
            data: The message in CDR, with its encapsulation header.
            publish_ns: When it was published [ns]; by default `stamp_ns`.
            definition: Encoding and text of the type's schema, for types unknown to this package.
        """
        if self._file is None:
            raise BagError(f"{self.path}: the bag is not open for writing; use BagWriter as a context manager.")
        if not 0 <= stamp_ns < 2**63:
            raise BagError(f"{self.path}: log time of a message on {topic} is {stamp_ns} ns, expected 0 to 2^63.")
        try:
            channel = self._channel(topic, msgtype, definition)
            self._writer.add_message(channel, stamp_ns, bytes(data), stamp_ns if publish_ns is None else publish_ns, self._counts[channel])
            now = time.monotonic()
            if now - self._flushed > 1.0:
                self._writer.flush()
                self._flushed = now
        except OSError as error:
            raise self._refused(error) from error
        self._counts[channel] += 1
        self._first_ns = stamp_ns if self._first_ns is None else min(self._first_ns, stamp_ns)
        self._last_ns = max(self._last_ns, stamp_ns)

    def write_pose(self, object_id: str, stamp: float, pose: ArrayLike, covariance: ArrayLike) -> None:
        """Pose (x, y, yaw) of the object frame in `table` [m, m, rad] and its covariance, shape (3, 3)."""
        x, y, yaw = (float(value) for value in np.asarray(pose, dtype=np.float64))
        full = np.eye(6) * 1e-6  # of z [m^2], roll and pitch [rad^2] of an object that lies on the table: small, never zero
        full[np.ix_(_PLANAR, _PLANAR)] = np.asarray(covariance, dtype=np.float64)
        body = self._new("geometry_msgs/msg/PoseWithCovariance", self._pose(x, y, 0.0, yaw), full.ravel())
        self._write(Role.POSE, stamp, self._header(stamp, TABLE_FRAME), body, object_id=object_id)

    def write_pusher(self, stamp: float, position: ArrayLike, *, z: float = 0.0, yaw: float = 0.0) -> None:
        """Position of the tool tip in `table` [m], shape (2,), at height `z`; `yaw` of its frame [rad], which a cylinder does not need."""
        x, y = (float(value) for value in np.asarray(position, dtype=np.float64))
        self._write(Role.PUSHER, stamp, self._header(stamp, TABLE_FRAME), self._pose(x, y, z, yaw))

    def write_pusher_shape(self, stamp: float, radius: float | PusherShape, *, height: float = 0.1) -> None:
        """The pusher: the radius of an upright cylinder [m], or another outline of this height [m]."""
        shape = radius if isinstance(radius, PusherShape) else PusherShape(radius)
        kinds: Any = self._store.types[Role.PUSHER_SHAPE.msgtype]
        kind = kinds.CYLINDER if shape.polygon is None else kinds.PRISM
        corners = [] if shape.is_cylinder else [self._new("geometry_msgs/msg/Point32", float(x), float(y), 0.0) for x, y in shape.core]
        self._write(Role.PUSHER_SHAPE, stamp, kind, np.array([height, shape.radius]), self._new("geometry_msgs/msg/Polygon", corners))

    def write_wrench(self, stamp: float, force: ArrayLike) -> None:
        """Force of the pusher on the object in `table` [N], shape (2,)."""
        fx, fy = (float(value) for value in np.asarray(force, dtype=np.float64))
        parts = (self._new("geometry_msgs/msg/Vector3", *vector) for vector in ((fx, fy, 0.0), (0.0, 0.0, 0.0)))
        self._write(Role.WRENCH, stamp, self._header(stamp, TABLE_FRAME), self._new("geometry_msgs/msg/Wrench", *parts))

    def write_shape(self, object_id: str, shape: ObjectShape, stamp: float) -> None:
        """Cells and outline of an object, in its own frame, and how well the outline is known.

        Raises BagError for cells on no lattice.
        """
        header = self._header(stamp, object_frame(object_id))
        try:
            (x, y, yaw), occupied = occupancy(shape.cells)
        except InputError as error:
            raise BagError(str(error)) from None
        height, width = occupied.shape
        corner = self._pose(float(x), float(y), 0.0, float(yaw))
        info = self._new("nav_msgs/msg/MapMetaData", header.stamp, float(shape.cells.size), width, height, corner)
        self._write(Role.CELLS, stamp, header, info, np.where(occupied, 100, 0).astype(np.int8).ravel(), object_id=object_id)
        points = [self._new("geometry_msgs/msg/Point32", float(x), float(y), 0.0) for x, y in shape.outline]
        self._write(Role.OUTLINE, stamp, header, self._new("geometry_msgs/msg/Polygon", points), object_id=object_id)
        if shape.outline_std is not None:
            n = len(shape.outline_std)
            layout = self._new("std_msgs/msg/MultiArrayLayout", [self._new("std_msgs/msg/MultiArrayDimension", "edge", n, n)], 0)
            self._write(Role.OUTLINE_STD, stamp, layout, shape.outline_std.astype(np.float32), object_id=object_id)

    def write_depth(self, stamp: float, depth: NDArray[np.uint16] | NDArray[np.float32]) -> None:
        """Depth image, shape (height, width): uint16 in millimetres (0: no value) or float32 in metres (NaN: no value)."""
        pixel, encoding = (np.dtype("<u2"), "16UC1") if depth.dtype == np.uint16 else (np.dtype("<f4"), "32FC1")
        data = np.ascontiguousarray(depth, dtype=pixel)
        rows = (data.shape[0], data.shape[1], encoding, 0, data.shape[1] * pixel.itemsize, data.view(np.uint8).ravel())
        self._write(Role.DEPTH, stamp, self._header(stamp, CAMERA_FRAME), *rows)

    def write_camera_info(self, stamp: float, intrinsics: CameraIntrinsics) -> None:
        """Intrinsics of a rectified depth camera."""
        fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
        k = np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        p = np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])
        roi = self._new("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        camera = (intrinsics.height, intrinsics.width, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p)
        self._write(Role.CAMERA_INFO, stamp, self._header(stamp, CAMERA_FRAME), *camera, 0, 0, roi)

    def write_extrinsics(self, stamp: float, camera_in_table: ArrayLike) -> None:
        """Pose of the optical frame in `table`, homogeneous, shape (4, 4), as a static transform."""
        transform = np.asarray(camera_in_table, dtype=np.float64)
        turn = self._new("geometry_msgs/msg/Quaternion", *quaternion_of_pose(transform))
        shift = self._new("geometry_msgs/msg/Vector3", *(float(t) for t in transform[:3, 3]))
        body = self._new("geometry_msgs/msg/Transform", shift, turn)
        stamped = self._new("geometry_msgs/msg/TransformStamped", self._header(stamp, TABLE_FRAME), CAMERA_FRAME, body)
        self._write(Role.TF_STATIC, stamp, [stamped])

    def write_push_record(self, push_id: int, object_id: str, start: float, end: float, *, error_code: int = 0) -> None:
        """Record of a push from `start` to `end` [s]; fields of its plan are left empty."""
        times = (self._time(start), self._time(0.0), self._time(end), self._time(end))
        plan = (self._new("geometry_msgs/msg/Point", 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0)
        self._write(Role.PUSH_RECORD, end, self._header(end, TABLE_FRAME), push_id, object_id, error_code, "", *times, *plan)

    @property
    def _storage(self) -> Path:
        return self.path if self.path.suffix == ".mcap" else self.path / f"{self.path.name}.mcap"

    @property
    def _store(self) -> Any:
        return jazzy_typestore()

    def _new(self, msgtype: str, *fields: Any) -> Any:
        return self._store.types[msgtype](*fields)

    def _time(self, stamp: float) -> Any:
        return self._new("builtin_interfaces/msg/Time", *divmod(_nanoseconds(stamp), 10**9))

    def _header(self, stamp: float, frame_id: str) -> Any:
        return self._new("std_msgs/msg/Header", self._time(stamp), frame_id)

    def _pose(self, x: float, y: float, z: float, yaw: float) -> Any:
        quaternion = (float(q) for q in quaternion_of_yaw(yaw))
        point = self._new("geometry_msgs/msg/Point", x, y, z)
        return self._new("geometry_msgs/msg/Pose", point, self._new("geometry_msgs/msg/Quaternion", *quaternion))

    def _write(self, role: Role, stamp: float, *fields: Any, object_id: str = "") -> None:
        data = self._store.serialize_cdr(self._new(role.msgtype, *fields), role.msgtype)
        self.write_raw("/" + topic_of(role, object_id), role.msgtype, _nanoseconds(stamp), data)

    def _channel(self, topic: str, msgtype: str, definition: tuple[str, bytes] | None) -> int:
        key = (topic, msgtype)
        if key not in self._channels:
            if msgtype not in self._schemas:
                encoding, text = definition or ("ros2msg", definition_of(msgtype).encode())
                self._schemas[msgtype] = self._writer.register_schema(msgtype, encoding, text)
            metadata = {"offered_qos_profiles": "", "topic_type_hash": self._type_hash(msgtype)}
            self._channels[key] = self._writer.register_channel(topic, "cdr", self._schemas[msgtype], metadata)
            self._counts[self._channels[key]] = 0
        return self._channels[key]

    def _type_hash(self, msgtype: str) -> str:
        return str(self._store.hash_rihs01(msgtype)) if msgtype in self._store.fielddefs else ""

    def _metadata(self) -> str:
        """Content of the metadata.yaml that rosbag2 of Jazzy expects beside the storage file."""
        start = {"nanoseconds_since_epoch": self._first_ns or 0}
        duration = {"nanoseconds": self._last_ns - (self._first_ns or 0)}
        # Copies, since a dictionary that appears twice becomes an anchor and an alias in YAML.
        file = {"path": self._storage.name, "starting_time": dict(start), "duration": dict(duration), "message_count": self.message_count}
        topics = [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": msgtype,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [],
                    "type_description_hash": self._type_hash(msgtype),
                },
                "message_count": self._counts[channel],
            }
            for (topic, msgtype), channel in self._channels.items()
        ]
        information = {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [self._storage.name],
            "duration": duration,
            "starting_time": start,
            "message_count": self.message_count,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [file],
            "custom_data": None,
            "ros_distro": "jazzy",
        }
        return str(yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False))

    def _refused(self, error: OSError) -> BagError:
        return BagError(f"{self.path}: cannot be written ({error.strerror or error}); check the disk and the permissions of the folder.")


def _nanoseconds(stamp: float) -> int:
    if not (math.isfinite(stamp) and 0 <= stamp < 2**31):
        raise BagError(f"stamp is {stamp} s, expected 0 to 2^31 s.")
    return round(stamp * 1e9)
