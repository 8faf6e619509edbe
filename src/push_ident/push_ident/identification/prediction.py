"""What a push will do, with its uncertainty, and how far off a prediction was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.identification.observation import NoiseModel, observe_push
from push_ident.identification.result import ModelPosterior
from push_ident.physics.rollout import PARAM_MASS
from push_ident.physics.simulation import SimulationSettings, simulate, simulate_body
from push_ident.types import CellGrid, Float64Array, ObjectModel, PusherPath, PushRecord, SolveStatus

__all__ = ["Prediction", "cell_error", "held_out_errors", "predict"]


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted motion of an object under a push."""

    time: Float64Array
    """[s], shape (n_frames,)."""
    pose: Float64Array
    """Table frame, shape (n_frames, 3)."""
    covariance: Float64Array
    """Of each pose, shape (n_frames, 3, 3): model, first pose and the discrepancy of the model class."""
    cell_error_std: float
    """Expected mean cell error of the last pose, root mean square [m]."""
    status: SolveStatus


def cell_error(cells: CellGrid, pose_a_in_table: Float64Array, pose_b_in_table: Float64Array) -> float:
    """Mean over the cells of the distance between their centres at two poses [m]."""
    apart = transform_points(pose_a_in_table, cells.centres) - transform_points(pose_b_in_table, cells.centres)
    return float(np.mean(np.linalg.norm(apart, axis=1)))


def predict(
    posterior: ModelPosterior,
    pusher: PusherPath,
    pose_object_in_table: Float64Array,
    time: Float64Array,
    *,
    first_covariance: Float64Array | None = None,
    noise: NoiseModel | None = None,
    settings: SimulationSettings | None = None,
) -> Prediction:
    """Predict the motion of an object at rest.

    Args:
        posterior: what is known of the object.
        pusher: path of the pusher.
        pose_object_in_table: first pose, shape (3,).
        time: when [s], ascending, shape (n_frames,).
        first_covariance: of the first pose, shape (3, 3); default 0.5 mm, 0.3 degrees.
        noise: its growth with the way gone is added as the discrepancy of the model.
        settings: numerics.

    Returns:
        The prediction; look at its `status`. Linear propagation: right while the motion does not switch with the first pose.
    """
    noise = noise or NoiseModel()
    body, pusher_friction, d_body = posterior.parameters.body(posterior.z)
    shape = posterior.parameters.shape
    motion = simulate_body(shape, body, pusher_friction, pusher, pose_object_in_table, time, settings=settings, jacobian=True)
    if first_covariance is None:
        first_covariance = np.diag([5e-4, 5e-4, 5e-3]) ** 2
    by_z = motion.jacobian[:, :, PARAM_MASS:] @ d_body[PARAM_MASS:]
    by_first = motion.jacobian[:, :, :3]
    covariance = by_z @ posterior.covariance @ by_z.transpose(0, 2, 1) + by_first @ first_covariance @ by_first.transpose(0, 2, 1)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(motion.pose[:, :2], axis=0), axis=1))])
    growth = np.array([noise.growth_position, noise.growth_position, noise.growth_yaw])
    covariance += np.einsum("f,i,ij->fij", way**2, growth**2, np.eye(3))
    return Prediction(motion.time, motion.pose, covariance, _cell_error_std(shape.cells, motion.pose[-1], covariance[-1]), motion.status)


def _cell_error_std(cells: CellGrid, pose: Float64Array, covariance: Float64Array) -> float:
    """Root of the mean over the cells of the variance of their centres."""
    arms = transform_points(np.array([0.0, 0.0, pose[2]]), cells.centres)
    moment = float(np.mean(np.sum(arms**2, axis=1)))
    mean = arms.mean(axis=0)
    across = 2 * (mean[0] * covariance[1, 2] - mean[1] * covariance[0, 2])
    return float(np.sqrt(max(0.0, covariance[0, 0] + covariance[1, 1] + moment * covariance[2, 2] + across)))


def held_out_errors(
    model: ObjectModel, records: Sequence[PushRecord], *, noise: NoiseModel | None = None, settings: SimulationSettings | None = None
) -> Float64Array:
    """Cell error at the end of each push [m], shape (n_records,): the object simulated from its observed first pose.

    First and last pose are the means of the rest frames. NaN where the simulation failed.
    """
    errors = []
    for record in records:
        seen = observe_push(record, noise)
        motion = simulate(model, record.pusher, seen.pose[0], seen.time[-1:], settings=settings)
        errors.append(cell_error(record.shape.cells, motion.pose[-1], seen.pose[-1]))
    return np.array(errors)
