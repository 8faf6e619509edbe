"""What a push record says, condensed for a fit: few frames, each with the noise that it really carries.

Frames before the touch all show one pose, and so do those after the object has come to rest: each group becomes its mean. Of the
frames between, a limited number is kept. Noise is that of the frame plus a discrepancy that grows with the way the object has
gone, since no model of pushing is exact, and frames of one push share it.

How far a mean is better than a frame, the rest frames tell: where they scatter as their covariance says, the error averages out;
where they scatter far less, as those of a tracker do, the covariance is of an error that they share. Errors that last from frame to
frame (`NoiseModel.correlation`) average out more slowly, and neighbouring frames of the motion say the same twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from push_ident.geometry.outline import signed_distance
from push_ident.types import BoolArray, Float64Array, PushRecord

__all__ = ["NoiseModel", "Observation", "noise_correlation", "observe_push"]

_SHARING = 10
"""Frames of one motion that share its discrepancy and count as `NoiseModel` has it; where there are more, each counts less."""
_ENOUGH = 12
"""Degrees of freedom from which the scatter of rest frames is trusted."""
_ENOUGH_PAIRS = 40
"""Pairs of neighbouring frames at rest from which their correlation is trusted."""
_MOST_CORRELATION = 0.95
_OUTLIER = 6.0
"""A frame at rest that is so many deviations off the others is a wrong pose, not noise."""
_CLEAR = 0.01
"""Gap from which the pusher does not touch, though tool and camera be off by several times what is usual [m]."""
_COAST = 0.15  # an object let go at 0.3 m/s on friction 0.2 rests within this [s]


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Errors of observed poses beyond the covariance that comes with them."""

    floor_position: float = 1e-4
    """That nothing removes: contact is not known better [m]."""
    floor_yaw: float = 1e-3
    """[rad]"""
    fit_discrepancy_position: float = 0.012
    """Discrepancy of position per way gone, as a frame counts in a fit: the ten frames of a push share one, so each counts less."""
    fit_discrepancy_yaw: float = 0.12
    """Discrepancy of yaw per way gone [rad/m]."""
    model_discrepancy_position: float = 0.003
    """Discrepancy of position per way gone, of a predicted pose."""
    model_discrepancy_yaw: float = 0.03
    """[rad/m]"""
    single_frame_inflation: float = 2.0
    """Factor on the stated deviation of a rest pose that was seen once: nothing checks it."""
    max_moving_frames: int = 10
    """Frames kept of the motion itself."""
    correlation: float = 0.0
    """Of the errors of one frame and the next; see `noise_correlation`."""

    @property
    def fit_discrepancy(self) -> Float64Array:
        """Model discrepancy of a frame in a fit, by travel [1, 1, rad/m], shape (3,)."""
        return np.array([self.fit_discrepancy_position, self.fit_discrepancy_position, self.fit_discrepancy_yaw])

    @property
    def model_discrepancy(self) -> Float64Array:
        """Model discrepancy of a predicted pose, by travel [1, 1, rad/m], shape (3,)."""
        return np.array([self.model_discrepancy_position, self.model_discrepancy_position, self.model_discrepancy_yaw])


@dataclass(frozen=True, slots=True)
class Observation:
    """A push, condensed."""

    time: Float64Array
    """[s], shape (n_frames,)."""
    pose: Float64Array
    """Table frame, shape (n_frames, 3). The first is the pose at rest before the touch, the last the pose at rest afterwards."""
    whitening: Float64Array
    """W with W' W = inverse covariance of a frame, shape (n_frames, 3, 3)."""
    first_covariance: Float64Array
    """Of the first pose, shape (3, 3)."""
    last_covariance: Float64Array
    """Of the last pose as it was seen, without the discrepancy that `whitening` has, shape (3, 3)."""
    touched: bool
    """Whether the pusher comes near the observed object at all."""
    discrepancy: Float64Array
    """Deviation of what no model of pushing is free of, and what goes on from frame to frame; part of `whitening` [m, m, rad], shape
    (n_frames, 3)."""
    correlation: float = 0.0
    """Of the errors of one frame of the motion and the next; `whitening` takes them for larger instead."""


def observe_push(record: PushRecord, noise: NoiseModel | None = None) -> Observation:
    """Condense one push record."""
    noise = noise or NoiseModel()
    poses = record.poses
    before, after, touched = _rests(record)
    moving = np.arange(before[-1] + 1, after[0])
    stride = max(1.0, len(moving) / noise.max_moving_frames)
    if len(moving) > noise.max_moving_frames:
        moving = moving[np.linspace(0, len(moving) - 1, noise.max_moving_frames).round().astype(int)]
    before, after = _agreeing(record, before), _agreeing(record, after)
    singles = [np.array([frame]) for frame in moving]
    groups = [before, *singles, after] if after[0] > before[-1] else [before[:-1], after]

    time = np.array([poses.time[g].mean() for g in groups])
    pose = np.array([poses.pose[g].mean(axis=0) for g in groups])
    floor = np.diag([noise.floor_position**2, noise.floor_position**2, noise.floor_yaw**2])
    travel = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pose[:, :2], axis=0), axis=1))])
    travel = np.minimum(travel, np.linalg.norm(pose[:, :2] - pose[0, :2], axis=1) + 0.05 * np.abs(pose[:, 2] - pose[0, 2]))
    growth = noise.fit_discrepancy**2 * max(1.0, len(moving) / _SHARING)
    scatter = _scatter(record, before, after)
    neighbours = min(max(noise.correlation, 0.0), _MOST_CORRELATION) ** stride
    repeated = _repetition(neighbours)
    stated = [poses.covariance[g].mean(axis=0) * max(scatter, 1.0) * repeated for g in groups]
    for end in (0, -1):
        n = len(groups[end])
        shared = max(0.0, 1.0 - 2.0 * scatter)
        apart = min(1.0, _repetition(noise.correlation) / n)
        stated[end] = stated[end] / repeated * (noise.single_frame_inflation**2 if n == 1 else shared + (1.0 - shared) * apart)
    covariance = np.array([c + floor + np.diag(growth * way**2) for c, way in zip(stated, travel, strict=True)])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    discrepancy = travel[:, None] * noise.model_discrepancy
    return Observation(time, pose, whitening, covariance[0], stated[-1] + floor, touched, discrepancy, neighbours)


def noise_correlation(records: Sequence[PushRecord], *, enough_pairs: int = _ENOUGH_PAIRS) -> float:
    """Correlation of the errors of one frame and the next, from the frames at rest; NaN where these make less than `enough_pairs`.

    For neighbours in time, of a first-order autoregressive error; the mean of each rest, which takes a part of it, is allowed for
    (Marriott & Pope, Bias in the estimation of autocorrelations, Biometrika 41, 1954).
    """
    products = squares = 0.0
    n_pairs = n_frames = n_rests = 0
    for record in records:
        before, after, _ = _rests(record)
        # A tool or a camera that is off lets the object move before the pusher seems to be there.
        clear = before[record.poses.time[before] < _first_time(record, _gaps(record) < _CLEAR)]
        for rest in (_agreeing(record, clear), _agreeing(record, after)):
            if len(rest) < 4:
                continue
            off = record.poses.pose[rest] - record.poses.pose[rest].mean(axis=0)
            off = off / np.sqrt(np.diagonal(record.poses.covariance[rest], axis1=1, axis2=2))
            products += float(np.sum(off[1:] * off[:-1]))
            squares += float(np.sum(off**2))
            n_pairs, n_frames, n_rests = n_pairs + max(len(off) - 1, 0), n_frames + len(off), n_rests + 1
    if n_pairs < enough_pairs or squares <= 0.0:
        return float("nan")
    length = n_frames / n_rests
    raw = products / n_pairs / (squares / n_frames)
    return float(np.clip((raw + 1.0 / length) / max(1.0 - 3.0 / length, 0.25), -_MOST_CORRELATION, _MOST_CORRELATION))


def _agreeing(record: PushRecord, rest: NDArray[np.intp]) -> NDArray[np.intp]:
    """Frames at rest without wrong poses: a single one would drag the mean along."""
    if len(rest) < 2:
        return rest
    off = record.poses.pose[rest] - np.median(record.poses.pose[rest], axis=0)
    deviation = np.sqrt(np.diagonal(record.poses.covariance[rest], axis1=1, axis2=2))
    fits = np.max(np.abs(off) / deviation, axis=1) < _OUTLIER
    return rest[fits] if np.any(fits) else rest


def _repetition(correlation: float) -> float:
    """By how much the variance of a mean of many is larger than if they were independent."""
    rho = min(max(correlation, 0.0), _MOST_CORRELATION)
    return (1.0 + rho) / (1.0 - rho)


def _rests(record: PushRecord) -> tuple[NDArray[np.intp], NDArray[np.intp], bool]:
    """Frames at rest before the touch and after the push, at least one each; and whether the pusher comes near the object at all."""
    poses, pusher = record.poses, record.pusher
    near = _gaps(record) < max(3e-3, 3 * float(np.sqrt(np.median(poses.covariance[:, 0, 0]))))
    touch_time = _first_time(record, near)
    speed = np.linalg.norm(np.gradient(pusher.position, pusher.time, axis=0), axis=1)
    driving = near & (speed > 0.05 * max(float(speed.max()), 1e-9))
    rest_time = float(pusher.time[np.flatnonzero(driving)[-1]]) + _COAST if np.any(driving) else -np.inf

    before = np.flatnonzero(poses.time <= touch_time)
    before = before if len(before) else np.array([0])
    after = np.flatnonzero(poses.time >= max(rest_time, touch_time)) if np.isfinite(touch_time) else np.array([], dtype=int)
    after = after[after > before[-1]]
    after = after if len(after) else np.array([len(poses.time) - 1])
    return before, after, bool(np.any(near))


def _first_time(record: PushRecord, when: BoolArray) -> float:
    """Of the samples of the pusher, shape (n_samples,), the first that is so [s]; infinity where none is."""
    return float(record.pusher.time[np.argmax(when)]) if np.any(when) else np.inf


def _scatter(record: PushRecord, *rests: NDArray[np.intp]) -> float:
    """Variance of the frames at rest over that which their covariance states; 1 where there are too few to tell."""
    poses = record.poses
    squares = freedom = 0.0
    for rest in rests:
        off = poses.pose[rest] - poses.pose[rest].mean(axis=0)
        squares += float(np.sum(off**2 / np.diagonal(poses.covariance[rest], axis1=1, axis2=2)))
        freedom += 3.0 * (len(rest) - 1)
    return squares / freedom if freedom >= _ENOUGH else 1.0


def _gaps(record: PushRecord) -> Float64Array:
    """Gap between pusher and outline at every pusher sample, by the observed poses [m], shape (n_samples,)."""
    poses, pusher = record.poses, record.pusher
    pose = np.column_stack([np.interp(pusher.time, poses.time, poses.pose[:, axis]) for axis in range(3)])
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    away = pusher.position - pose[:, :2]
    seen = np.column_stack([cos * away[:, 0] + sin * away[:, 1], -sin * away[:, 0] + cos * away[:, 1]])
    return np.asarray(signed_distance(seen, record.shape.outline), dtype=np.float64) - pusher.radius
