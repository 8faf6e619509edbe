"""Fields of recorded messages as arrays. The class of a message comes from the schema in the bag."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import BagError, ContentError, InputError
from push_ident.geometry.outline import polygon_area
from push_ident.geometry.se2 import transform_points, yaw_of_quaternion
from push_ident.geometry.shape_check import check_pusher_radius
from push_ident.limits import LIMITS, check_coordinates
from push_ident.perception.frame.camera_info import check_image_size
from push_ident.perception.frame.depth_image import depth_from_buffer, unit_of
from push_ident.types import CameraAccuracy, CameraIntrinsics, CellGrid, DepthFrame, Float64Array, PusherShape

_PLANAR: Final = (0, 1, 5)
"""Rows of x, y and yaw in a 6 x 6 covariance."""


def stamp_ns(stamp: Any) -> int:
    """A builtin_interfaces/Time in nanoseconds."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def planar_pose_of(pose: Any) -> Float64Array:
    """(x, y, yaw) of a geometry_msgs/Pose; NaN where the quaternion is zero or not finite."""
    turn = pose.orientation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    norm = float(quaternion @ quaternion)
    yaw = float(yaw_of_quaternion(quaternion)) if np.isfinite(norm) and norm > 1e-6 else np.nan
    return np.array([pose.position.x, pose.position.y, yaw])


def planar_covariance(covariance: Any) -> Float64Array:
    """Covariance of (x, y, yaw) from the 36 numbers of a PoseWithCovariance, shape (3, 3), zero where nothing is stated.

    A variance of zero states nothing, nor does -1 in the first place, as in sensor_msgs/Imu. Of x and y both are stated or none.
    """
    full = np.asarray(covariance, dtype=np.float64).reshape(6, 6)
    planar = full[np.ix_(_PLANAR, _PLANAR)]
    unknown = (planar.diagonal() == 0) | (full[0, 0] == -1)
    unknown[:2] = unknown[:2].any()
    planar[unknown, :] = planar[:, unknown] = 0.0
    return planar


def is_covariance(planar: Float64Array) -> bool:
    """Whether what a covariance of `planar_covariance`, finite and symmetric, states is positive definite."""
    stated = planar.diagonal() != 0
    return not stated.any() or bool(np.linalg.eigvalsh(planar[np.ix_(stated, stated)])[0] > 0)


def covariance_of(covariance: Any) -> Float64Array:
    """As `planar_covariance`; all zero where it is none. NaN where it is larger than `LIMITS.COORDINATE`: such a pose says nothing."""
    planar = planar_covariance(covariance)
    planar = 0.5 * (planar + planar.T)
    if not (np.isfinite(planar).all() and is_covariance(planar)):
        return np.zeros((3, 3))
    return planar if planar.trace() < LIMITS.COORDINATE.value**2 else np.full((3, 3), np.nan)


def cells_of(grid: Any, occupied: int = 50) -> tuple[CellGrid, float]:
    """Cells of a nav_msgs/OccupancyGrid, and the yaw of its lattice in the object frame [rad].

    `occupied`: least occupancy of a cell that belongs to the object [percent]; the contract writes 100.

    Raises BagError for a grid without cells, or whose sizes do not fit its data.
    """
    info = grid.info
    LIMITS.GRID.check(int(info.width) * int(info.height), "occupancy grid", error=BagError)
    data = np.asarray(grid.data, dtype=np.int8)
    if info.width * info.height != len(data):
        raise BagError(f"occupancy grid has {len(data)} values, expected width * height = {info.width} * {info.height}.")
    # The resolution is a float32: its shortest decimal is the intended number.
    size = float(str(np.float32(info.resolution)))
    origin = planar_pose_of(info.origin)
    if not (np.isfinite(size) and size > 0 and np.isfinite(origin).all()):
        raise BagError(f"occupancy grid has resolution {size} m and origin {origin}, expected a positive length and a finite pose.")
    rows, columns = np.nonzero(data.reshape(info.height, info.width) >= occupied)
    LIMITS.CELLS.check(len(rows), "occupancy grid", error=BagError, remedy="Record coarser cells.")
    if len(rows) == 0:
        raise BagError(f"occupancy grid of {info.width} x {info.height} has no cell of at least {occupied}; the object's cells are 100.")
    centres = transform_points(origin, np.column_stack([columns + 0.5, rows + 0.5]) * size)
    check_coordinates(centres, "occupancy grid", error=BagError)
    return CellGrid(centres, size), float(origin[2])


def camera_accuracy_of(message: Any) -> CameraAccuracy | None:
    """Of a geometry_msgs/PoseWithCovarianceStamped: its covariance is that of the table frame that the camera sees; None where it is none.

    The larger one of x and y counts for both.
    """
    x, y, yaw = np.diag(np.asarray(message.pose.covariance, dtype=np.float64).reshape(6, 6))[list(_PLANAR)]
    most = LIMITS.COORDINATE.value**2
    if not all(0 <= variance < most for variance in (x, y, yaw)):
        return None
    return CameraAccuracy(float(np.sqrt(max(x, y))), float(np.sqrt(yaw)))


def outline_std_of(message: Any, n_edges: int) -> Float64Array | None:
    """Standard deviations of the edges of an outline [m], shape (n_edges,); None where they are not those of so many edges."""
    values = np.array(message.data, dtype=np.float64)
    return values if len(values) == n_edges and np.all((values > 0) & (values < LIMITS.COORDINATE.value)) else None


def outline_of(polygon: Any) -> Float64Array | None:
    """Vertices of a geometry_msgs/Polygon [m], shape (n_vertices, 2); None where it encloses nothing.

    Raises BagError for too many vertices, or coordinates that no object has.
    """
    LIMITS.VERTICES.check(len(polygon.points), "outline", error=BagError)
    vertices = np.array([[point.x, point.y] for point in polygon.points], dtype=np.float64).reshape(-1, 2)
    if len(vertices) > 1 and np.array_equal(vertices[0], vertices[-1]):
        vertices = vertices[:-1]
    if not np.isfinite(vertices).all():
        return None
    check_coordinates(vertices, "outline", error=BagError)
    if len(vertices) < 3 or abs(polygon_area(vertices)) < 1e-9:
        return None
    return vertices


def pusher_shape_of(primitive: Any) -> PusherShape | None:
    """Outline of the pusher in a shape_msgs/SolidPrimitive; None unless it is a cylinder or a prism.

    A cylinder whose `polygon` has two points stands for two fingers of its radius at these points of the tool's frame; the second dimension
    of a prism, where it has one, rounds its corners, and of two points makes it a plate with round ends.

    Raises InputError for a shape that no pusher has.
    """
    # SolidPrimitive.CYLINDER and PRISM; the class comes from the schema in the bag.
    cylinder, prism = 3, 5
    dimensions, points = primitive.dimensions, list(getattr(getattr(primitive, "polygon", None), "points", ()))
    LIMITS.VERTICES.check(len(points), "pusher")
    corners = np.array([[point.x, point.y] for point in points], dtype=np.float64).reshape(-1, 2)
    if np.any(~(np.abs(corners) <= LIMITS.PUSHER_RADIUS.value)):
        raise InputError(f"The pusher has points beyond {LIMITS.PUSHER_RADIUS.value} m of its origin; give them in metres.")
    if primitive.type == cylinder and len(dimensions) > 1:
        return PusherShape(check_pusher_radius(float(dimensions[1])), fingers=corners if len(corners) else None)
    if primitive.type == prism and len(dimensions) > 0:
        radius = check_pusher_radius(float(dimensions[1])) if len(dimensions) > 1 else 0.0
        return PusherShape(radius, polygon=corners)
    return None


def homogeneous_of(transform: Any) -> Float64Array:
    """Homogeneous matrix, shape (4, 4), of a geometry_msgs/Transform. Raises ContentError where it is no rigid motion."""
    from scipy.spatial.transform import Rotation

    turn, shift = transform.rotation, transform.translation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    matrix = np.eye(4)
    matrix[:3, 3] = (shift.x, shift.y, shift.z)
    if not (np.isfinite(matrix).all() and np.isfinite(quaternion).all() and np.linalg.norm(quaternion) > 1e-3):
        raise ContentError(f"static transform has quaternion {quaternion} and translation {matrix[:3, 3]}, expected a finite rigid motion.")
    check_coordinates(matrix[:3, 3], "static transform", error=ContentError)
    matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    return matrix


def depth_frame_of(image: Any, intrinsics: CameraIntrinsics, stamp: float, unit: float | None = None) -> DepthFrame:
    """Depth frame of a sensor_msgs/Image or CompressedImage; `unit`: metres per unit, None: by the encoding.

    Raises FrameError for an unknown encoding or inconsistent sizes.
    """
    depth = depth_of(image, unit)
    check_image_size(depth.shape[1], depth.shape[0], intrinsics)
    return DepthFrame(stamp, depth, intrinsics, str(image.header.frame_id), unit_of(depth_encoding_of(image)) if unit is None else unit)


def depth_of(image: Any, unit: float | None = None) -> NDArray[np.float32]:
    """Depth of an image as `depth_frame_of` [m], shape (height, width), NaN where there is none. Raises FrameError as it does."""
    data, encoding = memoryview(image.data).cast("B"), depth_encoding_of(image)
    if hasattr(image, "encoding"):
        return depth_from_buffer(encoding, image.height, image.width, image.step, bool(image.is_bigendian), data, unit=unit)
    from push_ident.perception.frame.compressed_depth import depth_from_compressed  # OpenCV, for these alone

    return depth_from_compressed(encoding, bytes(data), unit)


def depth_encoding_of(image: Any) -> str:
    """Encoding of a sensor_msgs/Image, format of a CompressedImage."""
    return str(image.encoding if hasattr(image, "encoding") else image.format)
