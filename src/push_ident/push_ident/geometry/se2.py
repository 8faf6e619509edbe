"""Planar rigid motions. A pose is (x, y, yaw) [m, m, rad]; every function works over any leading axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from push_ident.types import Float64Array


def wrap_angle(angle: ArrayLike) -> Float64Array:
    """The same angle [rad] within [-pi, pi), any shape."""
    return np.asarray((np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi)


def rotation(yaw: ArrayLike) -> Float64Array:
    """Rotation matrices, shape (..., 2, 2), of angles [rad] of shape (...)."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    matrix = np.empty((*np.shape(cos), 2, 2))
    matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1] = cos, -sin, sin, cos
    return matrix


def transform_points(pose: ArrayLike, points: ArrayLike) -> Float64Array:
    """Points given in the frame that `pose` places, expressed in the frame the pose is given in.

    `pose_b_in_a` of shape (..., 3) and `points_in_b` of shape (n, 2) or (..., n, 2) give `points_in_a`, shape (..., n, 2).
    """
    pose = np.asarray(pose, dtype=np.float64)
    points = np.asarray(points, dtype=np.float64)
    return points @ np.swapaxes(rotation(pose[..., 2]), -1, -2) + pose[..., None, :2]


def compose(pose_b_in_a: ArrayLike, pose_c_in_b: ArrayLike) -> Float64Array:
    """`pose_c_in_a`, shape (..., 3); the yaw is the plain sum, not wrapped."""
    outer, inner = np.broadcast_arrays(np.asarray(pose_b_in_a, dtype=np.float64), np.asarray(pose_c_in_b, dtype=np.float64))
    position = transform_points(outer, inner[..., None, :2])[..., 0, :]
    return np.concatenate([position, outer[..., 2:] + inner[..., 2:]], axis=-1)


def inverse(pose_b_in_a: ArrayLike) -> Float64Array:
    """`pose_a_in_b`, shape (..., 3)."""
    pose = np.asarray(pose_b_in_a, dtype=np.float64)
    position = -(np.swapaxes(rotation(pose[..., 2]), -1, -2) @ pose[..., :2, None])[..., 0]
    return np.concatenate([position, -pose[..., 2:]], axis=-1)


def yaw_of_quaternion(quaternion: ArrayLike) -> Float64Array:
    """Heading of the x axis [rad], shape (...), of quaternions (x, y, z, w), shape (..., 4), of any norm but zero."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    return np.asarray(np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z))


def quaternion_of_yaw(yaw: ArrayLike) -> Float64Array:
    """Unit quaternions (x, y, z, w), shape (..., 4), that turn about z by `yaw` [rad], shape (...)."""
    half = 0.5 * np.asarray(yaw, dtype=np.float64)
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)
