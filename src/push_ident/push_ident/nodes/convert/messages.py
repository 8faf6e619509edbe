"""Between messages and the types of the package: pairs `x_to_msg`, `x_from_msg`.

Message fields are not type-checked at run time and a wrong type is silently corrupted, hence the casts.
"""

from __future__ import annotations

import importlib
import math
from array import array
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point32, PolygonStamped, Pose, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import ArrayLike, NDArray
from sensor_msgs.msg import CameraInfo, Image, JointState
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension, MultiArrayLayout

from push_ident.bags.decode import camera_accuracy_of, is_covariance, planar_covariance, pusher_shape_of
from push_ident.errors import FrameError, InputError
from push_ident.geometry.cut_cells import cut_at_outline, occupancy
from push_ident.geometry.frames import TABLE_FRAME, object_frame
from push_ident.geometry.outline import outline_of_cells
from push_ident.geometry.se2 import quaternion_of_yaw, transform_points, yaw_of_quaternion
from push_ident.geometry.se3 import pose_of_quaternion, quaternion_of_pose
from push_ident.geometry.shape_check import check_shape
from push_ident.geometry.workspace_grid import WorkspaceGrid
from push_ident.limits import LIMITS, check_coordinates, check_object_id, plain_text
from push_ident.perception.frame.camera_info import check_image_size, intrinsics_of
from push_ident.perception.frame.depth_image import depth_from_buffer, unit_of
from push_ident.pushing.cutter import PushInterval
from push_ident.pushing.state_intake import no_positions
from push_ident.types import CameraAccuracy, CameraIntrinsics, CellGrid, DepthFrame, Float64Array, ObjectShape, PusherShape
from push_ident_msgs.msg import PushRecord

_PLANAR: Final = (0, 1, 5)
"""Rows of x, y and yaw in a 6 x 6 covariance."""


@dataclass(frozen=True, slots=True)
class PlanarPoseLimits:
    """Of poses of objects that lie on a table, in messages of three dimensions."""

    fixed_variance: float = 1e-6
    """Of z [m^2], roll and pitch [rad^2] in what is published: small, never zero."""
    max_variance: float = 1e4
    """Largest one [m^2, rad^2] that is taken: a pose that is 100 m uncertain is none."""
    max_tilt: float = 0.1
    """Against the table, of a pose that still counts as planar [rad]."""


PLANAR_POSE: Final = PlanarPoseLimits()


def message_class(msgtype: str) -> Any | None:
    """Python class of `package/msg/Name`; None where the package is not installed."""
    package, _, name = msgtype.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None


def stamp_from_msg(stamp: Time) -> float:
    """[s]; exact to the nanosecond up to 4e6 s, to 0.24 us for times of day (what a float can hold).

    Raises InputError: A time before 1970, or a second of more than 10^9 nanoseconds.
    """
    if stamp.sec < 0 or stamp.nanosec >= 10**9:
        raise InputError(f"Stamp is {stamp.sec} s and {stamp.nanosec} ns, expected 0 to {LIMITS.STAMP.value} s and less than 10^9 ns.")
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def stamp_to_msg(seconds: float) -> Time:
    """Nearest nanosecond; times before 1970 are refused."""
    if not (math.isfinite(seconds) and 0 <= seconds < 2**31):
        raise InputError(f"Time stamp is {seconds} s, expected 0 to 2^31 s.")
    whole = math.floor(seconds)
    nanoseconds = round((seconds - whole) * 1e9)
    return Time(sec=int(whole + nanoseconds // 10**9), nanosec=int(nanoseconds % 10**9))


def planar_pose_to_msg(stamp: Time, pose: ArrayLike, covariance: ArrayLike, *, frame_id: str = TABLE_FRAME) -> PoseWithCovarianceStamped:
    """Pose (x, y, yaw) [m, m, rad] with its 3 x 3 covariance; z, roll and pitch get a small variance."""
    x, y, yaw = (float(value) for value in np.asarray(pose, dtype=np.float64))
    full = np.eye(6) * PLANAR_POSE.fixed_variance
    full[np.ix_(_PLANAR, _PLANAR)] = np.asarray(covariance, dtype=np.float64)
    msg = PoseWithCovarianceStamped(header=Header(stamp=stamp, frame_id=frame_id))
    msg.pose.pose.position.x, msg.pose.pose.position.y = x, y
    _set_yaw(msg.pose.pose.orientation, yaw)
    msg.pose.covariance = full.ravel()
    return msg


def planar_pose_from_msg(msg: PoseWithCovarianceStamped, *, frame_id: str = TABLE_FRAME) -> tuple[float, Float64Array, Float64Array]:
    """Stamp [s], pose (x, y, yaw) and its covariance, shape (3, 3), zero where it is unknown (`planar_covariance`).

    Raises InputError: another frame, values not finite, a pose tilted against the table, or a covariance that is none.
    """
    _check_frame(msg.header.frame_id, frame_id)
    position = msg.pose.pose.position
    pose = np.array([position.x, position.y, _yaw(msg.pose.pose.orientation)])
    covariance = planar_covariance(msg.pose.covariance)
    if not np.isfinite(pose).all():
        raise InputError("Object pose is not finite; the tracker that published it is at fault.")
    check_coordinates(pose[:2], "Object pose")
    _check_covariance(covariance)
    return stamp_from_msg(msg.header.stamp), pose, covariance


def planar_pose_of(pose: Pose) -> Float64Array:
    """Pose (x, y, yaw) [m, m, rad] of a pose in the plane. Raises InputError: it is tilted against the plane, or not finite."""
    check_coordinates([pose.position.x, pose.position.y], "Pose")
    return np.array([pose.position.x, pose.position.y, _yaw(pose.orientation)])


def transform_to_msg(stamp: Time, transform: ArrayLike, *, frame_id: str = TABLE_FRAME) -> PoseStamped:
    """A homogeneous transform, shape (4, 4), from the frame that it describes to `frame_id`."""
    matrix = np.asarray(transform, dtype=np.float64)
    msg = PoseStamped(header=Header(stamp=stamp, frame_id=frame_id))
    msg.pose.position.x, msg.pose.position.y, msg.pose.position.z = (float(value) for value in matrix[:3, 3])
    turn = msg.pose.orientation
    turn.x, turn.y, turn.z, turn.w = quaternion_of_pose(matrix)
    return msg


def transform_from_msg(msg: PoseStamped, *, frame_id: str = TABLE_FRAME) -> Float64Array:
    """Homogeneous transform, shape (4, 4). Raises InputError: another frame, values not finite, or no unit quaternion."""
    turn = msg.pose.orientation
    return pose_of_quaternion(position_from_msg(msg, frame_id=frame_id)[1], [turn.x, turn.y, turn.z, turn.w])


def position_to_msg(stamp: Time, position: ArrayLike, *, yaw: float = 0.0, frame_id: str = TABLE_FRAME) -> PoseStamped:
    """Pose of the tool tip (or another point) [m], shape (3,), turned about z by `yaw` [rad]."""
    msg = PoseStamped(header=Header(stamp=stamp, frame_id=frame_id))
    x, y, z = (float(value) for value in np.asarray(position, dtype=np.float64))
    msg.pose.position.x, msg.pose.position.y, msg.pose.position.z = x, y, z
    _set_yaw(msg.pose.orientation, yaw)
    return msg


def position_from_msg(msg: PoseStamped, *, frame_id: str = TABLE_FRAME) -> tuple[float, Float64Array]:
    """Stamp [s] and position [m], shape (3,). Raises InputError: another frame, or values not finite."""
    _check_frame(msg.header.frame_id, frame_id)
    position = np.array([msg.pose.position.x, msg.pose.position.y, msg.pose.position.z])
    if not np.isfinite(position).all():
        raise InputError(f"Position in {frame_id} is {position.tolist()}, expected finite metres.")
    check_coordinates(position, f"Position in {frame_id}")
    return stamp_from_msg(msg.header.stamp), position


def force_to_msg(stamp: Time, force: ArrayLike, *, frame_id: str = TABLE_FRAME) -> WrenchStamped:
    """Horizontal force of the pusher on the object [N], shape (2,)."""
    msg = WrenchStamped(header=Header(stamp=stamp, frame_id=frame_id))
    x, y = (float(value) for value in np.asarray(force, dtype=np.float64))
    msg.wrench.force.x, msg.wrench.force.y = x, y
    return msg


def force_from_msg(msg: WrenchStamped, *, frame_id: str = TABLE_FRAME) -> tuple[float, Float64Array]:
    """Stamp [s] and horizontal force [N], shape (2,). Raises InputError: another frame, or values not finite."""
    _check_frame(msg.header.frame_id, frame_id)
    force = np.array([msg.wrench.force.x, msg.wrench.force.y])
    if not np.isfinite(force).all():
        raise InputError("Force on the object is not finite; check the sensor.")
    LIMITS.FORCE.check(float(np.abs(force).max()), "Force on the object", remedy="Check the sensor.")
    return stamp_from_msg(msg.header.stamp), force


def pusher_shape_to_msg(shape: PusherShape, height: float) -> SolidPrimitive:
    """The pusher, upright and of a height [m]: a CYLINDER, of fingers with their axes as `polygon`, or a PRISM."""
    msg = SolidPrimitive(type=SolidPrimitive.CYLINDER if shape.polygon is None else SolidPrimitive.PRISM)
    msg.dimensions = [float(height), float(shape.radius)]
    if not shape.is_cylinder:
        msg.polygon.points = [Point32(x=float(x), y=float(y), z=0.0) for x, y in shape.core]
    return msg


def pusher_shape_from_msg(msg: SolidPrimitive) -> PusherShape:
    """Outline of the pusher, as bags have it (`decode.pusher_shape_of`). Raises InputError for what is none."""
    height = float(msg.dimensions[0]) if len(msg.dimensions) == 2 else math.nan
    if not (math.isfinite(height) and 0 <= height < 10):
        raise InputError(f"Pusher shape has {len(msg.dimensions)} dimensions and height {height}, expected two and 0 to 10 m.")
    if (shape := pusher_shape_of(msg)) is None:
        raise InputError(f"Pusher shape has type {msg.type}, expected a CYLINDER or a PRISM.")
    return shape


def camera_accuracy_to_msg(accuracy: CameraAccuracy, stamp: Time) -> PoseWithCovarianceStamped:
    """The table frame that the camera sees in the true one: the identity, with its covariance."""
    msg = PoseWithCovarianceStamped(header=Header(stamp=stamp, frame_id=TABLE_FRAME))
    msg.pose.pose.orientation.w = 1.0
    variance = np.array([accuracy.position**2, accuracy.position**2, 0.0, 0.0, 0.0, accuracy.heading**2])
    msg.pose.covariance = np.diag(variance).ravel()
    return msg


def camera_accuracy_from_msg(msg: PoseWithCovarianceStamped) -> CameraAccuracy:
    """As `camera_accuracy_to_msg`; the larger one of x and y counts for both.

    Raises InputError: another frame, or a covariance that is none.
    """
    _check_frame(msg.header.frame_id, TABLE_FRAME)
    accuracy = camera_accuracy_of(msg)
    if accuracy is None:
        raise InputError("Accuracy of the camera has variances that are negative, not finite or too large; expected those of x, y and yaw.")
    return accuracy


def outline_std_to_msg(shape: ObjectShape) -> Float32MultiArray:
    """Standard deviations of the edges of the outline [m]; empty for an outline that is exact."""
    values = [] if shape.outline_std is None else [float(value) for value in shape.outline_std]
    edges = MultiArrayDimension(label="edge", size=len(values), stride=len(values))
    return Float32MultiArray(layout=MultiArrayLayout(dim=[edges]), data=values)


def shape_to_msgs(shape: ObjectShape, object_id: str, stamp: Time) -> tuple[OccupancyGrid, PolygonStamped]:
    """Cells (100 = cell, 0 = none) and outline, both in the object frame."""
    corner, occupied = occupancy(shape.cells)
    cells = occupancy_to_msg(100 * occupied.astype(np.int8), shape.cells.size, corner[:2], stamp, frame_id=object_frame(object_id))
    cells.info.origin.orientation.z, cells.info.origin.orientation.w = (float(q) for q in quaternion_of_yaw(corner[2])[2:])
    outline = PolygonStamped()
    outline.header = cells.header
    outline.polygon.points = [Point32(x=float(x), y=float(y), z=0.0) for x, y in shape.outline]
    return cells, outline


def shape_from_msgs(
    cells: OccupancyGrid, outline: PolygonStamped | None = None, outline_std: Float32MultiArray | None = None
) -> ObjectShape:
    """Shape of an object; without an outline it is traced from the cells. Cells run row by row: x fastest, then y.

    Deviations that are not as many as the outline has edges belong to another outline and are left out.

    Raises InputError: no cells, too many, sizes that do not fit, an outline that cannot be one, or cells and outline of different objects.
    """
    # The resolution is a float32: its shortest decimal is the number that was meant.
    size, width, height = float(str(np.float32(cells.info.resolution))), int(cells.info.width), int(cells.info.height)
    name = f"Cells of {plain_text(cells.header.frame_id)!r}"
    LIMITS.GRID.check(width * height, name)
    if len(cells.data) != width * height:
        raise InputError(f"{name} have {len(cells.data)} entries, expected {width} * {height}.")
    if not (math.isfinite(size) and size > 0):
        raise InputError(f"{name} have resolution {size}, expected a positive length in metres.")
    rows, columns = np.nonzero(np.asarray(cells.data, dtype=np.int8).reshape(height, width) == 100)
    if len(rows) == 0:
        raise InputError(f"{name} hold no cell of value 100.")
    LIMITS.CELLS.check(len(rows), name, remedy="Take larger cells.")
    origin = cells.info.origin
    yaw = _yaw(origin.orientation)
    centres = transform_points([origin.position.x, origin.position.y, yaw], (np.stack([columns, rows], axis=1) + 0.5) * size)
    check_coordinates(centres, name)
    if outline is None:
        return check_shape(ObjectShape(CellGrid(centres, size), outline_of_cells(centres, size, yaw=yaw)))
    _check_frame(outline.header.frame_id, cells.header.frame_id)
    vertices = outline_from_msg(outline)
    std = None if outline_std is None else outline_std_from_msg(outline_std)
    std = std if std is not None and len(std) == len(vertices) else None
    return cut_at_outline(check_shape(ObjectShape(CellGrid(centres, size), vertices, std)))


def outline_from_msg(outline: PolygonStamped) -> Float64Array:
    """Vertices of an outline [m], shape (n_vertices, 2), in its frame.

    Raises InputError: fewer than 3 vertices, too many, or not finite.
    """
    name = f"Outline of {plain_text(outline.header.frame_id)!r}"
    LIMITS.VERTICES.check(len(outline.polygon.points), name)
    points = np.array([(point.x, point.y) for point in outline.polygon.points], dtype=np.float64).reshape(-1, 2)
    if len(points) < 3:
        raise InputError(f"{name} has {len(points)} points, expected at least 3.")
    check_coordinates(points, name)
    return points


def outline_std_from_msg(msg: Float32MultiArray) -> Float64Array:
    """Standard deviations of the edges of an outline [m], shape (n_edges,). Raises InputError: too many, or not all of them lengths."""
    LIMITS.VERTICES.check(len(msg.data), "Deviations of an outline")
    values = np.array(msg.data, dtype=np.float64)
    check_coordinates(values, "Deviations of an outline")
    if not np.all(values > 0):
        raise InputError(f"A deviation of an outline is {values.min()} m, expected more than 0; an outline that is exact has none.")
    return values


def joints_from_msg(msg: JointState) -> tuple[float, dict[str, float]]:
    """Stamp [s] and position of each joint [rad] by name.

    Raises InputError: not one finite position a name, a name twice, or too many joints.
    """
    LIMITS.JOINTS.check(max(len(msg.name), len(msg.position)), "Joint states")
    position = dict(zip(msg.name, (float(value) for value in msg.position), strict=False))
    names = plain_text(", ".join(msg.name)) or "none"
    if len(msg.position) != len(msg.name) or len(position) != len(msg.name):
        raise InputError(f"Joint states have {len(msg.position)} positions for joints {names}; expected one each, each name once.")
    if missing := [name for name, value in position.items() if not math.isfinite(value)]:
        raise InputError(f"Joint states: {no_positions(missing)}.")
    return stamp_from_msg(msg.header.stamp), position


def push_interval_from_msg(msg: PushRecord) -> PushInterval:
    """When a push took place, and how it ended. Raises InputError: stamps or an object id that cannot be; a push that takes too long."""
    start, end = stamp_from_msg(msg.start), stamp_from_msg(msg.end)
    LIMITS.PUSH_SECONDS.check(end - start, "Push record")
    return PushInterval(int(msg.push_id), check_object_id(msg.object_id) if msg.object_id else "", start, end, int(msg.error_code))


def occupancy_to_msg(
    data: NDArray[np.int8], resolution: float, origin: ArrayLike, stamp: Time, *, frame_id: str = TABLE_FRAME
) -> OccupancyGrid:
    """Grid of -1 (unknown), 0 (free) to 100 (occupied), shape (rows along y, columns along x); `origin` is its low corner [m]."""
    msg = OccupancyGrid(header=Header(stamp=stamp, frame_id=frame_id))
    msg.info.map_load_time = stamp
    msg.info.resolution = float(resolution)
    msg.info.height, msg.info.width = (int(n) for n in data.shape)
    x, y = (float(value) for value in np.asarray(origin, dtype=np.float64))
    msg.info.origin.position.x, msg.info.origin.position.y = x, y
    msg.info.origin.orientation.w = 1.0
    msg.data = array("b", np.ascontiguousarray(data, dtype=np.int8).tobytes())
    return msg


def workspace_from_msg(msg: OccupancyGrid) -> WorkspaceGrid:
    """Occupancy of the workspace. Raises InputError: another frame, a size that does not fit the data, a resolution or a place that cannot
    be."""
    _check_frame(msg.header.frame_id, TABLE_FRAME)
    height, width = int(msg.info.height), int(msg.info.width)
    LIMITS.GRID.check(height * width, "Occupancy of the workspace")
    if height * width != len(msg.data) or not msg.data:
        raise InputError(f"The occupancy of the workspace has {len(msg.data)} values, expected width * height = {width} * {height}, not 0.")
    size, pose = float(msg.info.resolution), planar_pose_of(msg.info.origin)
    if not (np.isfinite(size) and size > 0.0 and np.isfinite(pose).all()):
        raise InputError(
            f"The occupancy of the workspace has cells of {size} m at {pose.tolist()}, expected a positive size, finite place."
        )
    corner = transform_points(pose, size * np.array([[0.0, 0.0], [width, height]]))
    check_coordinates(corner, "The occupancy of the workspace")
    return WorkspaceGrid(np.array(msg.data, dtype=np.int8).reshape(height, width), pose, size)


def intrinsics_from_msg(info: CameraInfo) -> CameraIntrinsics:
    """Of a rectified image, binning and region of interest applied; as `CameraInfoFields.intrinsics`."""
    return intrinsics_of(info)


def depth_frame_from_msgs(image: Image, info: CameraInfo) -> DepthFrame:
    """One depth frame in metres.

    Args:
        image: `16UC1` or `32FC1`.
        info: Its camera, whatever its stamp: that they belong together is for `nodes/input/depth_pairs.py` to know.

    Raises FrameError: Image and info do not belong together, or one is refused for itself.
    """
    if image.header.frame_id != info.header.frame_id:
        frames = [plain_text(msg.header.frame_id) for msg in (image, info)]
        raise FrameError(f"Depth image is in frame {frames[0]!r}, its camera info in {frames[1]!r}; expected the same.")
    intrinsics = intrinsics_from_msg(info)
    check_image_size(int(image.width), int(image.height), intrinsics)
    stamp = stamp_from_msg(image.header.stamp)
    depth = depth_from_buffer(image.encoding, image.height, image.width, image.step, bool(image.is_bigendian), memoryview(image.data))
    return DepthFrame(stamp, depth, intrinsics, image.header.frame_id, unit_of(image.encoding))


def depth_frame_to_msgs(frame: DepthFrame, stamp: Time, *, encoding: str = "16UC1") -> tuple[Image, CameraInfo]:
    """Image and camera info of one depth frame; `16UC1` rounds to millimetres and writes 0 where nothing was measured."""
    if encoding == "16UC1":
        pixels: NDArray[Any] = np.nan_to_num(np.rint(frame.depth * 1e3), nan=0.0).clip(0, 65535).astype("<u2")
    elif encoding == "32FC1":
        pixels = frame.depth.astype("<f4")
    else:
        raise InputError(f"Depth encoding is {encoding!r}, expected 16UC1 or 32FC1.")
    height, width = pixels.shape
    image = Image(
        encoding=encoding,
        height=int(height),
        width=int(width),
        step=int(width * pixels.itemsize),
        is_bigendian=0,
        header=Header(stamp=stamp, frame_id=frame.frame_id),
    )
    image.data = array("B", pixels.tobytes())
    camera = frame.intrinsics
    info = CameraInfo(height=int(camera.height), width=int(camera.width), distortion_model="plumb_bob", d=[0.0] * 5)
    info.header = image.header
    fx, fy, cx, cy = float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)
    info.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    info.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return image, info


def _check_covariance(covariance: Float64Array) -> None:
    if not np.isfinite(covariance).all():
        raise InputError("Covariance of an object pose is not finite; the tracker that published it is at fault.")
    largest = float(np.abs(covariance).max())
    if largest > PLANAR_POSE.max_variance or np.abs(covariance - covariance.T).max() > 1e-6 * largest:
        raise InputError(f"Covariance of an object pose is not symmetric, or has entries over {PLANAR_POSE.max_variance:.0f} m^2 or rad^2.")
    if not is_covariance(0.5 * (covariance + covariance.T)):
        raise InputError("Covariance of an object pose must be positive definite in (x, y, yaw), or zero where it is unknown.")


def _check_frame(got: str, expected: str) -> None:
    if got != expected:
        raise InputError(
            f"Message is in frame {plain_text(got)!r}, expected {plain_text(expected)!r}; transform it first or remap the topic."
        )


def _set_yaw(orientation: Any, yaw: float) -> None:
    orientation.x, orientation.y, orientation.z, orientation.w = (float(value) for value in quaternion_of_yaw(yaw))


def _yaw(orientation: Any) -> float:
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    with np.errstate(over="ignore"):
        norm = float(np.linalg.norm(quaternion))
    if not (math.isfinite(norm) and abs(norm - 1) < 1e-3):
        raise InputError(f"Orientation {quaternion.tolist()} has norm {norm:.3g}, expected a unit quaternion (x, y, z, w).")
    x, y = quaternion[:2] / norm
    if 2 * math.hypot(x, y) > PLANAR_POSE.max_tilt:
        raise InputError(
            f"Pose is tilted by {2 * math.asin(min(1.0, math.hypot(x, y))):.2f} rad against the table, expected a planar pose."
        )
    return float(yaw_of_quaternion(quaternion))
