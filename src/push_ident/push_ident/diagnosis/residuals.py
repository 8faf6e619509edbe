"""Standardized residuals of every frame, how large they would be under the model, and their groups by what a cause could depend on.

Rich maps absorb most of what an effect leaves in the residuals, and more in some frames than in others. The expected residuals are
therefore drawn from the fit itself, refitted to every draw: with the derivative J of the whitened residuals and the precision P of the
prior

    r = (I - J (J'J + P)^-1 J') e,      e normal, of unit variance where errors of neighbouring frames are independent

which is a parametric bootstrap with refit, in the linear range of the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr

from push_ident.diagnosis.policy import ResidualPolicy
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.observing.observation import Observation
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import Motion
from push_ident.threads import map_in_threads
from push_ident.types import Float64Array

PHASES = ("contact", "steady", "stop", "rest")
"""Of a push, in the order of `FrameResiduals.phase`."""
N_SECTORS = 8
"""Of headings, of 45 degrees each."""
_SPEEDS = ("at rest", "slow", "medium", "fast")
_SINCE_CONTACT = (0.1, 0.3, 1.0)
"""Limits of the groups by the time since contact [s]."""
_SINCE_CONTACT_NAMES = ("up to 0.1 s", "0.1 to 0.3 s", "0.3 to 1 s", "after 1 s")
_REGIONS = ("x low, y low", "x low, y high", "x high, y low", "x high, y high")


@dataclass(frozen=True, slots=True)
class FrameResiduals:
    """Residuals of every frame of all pushes; the first pose of a push, which is fitted, is left out."""

    standardized: Float64Array
    """Along the motion of the object, across it, and in rotation, beyond the discrepancy that the frames of a push share; of unit variance
    where the model is right, shape (n, 3)."""
    difference: Float64Array
    """The same, observed minus simulated and not standardized [m, m, rad], shape (n, 3)."""
    push: Float64Array
    """Number of the push, shape (n,), as the others."""
    phase: Float64Array
    """Number in `PHASES`: contact (first tenth of the travel), steady, stop (last tenth), rest."""
    speed: Float64Array
    """Of the object [m/s]."""
    heading_in_table: Float64Array
    """Of its motion [rad]."""
    heading_in_object: Float64Array
    """[rad]"""
    position: Float64Array
    """On the table [m], shape (n, 2)."""
    since_contact: Float64Array
    """Time since the object began to move [s]."""
    null_draws: Float64Array
    """Standardized residuals drawn under the model, shape (n_draws, n, 3)."""

    def residual_ratio(self, relative_std: float = 0.0) -> tuple[float, float]:
        """Mean squared standardized residual over its expectation under the model, and the p-value of as much or more.

        `relative_std`: standard error of the expectation [1], which all draws have in common.
        """
        expected = np.mean(self.null_draws**2, axis=(1, 2))
        observed, mean = float(np.mean(self.standardized**2)), float(np.mean(expected))
        return observed / mean, _p_value(expected, observed, relative_std * mean)

    def excess_autocorrelation(self, correlation_std: float = 0.0) -> tuple[float, float]:
        """Part of the residual ratio that continues from one frame of a motion to the next, beyond its expectation, and the p-value.

        Noise is new in every frame, or correlated as it is at rest, with a standard error [1] that all draws have in common; a missing
        effect continues. (0, 1) where no push has neighbouring frames in motion.
        """
        # Without the rest that ends a push.
        pairs = np.flatnonzero((self.push[:-2] == self.push[1:-1]) & (self.push[1:-1] == self.push[2:]))
        if not len(pairs):
            return 0.0, 1.0

        def autocorrelation(residual: Float64Array) -> Float64Array:
            before, after = residual[..., pairs, :], residual[..., pairs + 1, :]
            return np.asarray(2.0 * np.sum(before * after, axis=(-2, -1)) / np.sum(before**2 + after**2, axis=(-2, -1)))

        expected, observed = autocorrelation(self.null_draws), float(autocorrelation(self.standardized))
        p_value = _p_value(expected, observed, correlation_std)
        return self.residual_ratio()[0] * (observed - float(np.mean(expected))), p_value


def _p_value(drawn: Float64Array, observed: float, shared_std: float = 0.0) -> float:
    """Probability of as much or more. Beyond all draws, and where they share an error, it is that of a normal distribution with their mean
    and variance: what is drawn is a mean over many frames."""
    reached = int(np.count_nonzero(drawn >= observed))
    if reached and shared_std == 0.0:
        return reached / len(drawn)
    # The tail is not normal that far out.
    return max(float(ndtr((np.mean(drawn) - observed) / np.hypot(np.std(drawn), shared_std))), 1e-12)


def standardized_residuals(fit: Fit, policy: ResidualPolicy) -> FrameResiduals:
    """Residuals of a fit in the frame of the object's motion, with draws of them under the model."""
    problem = fit.problem
    mechanics = fit.mechanics
    drawn = _refitted_noise(fit, policy.draws, np.random.default_rng(0))

    def of_push(push: int) -> tuple[dict[str, Float64Array], Float64Array]:
        record, observation = problem.records[push], problem.observations[push]
        scenario = PushScenario(record.pusher, problem.first_pose(fit.x, push), observation.time, record.order)
        motion = mechanics.simulate(scenario, settings=problem.settings_of(push))
        fields, to_motion_frame = _push_residuals(motion, observation, push, policy, problem.displacement(fit.x, push))
        return fields, np.einsum("fij,dfj->dfi", to_motion_frame, drawn[push])[:, 1:]

    parts, draws = zip(*map_in_threads(of_push, range(problem.n_pushes)), strict=True)
    fields = {name: np.concatenate([part[name][1:] for part in parts]) for name in parts[0]}
    return FrameResiduals(**fields, null_draws=np.concatenate(draws, axis=1))


def _push_residuals(
    motion: Motion, observation: Observation, push: int, policy: ResidualPolicy, displacement: Float64Array
) -> tuple[dict[str, Float64Array], Float64Array]:
    """Fields of `FrameResiduals` for all frames of one push, and the matrices that turn whitened residuals into standardized ones along
    and across the motion, shape (n_frames, 3, 3)."""
    time, whitening = observation.time, observation.whitening
    difference = observation.pose - motion.pose
    velocity = np.gradient(motion.pose[:, :2], np.maximum.accumulate(time + 1e-9 * np.arange(len(time))), axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    chord = motion.pose[-1, :2] - motion.pose[0, :2]
    heading = np.where(speed > policy.rest_speed, np.arctan2(velocity[:, 1], velocity[:, 0]), np.arctan2(chord[1], chord[0]))
    cos, sin = np.cos(heading), np.sin(heading)
    covariance = np.linalg.inv(np.einsum("fji,fjk->fik", whitening, whitening))
    turn = np.zeros((len(difference), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cos, sin, -sin, cos, 1.0
    deviation = np.sqrt(np.einsum("fij,fjk,fik->fi", turn, covariance, turn))
    fields = {
        "standardized": np.einsum("fij,fj->fi", turn, difference - displacement) / deviation,
        "difference": np.einsum("fij,fj->fi", turn, difference),
        "push": np.full(len(difference), float(push)),
        "phase": _phases(motion, speed, policy),
        "speed": speed,
        "heading_in_table": heading,
        "heading_in_object": wrap_angle(heading - motion.pose[:, 2]),
        "position": motion.pose[:, :2],
        "since_contact": time - time[np.argmax(speed > policy.rest_speed)],
    }
    return fields, np.einsum("fij,fjk->fik", turn, np.linalg.inv(whitening)) / deviation[:, :, None]


def _phases(motion: Motion, speed: Float64Array, policy: ResidualPolicy) -> Float64Array:
    """Number in `PHASES` of every frame of a push, shape (n_frames,)."""
    travel = np.linalg.norm(motion.pose[:, :2] - motion.pose[0, :2], axis=1)
    total = max(float(travel[-1]), 1e-9)
    moving = np.where(travel > (1.0 - policy.contact_share) * total, 2, 1)
    phase = np.where(travel < policy.contact_share * total, 0, np.where(speed > policy.rest_speed, moving, 3))
    phase[-1] = 3
    return np.asarray(phase)


def _refitted_noise(fit: Fit, n_draws: int, rng: np.random.Generator) -> list[Float64Array]:
    """Draws of the whitened residuals of each push under the model, each of shape (n_draws, n_frames, 3)."""
    problem = fit.problem
    counts = [len(observation.time) for observation in problem.observations]
    pushes = zip(problem.observations, problem.precisions, strict=True)
    noise = np.hstack([draw_noise(observation, rng, n_draws, precision).reshape(n_draws, -1) for observation, precision in pushes])
    linear = problem.linearise(fit.x)
    if linear is not None:
        # The first pose of a push is part of both: as an unknown, and as the frame that is its prior.
        jacobian, precision = linear.by_poses, problem.prior_at(fit.x)[2]
        noise = noise - np.linalg.solve(jacobian.T @ jacobian + precision, jacobian.T @ noise.T).T @ jacobian.T
    split = np.split(noise.reshape(n_draws, -1, 3), np.cumsum(counts)[:-1], axis=1)
    return [np.asarray(part) for part in split]


def draw_noise(observation: Observation, rng: np.random.Generator, n_draws: int, precision: float = 1.0) -> Float64Array:
    """Draws of the whitened errors of one push, shape (n_draws, n_frames, 3).

    Where errors of neighbouring frames are correlated, the whitening inflates each of them until their mean is as uncertain as it is; each
    whitened error by itself is then smaller than 1. The model discrepancy grows with the travel and is shared by the frames of a push: it
    is negligible beside the noise of most cameras, and dominates that of a precise tracker. `precision`: of `FitProblem.precisions`.
    """
    noise = rng.normal(size=(n_draws, len(observation.time), 3))
    rho, moving = observation.correlation, slice(1, len(observation.time) - 1)
    if rho > 0.0:
        motion = noise[:, moving]
        for frame in range(1, motion.shape[1]):
            motion[:, frame] = rho * motion[:, frame - 1] + np.sqrt(1.0 - rho**2) * motion[:, frame]
        motion *= np.sqrt((1.0 - rho) / (1.0 + rho))
    discrepancy = np.einsum("fim,dm->dfi", observation.shared, rng.normal(size=(n_draws, observation.shared.shape[2])) / np.sqrt(precision))
    return np.asarray(noise + np.einsum("fij,dfj->dfi", observation.whitening, discrepancy))


def correlation_in_motion(fit: Fit, policy: ResidualPolicy) -> float:
    """Correlation of the errors of neighbouring frames from the residuals of the motions, for pushes with hardly a frame at rest.

    A first-order autoregressive error differs by a variance 2 s^2 (1 - rho) over one frame and by 2 s^2 (1 - rho^2) over two. A missing
    effect changes smoothly and adds little to either; it makes the estimate too large rather than too small.

    Returns:
        At least 0; 0 where there are too few frames.
    """
    problem = fit.problem
    over_one, over_two, strides = [], [], []
    for push, (record, observation, motion) in enumerate(zip(problem.records, problem.observations, problem.simulate(fit.x), strict=True)):
        residual = problem.residual(fit.x, motion, push)[1:-1]
        if len(residual) > 2:
            over_one.append(np.diff(residual, axis=0))
            over_two.append(residual[2:] - residual[:-2])
            strides.append(float(np.median(np.diff(observation.time[1:-1])) / np.median(np.diff(record.poses.time))))
    if sum(map(len, over_two)) < policy.min_differences:
        return 0.0
    ratio = float(np.mean(np.vstack(over_two) ** 2) / np.mean(np.vstack(over_one) ** 2))
    return min(max(ratio - 1.0, 0.0), 1.0) ** (1.0 / float(np.mean(strides)))


@dataclass(frozen=True, slots=True)
class ResidualGroup:
    """Frames that share a property."""

    name: str
    n: int
    """Number of frames."""
    rms: tuple[float, float, float]
    """Root mean square of the standardized residual along, across and in rotation: about 1 where the model is right."""
    mean_m: float
    """Mean distance of the simulated object from the observed one [m]."""
    p_value: tuple[float, float, float]
    """Probability of each root mean square, or of a larger one, under the model."""


def group_residuals(frames: FrameResiduals, policy: ResidualPolicy) -> dict[str, list[ResidualGroup]]:
    """Residuals by push, phase, speed, heading in table and object, table region, and time since the object began to move."""
    moving = frames.speed > policy.rest_speed
    quantiles = np.quantile(frames.speed[moving], [1 / 3, 2 / 3]) if np.any(moving) else np.zeros(2)
    speeds = np.where(moving, 1 + np.searchsorted(quantiles, frames.speed), 0)
    middle = np.median(frames.position, axis=0)
    quarter = (frames.position[:, 0] > middle[0]) * 2 + (frames.position[:, 1] > middle[1])
    pushes = np.unique(frames.push)
    return {
        "push": _grouped(frames, frames.push, [str(int(push)) for push in pushes], pushes),
        "phase": _grouped(frames, frames.phase, PHASES, range(4)),
        "speed": _grouped(frames, speeds, _SPEEDS, range(4)),
        "heading_in_table": _sectors(frames, frames.heading_in_table),
        "heading_in_body": _sectors(frames, frames.heading_in_object),
        "table_region": _grouped(frames, quarter, _REGIONS, range(4)),
        "since_contact": _grouped(
            frames, np.digitize(frames.since_contact, _SINCE_CONTACT).astype(np.float64), _SINCE_CONTACT_NAMES, range(4)
        ),
    }


def _sectors(frames: FrameResiduals, heading: Float64Array) -> list[ResidualGroup]:
    sector = np.floor((heading + np.pi / N_SECTORS) / (2 * np.pi / N_SECTORS)).astype(int) % N_SECTORS
    return _grouped(frames, sector, [f"{360 * i // N_SECTORS} deg" for i in range(N_SECTORS)], range(N_SECTORS))


def _grouped(frames: FrameResiduals, key: Float64Array, names: Sequence[str], values: Sequence[Any] | Float64Array) -> list[ResidualGroup]:
    """Groups of the frames whose `key` has each of the values; groups without a frame are left out."""
    groups = []
    for name, value in zip(names, values, strict=True):
        chosen = key == value
        if np.any(chosen):
            rms = np.sqrt(np.mean(frames.standardized[chosen] ** 2, axis=0))
            distance = float(np.mean(np.linalg.norm(frames.difference[chosen, :2], axis=1)))
            p_value = np.mean(np.sqrt(np.mean(frames.null_draws[:, chosen] ** 2, axis=1)) >= rms, axis=0)
            groups.append(ResidualGroup(name, int(chosen.sum()), _triple(rms), distance, _triple(p_value)))
    return groups


def _triple(values: Float64Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
