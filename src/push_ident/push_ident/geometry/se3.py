"""Rigid motions in space: homogeneous matrices, shape (4, 4), and the quaternions (x, y, z, w) of files and messages."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from push_ident.errors import InputError
from push_ident.types import Float64Array


def pose_of_quaternion(position: ArrayLike, quaternion: ArrayLike) -> Float64Array:
    """Pose (4, 4) of a frame at `position` [m], shape (3,), turned by `quaternion` (x, y, z, w).

    Raises:
        InputError: The quaternion does not have unit length, a value is not finite, or a shape is wrong.
    """
    shift, turn = np.asarray(position, dtype=np.float64), np.asarray(quaternion, dtype=np.float64)
    is_unit = turn.shape == (4,) and abs(float(np.linalg.norm(turn)) - 1.0) < 1e-3
    if shift.shape != (3,) or not np.isfinite(shift).all() or not is_unit:
        raise InputError(f"A pose is a position (x, y, z) and a unit quaternion (x, y, z, w), got {shift.tolist()} and {turn.tolist()}.")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(turn).as_matrix()
    pose[:3, 3] = shift
    return pose


def quaternion_of_pose(pose: ArrayLike) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w) of a pose, shape (4, 4)."""
    x, y, z, w = (float(value) for value in Rotation.from_matrix(np.asarray(pose, dtype=np.float64)[:3, :3]).as_quat())
    return x, y, z, w
