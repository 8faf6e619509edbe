"""Where the gap lies: what is left of every frame, sorted by everything that a cause could depend on.

Rich maps take up most of what an effect leaves, and more in some frames than in others. What residuals would be without any gap is
therefore drawn from the fit itself, refitted to every draw: with the whitened residuals' derivative J and the precision P of the prior

    r = (I - J (J'J + P)^-1 J') e,      e normal, of unit variance where errors do not last from frame to frame

which is a parametric bootstrap with refit in the linear range of the fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.diagnosis.fits import EffectFit
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.observation import Observation
from push_ident.physics.scenario import PushScenario
from push_ident.types import BoolArray, Float64Array

__all__ = ["Frames", "Group", "correlation_in_motion", "group_frames", "left_over"]

_N_SECTORS = 8
_N_DRAWS = 400
_STILL = 0.01
"""Slower than this an object counts as resting [m/s]."""
_ENOUGH_DIFFERENCES = 40
"""Of frames of a motion, from which the correlation of their errors is told."""
_DEGREES = ("along", "across", "rotation")


@dataclass(frozen=True, slots=True)
class Frames:
    """What is left of every frame of all pushes, standardised: of unit variance where the model is right."""

    residual: Float64Array
    """Along the way the object goes, across it, and in rotation, shape (n, 3)."""
    off: Float64Array
    """The same, not standardised [m, m, rad], shape (n, 3)."""
    push: Float64Array
    """Number of the push, shape (n,), as the others."""
    phase: Float64Array
    """0 contact (first tenth of the way), 1 steady, 2 stop, 3 rest."""
    speed: Float64Array
    """Of the object [m/s]."""
    heading_in_table: Float64Array
    """Of its motion [rad]."""
    heading_in_body: Float64Array
    position: Float64Array
    """On the table [m], shape (n, 2)."""
    without_gap: Float64Array
    """Residuals as they would be if the model were right, shape (n_draws, n, 3)."""

    @property
    def misfit(self) -> tuple[float, float]:
        """Mean square of the residuals over that of a model that is right, and the probability of as much by chance."""
        without_gap = np.mean(self.without_gap**2, axis=(1, 2))
        left = float(np.mean(self.residual**2))
        return left / float(np.mean(without_gap)), float(np.mean(without_gap >= left))

    def misfit_of(self, chosen: BoolArray) -> float:
        """The same of some of the frames, chosen by a mask of shape (n,), without its probability."""
        return float(np.mean(self.residual[chosen] ** 2) / np.mean(self.without_gap[:, chosen] ** 2))

    @property
    def persistence(self) -> tuple[float, float]:
        """What of `misfit` lasts from frame to frame of a motion more than without a gap, and the probability of as much by chance.

        Noise is new in every frame; what no effect explains goes on. 0 where no push has neighbouring frames.
        """
        pairs = np.flatnonzero((self.push[:-2] == self.push[1:-1]) & (self.push[1:-1] == self.push[2:]))  # without the rest that ends it
        if not len(pairs):
            return 0.0, 1.0

        def lasting(residual: Float64Array) -> Float64Array:
            before, after = residual[..., pairs, :], residual[..., pairs + 1, :]
            return np.asarray(2.0 * np.sum(before * after, axis=(-2, -1)) / np.sum(before**2 + after**2, axis=(-2, -1)))

        without_gap, found = lasting(self.without_gap), float(lasting(self.residual))
        return self.misfit[0] * (found - float(np.mean(without_gap))), float(np.mean(without_gap >= found))


@dataclass(frozen=True, slots=True)
class Group:
    """Frames that have something in common."""

    name: str
    n: int
    rms: tuple[float, float, float]
    """Of the standardised residual along, across and in rotation: 1 is noise."""
    mean_m: float
    """Mean distance of the simulated object from the observed one [m]."""
    by_chance: tuple[float, float, float]
    """Probability of as much or more in each if the model were right."""


PHASES = ("contact", "steady", "stop", "rest")


def left_over(fit: EffectFit) -> Frames:
    """Residuals of a fit; the first pose of a push, which is fitted, is left out."""
    problem = fit.problem
    mechanics = fit.parameters.mechanics(fit.z)
    rng = np.random.default_rng(0)
    drawn = iter(_refitted_noise(fit, rng))
    parts, nulls = [], []
    for push, (record, seen) in enumerate(zip(problem.records, problem.observations, strict=True)):
        motion = mechanics.simulate(
            PushScenario(record.pusher, problem.first_pose(fit.x, push), seen.time, record.order), settings=problem.settings
        )
        off = seen.pose - motion.pose
        velocity = np.gradient(motion.pose[:, :2], np.maximum.accumulate(seen.time + 1e-9 * np.arange(len(seen.time))), axis=0)
        speed = np.linalg.norm(velocity, axis=1)
        way = motion.pose[-1, :2] - motion.pose[0, :2]
        heading = np.where(speed > _STILL, np.arctan2(velocity[:, 1], velocity[:, 0]), np.arctan2(way[1], way[0]))
        cos, sin = np.cos(heading), np.sin(heading)
        turned = np.column_stack([cos * off[:, 0] + sin * off[:, 1], -sin * off[:, 0] + cos * off[:, 1], off[:, 2]])
        covariance = np.linalg.inv(np.einsum("fji,fjk->fik", seen.whitening, seen.whitening))
        turn = np.zeros((len(off), 3, 3))
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cos, sin, -sin, cos, 1.0
        deviation = np.sqrt(np.einsum("fij,fjk,fik->fi", turn, covariance, turn))
        gone = np.linalg.norm(motion.pose[:, :2] - motion.pose[0, :2], axis=1)
        total = max(float(gone[-1]), 1e-9)
        phase = np.where(gone < 0.1 * total, 0, np.where(speed > _STILL, np.where(gone > 0.9 * total, 2, 1), 3))
        phase[-1] = 3
        n = len(off)
        columns = [
            turned / deviation,
            turned,
            np.full((n, 1), push),
            phase[:, None],
            speed[:, None],
            heading[:, None],
            wrap_angle(heading - motion.pose[:, 2])[:, None],
            motion.pose[:, :2],
        ]
        parts.append(np.hstack(columns)[1:])
        to_frame = np.einsum("fij,fjk->fik", turn, np.linalg.inv(seen.whitening)) / deviation[:, :, None]
        nulls.append(np.einsum("fij,dfj->dfi", to_frame, next(drawn))[:, 1:])
    all_frames = np.vstack(parts)
    return Frames(
        residual=all_frames[:, :3],
        off=all_frames[:, 3:6],
        push=all_frames[:, 6],
        phase=all_frames[:, 7],
        speed=all_frames[:, 8],
        heading_in_table=all_frames[:, 9],
        heading_in_body=all_frames[:, 10],
        position=all_frames[:, 11:13],
        without_gap=np.concatenate(nulls, axis=1),
    )


def _refitted_noise(fit: EffectFit, rng: np.random.Generator) -> list[Float64Array]:
    """Draws of whitened residuals of each push without a gap, each of shape (n_draws, n_frames, 3)."""
    problem = fit.problem
    counts = [len(seen.time) for seen in problem.observations]
    noise = np.hstack([_noise_of(seen, rng).reshape(_N_DRAWS, -1) for seen in problem.observations])
    jacobian = problem.jacobian(fit.x)
    if jacobian is not None:
        # The first pose of a push is part of both: as an unknown, and as the frame that is its prior.
        precision = np.diag(np.r_[np.ones(fit.parameters.size), np.zeros(3 * len(counts))])
        noise = noise - np.linalg.solve(jacobian.T @ jacobian + precision, jacobian.T @ noise.T).T @ jacobian.T
    split = np.split(noise.reshape(_N_DRAWS, -1, 3), np.cumsum(counts)[:-1], axis=1)
    return [np.asarray(part) for part in split]


def _noise_of(seen: Observation, rng: np.random.Generator) -> Float64Array:
    """Draws of whitened errors of one push, shape (n_draws, n_frames, 3).

    Where errors of the motion last from frame to frame, the whitening takes each of them for as much larger as makes their mean as
    uncertain as it is; by itself each is smaller. What a model of pushing is off by grows with the way and lasts: it is nothing beside
    the noise of most cameras, and all there is beside that of a good tracker.
    """
    noise = rng.normal(size=(_N_DRAWS, len(seen.time), 3))
    rho, moving = seen.correlation, slice(1, len(seen.time) - 1)
    if rho > 0.0:
        motion = noise[:, moving]
        for frame in range(1, motion.shape[1]):
            motion[:, frame] = rho * motion[:, frame - 1] + np.sqrt(1.0 - rho**2) * motion[:, frame]
        motion *= np.sqrt((1.0 - rho) / (1.0 + rho))
    lasting = rng.normal(size=(_N_DRAWS, 1, 3)) * seen.discrepancy
    return np.asarray(noise + np.einsum("fij,dfj->dfi", seen.whitening, lasting))


def correlation_in_motion(fit: EffectFit) -> float:
    """Correlation of the errors of one frame and the next, from what a fit leaves of the motions: for pushes with hardly a frame at rest.

    Over one frame a first-order autoregressive error differs by a variance 2 s^2 (1 - rho), over two by 2 s^2 (1 - rho^2). What an effect
    leaves goes on smoothly and adds little to either; it makes the correlation come out too large rather than too small.

    Returns:
        At least 0; 0 where there are too few frames.
    """
    problem = fit.problem
    over_one, over_two, strides = [], [], []
    for push, (record, seen, motion) in enumerate(zip(problem.records, problem.observations, problem.simulate(fit.x), strict=True)):
        left = problem.residual(motion, push)[1:-1]
        if len(left) > 2:
            over_one.append(np.diff(left, axis=0))
            over_two.append(left[2:] - left[:-2])
            strides.append(float(np.median(np.diff(seen.time[1:-1])) / np.median(np.diff(record.poses.time))))
    if sum(map(len, over_two)) < _ENOUGH_DIFFERENCES:
        return 0.0
    ratio = float(np.mean(np.vstack(over_two) ** 2) / np.mean(np.vstack(over_one) ** 2))
    return min(max(ratio - 1.0, 0.0), 1.0) ** (1.0 / float(np.mean(strides)))


def group_frames(frames: Frames) -> dict[str, list[Group]]:
    """The same residuals, grouped by push, phase, speed, heading in table and body, and table region."""
    moving = frames.speed > _STILL
    quantiles = np.quantile(frames.speed[moving], [1 / 3, 2 / 3]) if np.any(moving) else np.zeros(2)
    speeds = np.where(moving, 1 + np.searchsorted(quantiles, frames.speed), 0)
    middle = np.median(frames.position, axis=0)
    quarter = (frames.position[:, 0] > middle[0]) * 2 + (frames.position[:, 1] > middle[1])
    return {
        "push": _grouped(frames, frames.push, [str(int(p)) for p in np.unique(frames.push)], np.unique(frames.push)),
        "phase": _grouped(frames, frames.phase, PHASES, range(4)),
        "speed": _grouped(frames, speeds, ("at rest", "slow", "medium", "fast"), range(4)),
        "heading_in_table": _sectors(frames, frames.heading_in_table),
        "heading_in_body": _sectors(frames, frames.heading_in_body),
        "table_region": _grouped(frames, quarter, ("x low, y low", "x low, y high", "x high, y low", "x high, y high"), range(4)),
    }


def _sectors(frames: Frames, heading: Float64Array) -> list[Group]:
    sector = np.floor((heading + np.pi / _N_SECTORS) / (2 * np.pi / _N_SECTORS)).astype(int) % _N_SECTORS
    return _grouped(frames, sector, [f"{360 * i // _N_SECTORS} deg" for i in range(_N_SECTORS)], range(_N_SECTORS))


def _grouped(frames: Frames, key: Float64Array, names: object, values: object) -> list[Group]:
    groups = []
    for name, value in zip(names, values, strict=True):  # type: ignore[call-overload]
        chosen = key == value
        if np.any(chosen):
            rms = np.sqrt(np.mean(frames.residual[chosen] ** 2, axis=0))
            distance = float(np.mean(np.linalg.norm(frames.off[chosen, :2], axis=1)))
            chance = np.mean(np.sqrt(np.mean(frames.without_gap[:, chosen] ** 2, axis=1)) >= rms, axis=0)
            groups.append(Group(str(name), int(chosen.sum()), _triple(rms), distance, _triple(chance)))
    return groups


def _triple(values: Float64Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
