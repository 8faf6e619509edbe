"""Depth images: from metres to points in the table frame.

Pixel (u, v) looks along ((u - cx) / fx, (v - cy) / fy, 1) in the optical frame (x right, y down, z forward; REP 103),
so a point is the camera centre plus its depth times that direction.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import FrameError
from push_ident.geometry.outline import points_in_polygon
from push_ident.perception.depth_image import check_intrinsics, check_size
from push_ident.perception.kernels import place_points
from push_ident.types import CameraIntrinsics, DepthFrame, Float64Array

__all__ = ["height_inside", "points_in_table", "rays_in_table", "usable_frame"]


def usable_frame(frame: DepthFrame) -> DepthFrame:
    """The frame as perception needs it: depth in single precision, row by row, and NaN in place of all that is no depth.

    Raises:
        FrameError: The size of the image differs from its camera info, or the intrinsics are none.
    """
    check_intrinsics(frame.intrinsics)
    check_size(frame)
    with np.errstate(over="ignore"):
        depth = np.ascontiguousarray(frame.depth, dtype=np.float32)
    if ((depth <= 0) | np.isinf(depth)).any():
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.float32(np.nan))
    return frame if depth is frame.depth else replace(frame, depth=depth)


@lru_cache(maxsize=8)
def _rays_in_camera(intrinsics: CameraIntrinsics) -> NDArray[np.float32]:
    """Direction of each line of sight per metre of depth, optical frame, shape (height, width, 3)."""
    check_intrinsics(intrinsics)
    u, v = np.meshgrid(np.arange(intrinsics.width, dtype=np.float64), np.arange(intrinsics.height, dtype=np.float64))
    rays = np.stack([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones_like(u)], axis=-1).astype(np.float32)
    rays.setflags(write=False)
    return rays


@lru_cache(maxsize=8)
def _rays_in_table(intrinsics: CameraIntrinsics, transform: bytes) -> tuple[Float64Array, NDArray[np.float32]]:
    camera_in_table = np.frombuffer(transform).reshape(4, 4)
    rays = _rays_in_camera(intrinsics) @ camera_in_table[:3, :3].T.astype(np.float32)
    centre = camera_in_table[:3, 3].copy()
    for array in (centre, rays):
        array.setflags(write=False)
    return centre, rays


def rays_in_table(intrinsics: CameraIntrinsics, camera_in_table: ArrayLike) -> tuple[Float64Array, NDArray[np.float32]]:
    """Line of sight of every pixel; cached for a camera that does not move.

    Args:
        intrinsics: The camera.
        camera_in_table: Pose of the optical frame in the table frame, homogeneous, shape (4, 4).

    Returns:
        Camera centre [m], shape (3,), and the direction per metre of depth, shape (height, width, 3), table frame.
    """
    transform = np.ascontiguousarray(camera_in_table, dtype=np.float64)
    if transform.shape != (4, 4) or not np.all(np.isfinite(transform)):
        raise FrameError(f"camera_in_table has shape {transform.shape}, expected a finite homogeneous (4, 4) transform.")
    return _rays_in_table(intrinsics, transform.tobytes())


def points_in_table(frame: DepthFrame, camera_in_table: ArrayLike) -> NDArray[np.float32]:
    """Point of every pixel.

    Returns:
        [m], shape (height, width, 3), table frame; NaN where nothing was measured.

    Raises:
        FrameError: The size of the image differs from its camera info.
    """
    check_size(frame)
    centre, rays = rays_in_table(frame.intrinsics, camera_in_table)
    points: NDArray[np.float32] = place_points(np.asarray(frame.depth, dtype=np.float32), rays, centre)
    return points


def height_inside(points: NDArray[np.float32], outline_in_table: Float64Array) -> float | None:
    """Median height [m], at least 0, of the points over an outline, shape (n_vertices, 2); None where there are none.

    `points`: of every pixel, see `points_in_table`; every second pixel in each direction is used.
    """
    some = points[::2, ::2].reshape(-1, 3)
    some = some[np.isfinite(some[:, 2])].astype(np.float64)
    inside = some[points_in_polygon(some[:, :2], outline_in_table)]
    return max(float(np.median(inside[:, 2])), 0.0) if len(inside) else None
