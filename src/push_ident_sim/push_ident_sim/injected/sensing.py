"""Effects between the object and its reported poses: on the poses, or on the camera that is rendered."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError
from push_ident.geometry.se2 import rotation
from push_ident.types import CameraIntrinsics, Float64Array
from push_ident_sim.injected.effects import INJECTED, InjectedEffects
from push_ident_sim.injected.equations import reported_poses, times_of_poses


def measured_at(effects: InjectedEffects, stamp: Float64Array) -> Float64Array:
    """When the poses stamped `stamp` [s], shape (n,), were measured."""
    (delta,) = effects["pose_latency"]
    return times_of_poses(effects, stamp - delta)


def stamp_delay(effects: InjectedEffects, time: float) -> float:
    """How much later than `time` [s] a frame of that moment is stamped [s]; exact for a delay that does not change."""
    (delta,) = effects["pose_latency"]
    return delta + (time - float(times_of_poses(effects, np.array([time]))[0]))


def observed_poses(effects: InjectedEffects, pose: Float64Array) -> Float64Array:
    """Poses (x, y, yaw) in `table`, shape (n, 3), as a camera with wrong extrinsics or a wrong scale reports them."""
    (angle,), shift, (kappa,) = effects["camera_rotation"], effects["camera_translation"], effects["camera_scale"]
    observed = pose.copy()
    if angle or any(shift) or kappa:
        observed[:, :2] = (1.0 + kappa) * pose[:, :2] @ rotation(angle).T + shift
        observed[:, 2] += angle
    return reported_poses(effects, observed)


def true_camera(effects: InjectedEffects, reported: Float64Array, intrinsics: CameraIntrinsics) -> tuple[Float64Array, CameraIntrinsics]:
    """True pose in `table`, shape (4, 4), and true intrinsics of a camera that reports `reported` and `intrinsics`."""
    (angle,), shift, (kappa,) = effects["camera_rotation"], effects["camera_translation"], effects["camera_scale"]
    error = np.eye(4)
    error[:2, :2] = rotation(angle)
    error[:2, 3] = shift
    camera = replace(intrinsics, fx=(1.0 + kappa) * intrinsics.fx, fy=(1.0 + kappa) * intrinsics.fy)
    return np.linalg.inv(error) @ reported, camera


def kept_frames(effects: InjectedEffects, n_frames: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which frames arrive, shape (n_frames,); the first and the last always do."""
    (share,) = effects["dropped_frames"]
    kept = np.asarray(rng.random(n_frames) >= share)
    kept[[0, -1]] = True
    return kept


def flipped(effects: InjectedEffects, pose: Float64Array, rng: np.random.Generator) -> Float64Array:
    """Poses, shape (n, 3), some of them turned by half a turn."""
    (share,) = effects["pose_flips"]
    turned = pose.copy()
    turned[rng.random(len(pose)) < share, 2] += np.pi
    return turned


def correlated(effects: InjectedEffects, noise: Float64Array) -> Float64Array:
    """Standard noise, one row a frame, made to correlate with the frame before at the same standard deviation."""
    (rho,) = effects["noise_correlation"]
    if rho == 0.0:
        return noise
    mixed = noise.copy()
    for k in range(1, len(noise)):
        mixed[k] = rho * mixed[k - 1] + np.sqrt(1.0 - rho**2) * noise[k]
    return mixed


class PoseSensor:
    """Reports poses one after another, as a camera does."""

    def __init__(self, effects: InjectedEffects, std: Float64Array, rng: np.random.Generator) -> None:
        """`std` of x, y [m] and yaw [rad], shape (3,)."""
        self._effects = effects
        self._std = std
        self._rng, self._frame_rng = rng, rng.spawn(1)[0]
        self._noise: Float64Array | None = None
        self._delayed: deque[tuple[float, Float64Array]] = deque()
        (self._dropped,), (self._rho,) = effects["dropped_frames"], effects["noise_correlation"]

    def measure(self, time: float, pose: Float64Array) -> list[tuple[float, Float64Array]]:
        """Take in `pose` (x, y, yaw) at `time` [s]; returns stamps [s] and poses (x, y, yaw) of the frames that arrive until then."""
        fresh = self._rng.standard_normal(3)
        before, self._noise = self._noise, fresh
        if before is not None:
            self._noise = self._rho * before + np.sqrt(1.0 - self._rho**2) * fresh
        observed = flipped(self._effects, observed_poses(self._effects, pose[None]) + self._std * self._noise, self._frame_rng)[0]
        if self._frame_rng.random() >= self._dropped:
            self._delayed.append((time + stamp_delay(self._effects, time), observed))
        arrived = []
        while self._delayed and self._delayed[0][0] <= time + 1e-9:
            arrived.append(self._delayed.popleft())
        return arrived


def check_rendered(effects: InjectedEffects) -> None:
    """Raise InputError for effects that a rendered camera cannot have."""
    if on_poses := [name for name, _ in effects.values if INJECTED[name].acts_on == "poses"]:
        known = ", ".join(name for name, effect in INJECTED.items() if effect.acts_on == "camera")
        raise InputError(f"Effect {on_poses[0]} acts on poses and needs a cell without camera; a rendered camera can have {known}.")
