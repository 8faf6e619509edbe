"""Effects between the object and what is seen of it: on poses, or on the camera that is rendered."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError
from push_ident.types import CameraIntrinsics
from push_ident_sim.injected.catalogue import EFFECTS, Effects

__all__ = ["PoseSensor", "check_rendered", "correlated", "flipped", "kept_frames", "seen_poses", "true_camera"]

FloatArray = NDArray[np.float64]


def seen_poses(effects: Effects, pose: FloatArray) -> FloatArray:
    """Poses (x, y, yaw) in `table`, shape (n, 3), as a camera with the wrong extrinsics or scale sees them."""
    (angle,), shift, (scale,) = effects["camera_rotation"], effects["camera_translation"], effects["camera_scale"]
    seen = pose.copy()
    seen[:, :2] = (1.0 + scale) * pose[:, :2] @ _rotation(angle).T + shift
    seen[:, 2] += angle
    return seen


def true_camera(effects: Effects, reported: FloatArray, intrinsics: CameraIntrinsics) -> tuple[FloatArray, CameraIntrinsics]:
    """Pose in `table`, shape (4, 4), and intrinsics that the camera really has, if it reports `reported` and `intrinsics`."""
    (angle,), shift, (scale,) = effects["camera_rotation"], effects["camera_translation"], effects["camera_scale"]
    seen_in_table = np.eye(4)
    seen_in_table[:2, :2] = _rotation(angle)
    seen_in_table[:2, 3] = shift
    camera = replace(intrinsics, fx=(1.0 + scale) * intrinsics.fx, fy=(1.0 + scale) * intrinsics.fy)
    return np.linalg.inv(seen_in_table) @ reported, camera


def kept_frames(effects: Effects, n_frames: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which frames arrive, shape (n_frames,); the first and the last always do."""
    (share,) = effects["dropped_frames"]
    kept = np.asarray(rng.random(n_frames) >= share)
    kept[[0, -1]] = True
    return kept


def flipped(effects: Effects, pose: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Poses of which some are turned by half a turn, shape (n, 3)."""
    (share,) = effects["pose_flips"]
    turned = pose.copy()
    turned[rng.random(len(pose)) < share, 2] += np.pi
    return turned


def correlated(effects: Effects, noise: FloatArray) -> FloatArray:
    """Independent standard noise, one row a frame, made to depend on the frame before, with the same deviation."""
    (rho,) = effects["noise_correlation"]
    if rho == 0.0:
        return noise
    mixed = noise.copy()
    for k in range(1, len(noise)):
        mixed[k] = rho * mixed[k - 1] + np.sqrt(1.0 - rho**2) * noise[k]
    return mixed


class PoseSensor:
    """Poses as they come in, one after another."""

    def __init__(self, effects: Effects, std: FloatArray, rng: np.random.Generator) -> None:
        """`std` of x, y [m] and yaw [rad], shape (3,)."""
        self._effects = effects
        self._std = std
        self._rng, self._luck = rng, rng.spawn(1)[0]
        self._noise: FloatArray | None = None
        self._on_the_way: deque[tuple[float, FloatArray]] = deque()
        (self._delay,), (self._dropped,), (self._rho,) = effects["pose_latency"], effects["dropped_frames"], effects["noise_correlation"]

    def see(self, time: float, pose: FloatArray) -> list[tuple[float, FloatArray]]:
        """Take in `pose` (x, y, yaw) at `time` [s]; stamps [s] and poses (x, y, yaw) of what arrives until then."""
        fresh = self._rng.standard_normal(3)
        before, self._noise = self._noise, fresh
        if before is not None:
            self._noise = self._rho * before + np.sqrt(1.0 - self._rho**2) * fresh
        seen = flipped(self._effects, seen_poses(self._effects, pose[None]) + self._std * self._noise, self._luck)[0]
        if self._luck.random() >= self._dropped:
            self._on_the_way.append((time + self._delay, seen))
        arrived = []
        while self._on_the_way and self._on_the_way[0][0] <= time + 1e-9:
            arrived.append(self._on_the_way.popleft())
        return arrived


def check_rendered(effects: Effects) -> None:
    """Raise InputError for effects that a rendered camera cannot have."""
    if on_poses := effects.acting_on("poses"):
        known = ", ".join(name for name, effect in EFFECTS.items() if effect.acts_on == "camera")
        raise InputError(f"Effect {on_poses[0]} changes poses and needs a cell without camera; a rendered camera can have {known}.")


def _rotation(angle: float) -> FloatArray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
