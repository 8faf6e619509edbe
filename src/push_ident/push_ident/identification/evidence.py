"""What the training pushes of a fit show about it: see `explanation`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.identification.explanation import Explanation, PushEvidence, near_distance
from push_ident.identification.observation import pusher_gaps, rest_frames
from push_ident.identification.prediction import cell_error
from push_ident.identification.result import ModelPosterior
from push_ident.physics.effect_values import true_pose
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, PushRecord, SolveStatus

__all__ = ["explain"]

_REST_FRAMES: Final = 5
"""Frames of which the median is the pose at rest, if they are at most a quarter of a push: one wrong pose does not move it."""


def explain(posterior: ModelPosterior, records: Sequence[PushRecord], *, settings: SimulationSettings | None = None) -> Explanation:
    """Compare the mean model of a fit with the pushes that it was fitted to.

    Args:
        posterior: of the fit.
        records: its training pushes, at least one.
        settings: numerics of the simulation.
    """
    return Explanation(tuple(_evidence(posterior, record, settings) for record in records))


def _evidence(posterior: ModelPosterior, record: PushRecord, settings: SimulationSettings | None) -> PushEvidence:
    poses, cells = record.poses, record.shape.cells
    n = max(1, min(_REST_FRAMES, len(poses.time) // 4))
    # An arm that hides the object in the middle of a push leaves few frames after it: those before it are no part of the end.
    _, after, touched = rest_frames(record)
    end = after[-n:] if touched else np.arange(len(poses.time))[-n:]
    first, last = np.median(poses.pose[:n], axis=0), np.median(poses.pose[end], axis=0)
    mechanics = posterior.unknowns.mechanics(posterior.z)
    scenario = PushScenario(record.pusher, true_pose(mechanics.effects, first), poses.time[-1:], record.order)
    motion = mechanics.simulate(scenario, settings=settings)
    error = np.inf if motion.status is SolveStatus.SIMULATION_FAILED else cell_error(cells, motion.pose[-1], last)
    noise = _noise(record)
    # An object that is hidden at the end of a push is seen last while it moves: compared is where the pusher was then.
    seen_last, pusher = float(np.median(poses.time[end])), record.pusher
    tip = np.array([[np.interp(seen_last, pusher.time, pusher.position[:, axis]) for axis in (0, 1)]])
    return PushEvidence(
        error=error if np.isfinite(error) else np.inf,
        motion=cell_error(cells, first, last),
        noise=noise,
        overlap=pusher.radius - _distance(record, tip, last)[0],
        remote_motion=_remote_motion(record, first, near_distance(noise)),
    )


def _noise(record: PushRecord) -> float:
    """Standard deviation of a cell error between two frames [m]."""
    covariance = np.median(record.poses.covariance, axis=0)
    arm2 = float(np.mean(np.sum(record.shape.cells.centres**2, axis=1)))
    return float(np.sqrt(2.0 * (covariance[0, 0] + covariance[1, 1] + arm2 * covariance[2, 2])))


def _remote_motion(record: PushRecord, first: Float64Array, near: float) -> float:
    poses, pusher = record.poses, record.pusher
    # Of a polygon the circle around it, so that no contact is missed.
    reach = pusher.radius + (0.0 if pusher.polygon is None else float(np.max(np.linalg.norm(pusher.polygon, axis=1))))
    if len(poses.time) < 2 * _REST_FRAMES:
        # Too few frames to know when the object began to move; but it stood at its first pose until it was touched.
        came_near = _distance(record, pusher.position, first) < near + reach
        before = np.arange(0 if np.any(came_near) else len(poses.time))
    else:
        came_near = pusher_gaps(record) + pusher.radius - reach < near
        before = np.flatnonzero(poses.time < pusher.time[np.argmax(came_near)]) if np.any(came_near) else np.arange(len(poses.time))
    if not len(before):
        return 0.0
    return cell_error(record.shape.cells, first, np.median(poses.pose[before[-min(3, len(before)) :]], axis=0))


def _distance(record: PushRecord, points_in_table: Float64Array, pose_object_in_table: Float64Array) -> Float64Array:
    """Signed distance of points, shape (n, 2), from the outline of the object at a pose [m], shape (n,)."""
    return signed_distance(transform_points(inverse(pose_object_in_table), points_in_table), record.shape.outline)
