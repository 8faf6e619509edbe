"""How far the cells of an object are apart at two poses: the cell error, in which predictions are judged."""

from __future__ import annotations

import numpy as np

from push_ident.geometry.se2 import rotation, transform_points
from push_ident.types import CellGrid, Float64Array


def cell_error(cells: CellGrid, pose_a_in_table: Float64Array, pose_b_in_table: Float64Array) -> float:
    """Mean over the cells of the distance between their centres at two poses [m]."""
    return float(cell_errors(cells, pose_a_in_table, pose_b_in_table))


def cell_errors(cells: CellGrid, pose_a_in_table: Float64Array, pose_b_in_table: Float64Array) -> Float64Array:
    """The same of many pairs of poses, shapes (..., 3): (...)."""
    difference = transform_points(pose_a_in_table, cells.centres) - transform_points(pose_b_in_table, cells.centres)
    return np.asarray(np.mean(np.linalg.norm(difference, axis=-1), axis=-1))


def cell_displacement(cells: CellGrid, yaw: float) -> Float64Array:
    """D with |D d|^2 = mean square displacement of the cells when their pose, turned by `yaw`, moves by a small d; shape (3, 3)."""
    arms = cells.centres @ rotation(yaw).T
    x, y = arms.mean(axis=0)
    gyration = float(np.sqrt(np.mean(np.sum((arms - arms.mean(axis=0)) ** 2, axis=1))))
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, gyration]])


def cell_error_std(cells: CellGrid, pose: Float64Array, covariance: Float64Array) -> float:
    """Expected cell error of a mean pose, shape (3,), of this covariance, shape (3, 3): root mean square [m]."""
    arms = transform_points(np.array([0.0, 0.0, pose[2]]), cells.centres)
    moment = float(np.mean(np.sum(arms**2, axis=1)))
    mean = arms.mean(axis=0)
    across = 2 * (mean[0] * covariance[1, 2] - mean[1] * covariance[0, 2])
    return float(np.sqrt(max(0.0, covariance[0, 0] + covariance[1, 1] + moment * covariance[2, 2] + across)))
