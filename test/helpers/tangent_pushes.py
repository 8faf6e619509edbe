"""Pushes by construction: the tool is tangent to the outline while the object moves, without any mechanics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.types import CameraAccuracy, Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord

RADIUS = 0.006
ACCELERATION = 1.0
"""Of the tool at both ends of its way [m/s^2]."""


def tangent_push(
    shape: ObjectShape, pose: Float64Array, edge: int, along: float, *, turn: float, speed: float, gap: float = 0.0
) -> PushRecord:
    """A push of 50 mm into an edge at a part of its length, in which the object turns by `turn` [rad]; exact poses at 30 Hz.

    `gap`: by which the surface lies outside of the outline [m].
    """
    start, end = shape.outline[edge], np.roll(shape.outline, -1, axis=0)[edge]
    tangent = (end - start) / np.linalg.norm(end - start)
    outward = np.array([tangent[1], -tangent[0]])
    axis = start + along * (end - start) + (RADIUS + gap) * outward  # of the tool, in the object, while it touches
    driven, free, wait = 0.05, 0.02, 0.4  # way of the object and of the tool before it [m], rest at both ends [s]
    ramp = speed / ACCELERATION
    lasts = (driven + free) / speed + ramp
    time = np.arange(0.0, lasts + 2 * wait, 1 / 240)
    t = np.clip(time - wait, 0.0, lasts)
    rest = np.minimum(t, lasts - t)  # the profile is symmetric
    short = 0.5 * ACCELERATION * np.minimum(rest, ramp) ** 2 + speed * np.maximum(rest - ramp, 0.0)
    way = np.where(t < lasts / 2, short, driven + free - short) - free
    share = np.maximum(way, 0.0) / driven
    direction = transform_points([0.0, 0.0, pose[2]], -outward[None])[0]
    poses = pose + np.column_stack([np.maximum(way, 0.0)[:, None] * direction, share * turn])
    tool = transform_points(poses, axis[None, None])[:, 0] + np.minimum(way, 0.0)[:, None] * direction
    seen = slice(None, None, 8)
    covariance = np.broadcast_to(np.diag([1e-5, 1e-5, 1e-4]) ** 2, (len(time[seen]), 3, 3))
    return PushRecord("1", shape, PoseTrack(time[seen], poses[seen], covariance), PusherPath(time, tool, RADIUS))


def pushes_around(shape: ObjectShape, n: int, rng: np.random.Generator, *, gap: float = 0.0, spread: float = 0.15) -> list[PushRecord]:
    """Pushes into edges that follow each other around the object, at random places of the table."""
    records = []
    for k in range(n):
        pose = np.array([*rng.uniform(-spread, spread, 2), rng.uniform(-np.pi, np.pi)])
        at, turn, speed = rng.uniform(0.2, 0.8), rng.uniform(-0.3, 0.3), rng.uniform(0.05, 0.15)
        records.append(tangent_push(shape, pose, k % len(shape.outline), at, turn=turn, speed=speed, gap=gap))
    return [replace(record, order=order) for order, record in enumerate(records)]


def observed(
    record: PushRecord, rng: np.random.Generator, *, std: Float64Array, shared: Float64Array, camera: CameraAccuracy
) -> PushRecord:
    """The push with noise of each frame and an error that all its frames share, (x, y, yaw) standard deviations, shape (3,)."""
    poses = record.poses
    pose = poses.pose + std * rng.normal(size=poses.pose.shape) + shared * rng.normal(size=3)
    covariance = np.broadcast_to(np.diag(std**2 + shared**2), poses.covariance.shape)
    return replace(record, poses=PoseTrack(poses.time, pose, covariance, camera))
