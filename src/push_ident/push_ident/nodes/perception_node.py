"""Perception as a node: depth frames in, shapes, poses and the workspace occupancy out."""

from __future__ import annotations

import sys
from collections import Counter, deque
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from shape_msgs.msg import SolidPrimitive

from push_ident.errors import FrameError, InputError, PerceptionError
from push_ident.nodes.convert import (
    TABLE_FRAME,
    cylinder_radius_from_msg,
    depth_frame_from_msgs,
    occupancy_to_msg,
    planar_pose_to_msg,
    position_from_msg,
    shape_to_msgs,
    stamp_from_msg,
)
from push_ident.nodes.parameters import Parameter, Parameters
from push_ident.nodes.run import run_node
from push_ident.perception.labels import Cylinder
from push_ident.perception.pipeline import Observation, Perception
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import Float64Array

__all__ = ["PARAMETERS", "PerceptionNode", "camera_pose", "main"]

_DEFAULTS: Final = PerceptionSettings()

_SETTINGS: Final = (
    Parameter("workspace_low", list(_DEFAULTS.workspace_low), "smallest x and y looked at [m]", -5.0, 5.0),
    Parameter("workspace_high", list(_DEFAULTS.workspace_high), "largest x and y looked at [m]", -5.0, 5.0),
    Parameter("min_object_height", _DEFAULTS.min_object_height, "lower things are table [m]", 0.002, 0.5),
    Parameter("max_object_height", _DEFAULTS.max_object_height, "higher things are robot [m]", 0.01, 1.0),
    Parameter("min_object_area", _DEFAULTS.min_object_area, "smaller things are ignored [m^2]", 1e-5, 1.0),
    Parameter("mask_margin", _DEFAULTS.mask_margin, "added to the radius of the tool when it is masked [m]", 0.0, 0.1),
    Parameter("rest_frames", _DEFAULTS.rest_frames, "frames at rest before an object is taken in", 1, 300),
    Parameter("rest_distance", _DEFAULTS.rest_distance, "an object that moves less between frames is at rest [m]", 1e-4, 0.05),
    Parameter("cell_count", _DEFAULTS.cell_count, "cells aimed at per object", 1, 2000),
    Parameter("grid_resolution", _DEFAULTS.grid_resolution, "edge of a cell of the workspace occupancy [m]", 5e-4, 0.1),
    Parameter("occupancy_period", _DEFAULTS.occupancy_period, "between two workspace occupancies [s]", 0.05, 60.0),
    Parameter("search_period", _DEFAULTS.search_period, "between two searches for new or lost objects once one is known [s]", 0.0, 60.0),
)

_DEFAULT_OF: Final = {row.name: row.default for row in _SETTINGS}

PARAMETERS: Final = (
    *_SETTINGS,
    Parameter("extrinsics", "parameters", "where the camera pose comes from", choices=("parameters", "tf"), read_only=True),
    Parameter("camera_position", [0.55, 0.0, 0.85], "optical frame in the table frame, x y z [m]", -10.0, 10.0, read_only=True),
    Parameter(
        "camera_quaternion",
        [0.67815377, 0.67815377, -0.20026847, -0.20026847],
        "orientation of the optical frame in the table frame, x y z w",
        -1.0,
        1.0,
        read_only=True,
    ),
    Parameter("tool_radius", 0.02, "radius of the tool that is masked until pusher/shape says otherwise [m]", 0.0, 0.3),
    Parameter("tool_length", 0.08, "from the tip of the tool to the hand that holds it, until pusher/shape says otherwise [m]", 0.0, 1.0),
    Parameter("hand_radius", 0.09, "radius of the hand above the tool that is masked [m]", 0.0, 0.5),
    Parameter("max_skew", 0.05, "a depth image and a camera info further apart do not belong together [s]", 0.0, 10.0),
)

_LATCHED: Final = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_TOOL_MEMORY: Final = 200
"""Tool poses kept to look up where the tool was when an image was taken."""
_TOOL_OLD: Final = 0.5
"""A tool pose that much older than the image is reported [s]."""
_SILENT: Final = 2.0
"""Without a depth image for so long the node reports it [s], receive time."""


def camera_pose(position: list[float], quaternion: list[float]) -> Float64Array:
    """Homogeneous transform, shape (4, 4), of a position [m] and a unit quaternion (x, y, z, w).

    Raises:
        InputError: The quaternion is not a unit one.
    """
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 1e-3:
        raise InputError(f"camera_quaternion {quaternion} has norm {norm:.4f}, expected a unit quaternion (x, y, z, w).")
    x, y, z, w = np.asarray(quaternion, dtype=np.float64) / norm
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = position
    return pose


def _settings(values: dict[str, Any]) -> PerceptionSettings:
    names = [row.name for row in _SETTINGS]
    chosen: dict[str, Any] = {name: tuple(values[name]) if isinstance(_DEFAULT_OF[name], list) else values[name] for name in names}
    return PerceptionSettings(**chosen)


class PerceptionNode(Node):
    """Converts, calls `Perception`, publishes; what goes wrong is counted and told in /diagnostics."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("perception_node", **kwargs)
        self._configured = Parameters(self, PARAMETERS, check=_settings, on_change=self._on_parameters)
        self._perception: Perception | None = None
        self._tf = _TfExtrinsics(self) if self._configured["extrinsics"] == "tf" else None
        if self._tf is None:
            extrinsics = camera_pose(self._configured["camera_position"], self._configured["camera_quaternion"])
            self._perception = Perception(extrinsics, _settings(self._configured.as_dict()))
        self._tool_radius, self._tool_length = float(self._configured["tool_radius"]), float(self._configured["tool_length"])
        self._tool: deque[tuple[float, Float64Array]] = deque(maxlen=_TOOL_MEMORY)
        self._infos: deque[CameraInfo] = deque(maxlen=10)
        self._unpaired: Image | None = None
        self._counter: Counter[str] = Counter()
        self._last_error = ""
        self._last_seen: Observation | None = None
        self._notes: dict[str, str] = {}
        self._wall = Clock(clock_type=ClockType.STEADY_TIME)
        self._last_image_at = self._diagnosed_at = self._wall.now()
        self._frames_diagnosed = 0

        self._object_publishers: dict[str, tuple[Publisher, Publisher, Publisher]] = {}
        self._occupancy_publisher = self.create_publisher(OccupancyGrid, "workspace/occupancy", _LATCHED)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_subscription(CameraInfo, "depth/camera_info", self._on_info, qos_profile_sensor_data)
        self.create_subscription(Image, "depth/image_rect", self._on_image, qos_profile_sensor_data)
        self.create_subscription(PoseStamped, "tool/pose", self._on_tool, qos_profile_sensor_data)
        self.create_subscription(SolidPrimitive, "pusher/shape", self._on_tool_shape, _LATCHED)
        self.create_timer(1.0, self._diagnose, clock=self._wall)

    def _on_parameters(self, changed: dict[str, Any]) -> None:
        if self._perception is not None:
            self._perception.settings = _settings(self._configured.as_dict())
        self._tool_radius = float(changed.get("tool_radius", self._tool_radius))
        self._tool_length = float(changed.get("tool_length", self._tool_length))

    def _on_tool(self, msg: PoseStamped) -> None:
        try:
            sample = position_from_msg(msg)
        except InputError as error:
            self._refuse("tool_pose_refused", f"tool/pose: {error}")
            return
        if self._tool and sample[0] < self._tool[-1][0]:
            self._tool.clear()
        self._tool.append(sample)

    def _on_tool_shape(self, msg: SolidPrimitive) -> None:
        try:
            self._tool_radius = cylinder_radius_from_msg(msg)
            self._tool_length = float(msg.dimensions[SolidPrimitive.CYLINDER_HEIGHT])
        except InputError as error:
            self._refuse("tool_shape_refused", f"pusher/shape: {error}")

    def _on_info(self, info: CameraInfo) -> None:
        self._infos.append(info)
        if self._unpaired is not None and self._skew(self._unpaired, info) <= self._configured["max_skew"]:
            image, self._unpaired = self._unpaired, None
            self._on_pair(image, info)

    def _on_image(self, image: Image) -> None:
        self._last_image_at = self._wall.now()
        self._counter["images"] += 1
        if self._unpaired is not None:
            self._drop_unpaired(self._unpaired)
        self._unpaired = None
        # The info may arrive after its image; an info without a stamp is of a camera that never changes.
        nearest = min(self._infos, key=lambda info: self._skew(image, info), default=None)
        if nearest is not None and self._skew(image, nearest) <= self._configured["max_skew"]:
            self._on_pair(image, nearest)
        else:
            self._unpaired = image

    def _drop_unpaired(self, image: Image) -> None:
        if not self._infos:
            self._refuse(
                "dropped_without_info", f"no camera info on {self.resolve_topic_name('depth/camera_info')} yet; start the camera driver"
            )
            return
        skew = min(self._skew(image, info) for info in self._infos)
        limit = self._configured["max_skew"]
        self._refuse(
            "dropped_skew", f"depth image and nearest camera info are {skew * 1e3:.0f} ms apart, expected at most {limit * 1e3:.0f} ms"
        )

    @staticmethod
    def _skew(image: Image, info: CameraInfo) -> float:
        at = stamp_from_msg(info.header.stamp)
        return abs(stamp_from_msg(image.header.stamp) - at) if at else 0.0

    def _on_pair(self, image: Image, info: CameraInfo) -> None:
        try:
            frame = depth_frame_from_msgs(image, info, max_skew=None)
            if self._perception is None and not self._ask_tf(frame.frame_id):
                return
            assert self._perception is not None
            seen = self._perception.observe(frame, self._robot_at(frame.stamp))
        except FrameError as error:
            self._refuse("frames_refused", str(error))
            return
        except PerceptionError as error:
            self._refuse("frames_without_result", str(error))
            return
        self._counter["frames"] += 1
        self._publish(seen, image)

    def _ask_tf(self, camera_frame: str) -> bool:
        assert self._tf is not None
        pose, why = self._tf.camera_in_table(camera_frame)
        if pose is None:
            self._refuse("without_extrinsics", why)
            return False
        self._perception = Perception(pose, _settings(self._configured.as_dict()))
        return True

    def _robot_at(self, stamp: float) -> tuple[Cylinder, ...]:
        """Tool and hand where they were at `stamp`, between the poses before and after."""
        if not self._tool:
            self._notes["tool"] = f"nothing on {self.resolve_topic_name('tool/pose')}: the tool is not masked"
            return ()
        times = np.array([time for time, _ in self._tool])
        positions = np.array([position for _, position in self._tool])
        x, y, z = (float(np.interp(stamp, times, positions[:, axis])) for axis in range(3))
        late = stamp - times[-1]
        self._notes["tool"] = f"tool pose is {late:.2f} s older than the image" if late > _TOOL_OLD else ""
        return Cylinder(x, y, self._tool_radius, z), Cylinder(x, y, self._configured["hand_radius"], z + self._tool_length)

    def _publish(self, seen: Observation, image: Image) -> None:
        stamp = image.header.stamp
        if seen.restarted:
            self._counter["restarts"] += 1
            self.get_logger().warning(f"Time went back to {seen.stamp:.3f} s; all objects are looked for anew.")
            self._forget_objects()
        for object_id, shape in seen.new_shapes.items():
            self.get_logger().info(f"Object {object_id}: {len(shape.cells)} cells of {shape.cells.size * 1e3:.1f} mm.")
            _, cells_publisher, outline_publisher = self._publishers_of(object_id)
            cells, outline = shape_to_msgs(shape, object_id, stamp)
            cells_publisher.publish(cells)
            outline_publisher.publish(outline)
        for known in seen.objects:
            if known.pose is not None and known.covariance is not None:
                self._publishers_of(known.object_id)[0].publish(planar_pose_to_msg(stamp, known.pose, known.covariance))
                self._counter["poses"] += 1
        if seen.occupancy is not None:
            grid = seen.occupancy
            self._occupancy_publisher.publish(occupancy_to_msg(grid.occupancy, grid.resolution, grid.origin, stamp))
        self._last_seen = seen

    def _publishers_of(self, object_id: str) -> tuple[Publisher, Publisher, Publisher]:
        if object_id not in self._object_publishers:
            self._object_publishers[object_id] = (
                self.create_publisher(PoseWithCovarianceStamped, f"objects/{object_id}/pose", 10),
                self.create_publisher(OccupancyGrid, f"objects/{object_id}/cells", _LATCHED),
                self.create_publisher(PolygonStamped, f"objects/{object_id}/outline", _LATCHED),
            )
        return self._object_publishers[object_id]

    def _forget_objects(self) -> None:
        for publishers in self._object_publishers.values():
            for publisher in publishers:
                self.destroy_publisher(publisher)
        self._object_publishers.clear()

    def _refuse(self, kind: str, why: str) -> None:
        self._counter[kind] += 1
        self._last_error = why
        self.get_logger().warning(why, throttle_duration_sec=5.0)

    def _diagnose(self) -> None:
        now = self._wall.now()
        elapsed = (now - self._diagnosed_at).nanoseconds * 1e-9
        rate = (self._counter["frames"] - self._frames_diagnosed) / max(elapsed, 1e-3)
        silent = (now - self._last_image_at).nanoseconds * 1e-9 > _SILENT
        why = self._why_nothing(silent, rate)
        values: dict[str, Any] = {"rate_hz": f"{rate:.1f}", **self._counter, "last_error": self._last_error, "why_nothing": why}
        if self._last_seen is not None:
            values |= {f"stage_{name}": count for name, count in self._last_seen.counts.items()}
            values |= {f"object_{known.object_id}": known.status.value for known in self._last_seen.objects}
        values |= {f"note_{name}": note for name, note in self._notes.items() if note}
        status = DiagnosticStatus(name=f"{self.get_name()}: perception", hardware_id=TABLE_FRAME, message=why or "poses are published")
        status.level = DiagnosticStatus.ERROR if silent or rate == 0 else DiagnosticStatus.WARN if why else DiagnosticStatus.OK
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        msg = DiagnosticArray(status=[status])
        msg.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(msg)
        self._diagnosed_at, self._frames_diagnosed = now, self._counter["frames"]

    def _why_nothing(self, silent: bool, rate: float) -> str:
        if silent:
            topic = self.resolve_topic_name("depth/image_rect")
            return f"no depth image on {topic} ({self.count_publishers(topic)} publishers) for over {_SILENT:.0f} s"
        if rate == 0 or self._last_seen is None:
            return self._last_error or "no depth frame has been taken in yet"
        return self._last_seen.why_nothing()


class _TfExtrinsics:
    """Camera pose from tf2, where it is installed."""

    def __init__(self, node: Node) -> None:
        try:
            import tf2_ros  # Not among the Python wheels of ROS: optional.
        except ImportError:
            raise InputError(
                "Parameter extrinsics is tf, but tf2_ros is not installed; give camera_position and camera_quaternion."
            ) from None
        self._error = tf2_ros.TransformException
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def camera_in_table(self, camera_frame: str) -> tuple[Float64Array | None, str]:
        """Homogeneous transform, shape (4, 4), or None and why; never waits, the next frame asks again."""
        from rclpy.time import Time

        try:
            found = self._buffer.lookup_transform(TABLE_FRAME, camera_frame, Time()).transform
        except self._error as error:
            return None, f"no transform from {camera_frame} to {TABLE_FRAME}: {error}"
        at, turn = found.translation, found.rotation
        return camera_pose([at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w]), ""


def main(args: list[str] | None = None) -> int:
    """Entry point of the executable."""
    return run_node(PerceptionNode, args=args)


if __name__ == "__main__":
    sys.exit(main())
