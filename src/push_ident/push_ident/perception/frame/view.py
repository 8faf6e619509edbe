"""A depth frame over the table: where its pixels look, which points they measure, and what those points belong to.

Pixel (u, v) looks along ((u - cx) / fx, (v - cy) / fy, 1) in the optical frame (x right, y down, z forward; REP 103),
so a point is the camera centre plus its depth times that direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import FrameError
from push_ident.geometry.outline import points_in_polygon
from push_ident.geometry.se2 import transform_points
from push_ident.perception.frame.depth_image import check_intrinsics, check_size
from push_ident.perception.frame.robot import Cylinder, RobotPart
from push_ident.perception.kernels import label_heights, place_points, points_in_rods, sort_columns
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import BoolArray, CameraIntrinsics, DepthFrame, Float64Array

STRIDE: Final = 4
"""Every fourth pixel of every fourth row is used for a plane: enough for three unknowns."""

UNKNOWN, TABLE, OBJECT, ROBOT = -1, 0, 1, 2
"""Labels of pixels."""
MATCHER_PIXELS: Final = 8.0
"""Edge of the window of a matcher: 7 px (Keselman) to 9 px (Konolige) [px]."""
DEVIATIONS: Final = 4.0
"""Heights that differ by so many standard deviations of the noise are different: one pixel in 16,000 of a flat table is further off [-]."""


@dataclass(frozen=True, eq=False)
class FrameView:
    """A depth frame, the pose of its camera and the robot in it. Rays, points and labels are computed once, when first asked for.

    Raises FrameError: The size of the image differs from its camera info.
    """

    frame: DepthFrame
    camera_in_table: Float64Array
    """Optical frame in the table frame, homogeneous, shape (4, 4)."""
    robot: Sequence[RobotPart] = ()
    """Tool and arm when the frame was taken."""
    settings: PerceptionSettings = field(default_factory=PerceptionSettings)
    noise: float = 0.0
    """Standard deviation of the height of a point [m]."""

    def __post_init__(self) -> None:
        check_size(self.frame)

    @cached_property
    def rays(self) -> tuple[Float64Array, NDArray[np.float32]]:
        """Camera centre [m], shape (3,), and direction of each pixel per metre of depth, shape (height, width, 3), table frame.

        Raises FrameError: The pose of the camera is no finite (4, 4) transform.
        """
        transform = np.ascontiguousarray(self.camera_in_table, dtype=np.float64)
        if transform.shape != (4, 4) or not np.all(np.isfinite(transform)):
            raise FrameError(f"camera_in_table has shape {transform.shape}, expected a finite homogeneous (4, 4) transform.")
        return _rays_in_table(self.frame.intrinsics, transform.tobytes())

    @cached_property
    def points(self) -> NDArray[np.float32]:
        """Point of each pixel [m], shape (height, width, 3), table frame; NaN where nothing was measured."""
        centre, rays = self.rays
        points: NDArray[np.float32] = place_points(np.asarray(self.frame.depth, dtype=np.float32), rays, centre)
        return points

    @cached_property
    def labels(self) -> NDArray[np.int8]:
        """UNKNOWN, TABLE, OBJECT or ROBOT of each pixel by the height of its point, shape (height, width).

        A median over 3 x 3 pixels removes single outliers from the heights and keeps edges in place. Everything above `max_object_height`
        is ROBOT as well; outside the workspace nothing is OBJECT; what is more than 20 mm below the table is beside it.
        """
        heights, settings = self.points[..., 2], self.settings
        (low_x, low_y), (high_x, high_y) = settings.workspace_low, settings.workspace_high
        # Only raised pixels can be robot; the test is run on those few pixels.
        labels, raised = label_heights(
            self.points,
            cv2.medianBlur(np.where(np.isfinite(heights), heights, np.float32(0.0)), 3),
            (low_x, high_x, low_y, high_y),
            (-0.02, 0.5 * settings.min_object_height, settings.min_object_height, settings.max_object_height),
            (UNKNOWN, TABLE, OBJECT, ROBOT),
        )
        if self.robot:
            raised[raised] = self.is_robot(self.points[raised])
            labels[raised] = ROBOT
        return np.asarray(labels)

    @cached_property
    def shared_noise(self) -> float:
        """How much of the noise of the table pixels beside each other share [-]: 0 where each is measured by itself, 1 - 2 / (3 w) where a
        matcher averages over windows of w pixels.

        1 less the ratio of the mean squares of second differences of heights along rows, of neighbours and of pixels two windows apart: a
        plane has none. 0 where whole units of depth hide the noise.
        """
        heights = self.points[..., 2]
        near = np.abs(heights) < 0.5 * self.settings.min_object_height
        if not near.any():
            return 0.0
        spread = 1.4826 * float(np.median(np.abs(heights[near])))
        # Rounding alone has a spread of 0.37 units.
        if spread < 0.5 * float(np.min(np.diff(np.unique(self.frame.depth[near])), initial=np.inf)):
            return 0.0
        heights = np.where(np.abs(heights) < DEVIATIONS * spread, heights, np.float32(np.nan))

        def mean_square(step: int) -> float:
            bend = heights[:, : -2 * step] - 2.0 * heights[:, step:-step] + heights[:, 2 * step :]
            bend = bend[np.isfinite(bend)]
            return float(np.mean(np.square(bend))) if len(bend) else np.nan

        beside, apart = mean_square(1), mean_square(2 * int(MATCHER_PIXELS))
        return float(np.clip(1.0 - beside / apart, 0.0, 1.0)) if apart > 0.0 and np.isfinite(beside) else 0.0

    def is_robot(self, points: NDArray[np.float32]) -> BoolArray:
        """Which points, shape (..., 3), table frame, lie in the robot."""
        return in_robot(points, self.robot, self.settings.mask_margin)

    def is_due(self, last: float, period: float) -> bool:
        """Whether something that was last done at `last` [s] is to be done in this frame: once in a period, not twice in one frame.

        A millisecond less will do, so that a camera at exactly that rate does not miss every other turn by rounding.
        """
        return last < self.frame.stamp and self.frame.stamp - last >= period - 1e-3

    def with_pixels(self, depth: NDArray[np.float32], points: NDArray[np.float32], labels: NDArray[np.int8]) -> FrameView:
        """The same view with these depths, points and labels."""
        view = replace(self, frame=replace(self.frame, depth=depth))
        view.__dict__.update(points=points, labels=labels)
        return view


@lru_cache(maxsize=8)
def _rays_in_table(intrinsics: CameraIntrinsics, transform: bytes) -> tuple[Float64Array, NDArray[np.float32]]:
    """As `FrameView.rays`, kept for cameras that do not move."""
    check_intrinsics(intrinsics)
    u, v = np.meshgrid(np.arange(intrinsics.width, dtype=np.float64), np.arange(intrinsics.height, dtype=np.float64))
    in_camera = np.stack([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones_like(u)], axis=-1)
    camera_in_table = np.frombuffer(transform).reshape(4, 4)
    rays = in_camera.astype(np.float32) @ camera_in_table[:3, :3].T.astype(np.float32)
    centre = camera_in_table[:3, 3].copy()
    for array in (centre, rays):
        array.setflags(write=False)
    return centre, rays


def points_in_table(frame: DepthFrame, camera_in_table: ArrayLike) -> NDArray[np.float32]:
    """Point of every pixel, as `FrameView.points`. Raises FrameError: The size of the image differs from its camera info."""
    return FrameView(frame, np.asarray(camera_in_table, dtype=np.float64)).points


def in_robot(points: NDArray[np.float32], robot: Sequence[RobotPart], margin: float) -> BoolArray:
    """Which of `points`, shape (..., 3), lie in a part of the robot grown by `margin` [m]."""
    if not robot:
        return np.zeros(points.shape[:-1], dtype=bool)
    flat = np.ascontiguousarray(points, dtype=np.float32).reshape(-1, 3)
    inside = points_in_rods(flat, np.array([_as_row(part) for part in robot]), margin)
    return np.asarray(inside.reshape(points.shape[:-1]))


def _as_row(part: RobotPart) -> tuple[float, ...]:
    """Start, unit direction, length and radius of a part."""
    if isinstance(part, Cylinder):
        return part.x, part.y, part.z_min, 0.0, 0.0, 1.0, math.inf, part.radius
    axis = part.end - part.start
    length = float(np.linalg.norm(axis))
    return *part.start, *(axis / length), length, part.radius


def median_frame(frames: Sequence[DepthFrame]) -> DepthFrame:
    """The last of some frames at rest with the median depth of each pixel; NaN where fewer than half of them measured something."""
    images = [np.asarray(frame.depth, dtype=np.float32).reshape(-1) for frame in frames]
    median = np.empty(len(images[0]), dtype=np.float32)
    block = 8192  # pixels of all frames that stay in the cache
    for at in range(0, len(median), block):
        stack = np.stack([image[at : at + block] for image in images])
        valid = np.isfinite(stack)
        n_valid = np.count_nonzero(valid, axis=0)
        stack[~valid] = np.inf
        sort_columns(stack)  # What was not measured is at the end, so the median is in the middle of the first n_valid.
        last, column = np.maximum(n_valid - 1, 0), np.arange(stack.shape[1])
        low, high = stack[last // 2, column], stack[(last + 1) // 2, column]
        median[at : at + block] = np.where(2 * n_valid >= len(stack), 0.5 * (low + high), np.float32(np.nan))
    return replace(frames[-1], depth=median.reshape(frames[0].depth.shape))


def pixel_at(view: FrameView, pose: Float64Array) -> float:
    """Width of a pixel of a view where a pose (x, y, yaw), table frame, is on the table [m]."""
    distance = float(np.linalg.norm(view.camera_in_table[:3, 3] - (pose[0], pose[1], 0.0)))
    return distance / view.frame.intrinsics.fx


def windows_along(view: FrameView, pose: Float64Array, outline: Float64Array, height: float) -> Float64Array:
    """Length of the edges of an outline, shape (n, 2), at a pose and a height [m], in windows of a matcher [-], shape (n,)."""
    k, camera = view.frame.intrinsics, view.camera_in_table
    points = np.column_stack([transform_points(pose, outline), np.full(len(outline), height)])
    in_camera = (points - camera[:3, 3]) @ camera[:3, :3]
    pixels = in_camera[:, :2] * (k.fx, k.fy) / in_camera[:, 2:]
    return np.asarray(np.linalg.norm(np.roll(pixels, -1, axis=0) - pixels, axis=1) / MATCHER_PIXELS)


def wall_visibility(view: FrameView, pose: Float64Array, height: float) -> float:
    """How well the camera of a view sees the walls of an object at a pose (x, y, yaw), table frame, of this height [m].

    The share of half the window of a matcher that the wall below an edge fills, by metre of the camera's distance along the outward normal
    of the edge [1/m]: a wall of height h fills h d / H beside its upper edge, d metres in front of which the camera is, H above the table.
    """
    return height / (float(view.camera_in_table[2, 3]) * 0.5 * MATCHER_PIXELS * pixel_at(view, pose))


def unmeasured_areas(measured: BoolArray) -> NDArray[np.uint8]:
    """Unmeasured pixels of an area, not of a line: 1, same shape.

    They are the shadow that the projector or the second imager of a camera leaves beside an object, at least three pixels wide. Single
    unmeasured pixels along an edge may belong to either side of it and prove nothing.
    """
    return np.asarray(cv2.morphologyEx((~measured).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)))


def height_inside(points: NDArray[np.float32], outline_in_table: Float64Array) -> float | None:
    """Median height [m], at least 0, of the points over an outline, shape (n_vertices, 2); None where there are none.

    `points`: of every pixel, see `FrameView.points`; every second pixel in each direction is used.
    """
    some = points[::2, ::2].reshape(-1, 3)
    some = some[np.isfinite(some[:, 2])].astype(np.float64)
    inside = some[points_in_polygon(some[:, :2], outline_in_table)]
    return max(float(np.median(inside[:, 2])), 0.0) if len(inside) else None
