"""How short the time steps of a push must be: as short as the noise of the observed poses demands.

The error of a step of fixed length grows with speed: an object that is released at the speed v and coasts ends v dt / 2 too early, and the
contact moves by v dt between two steps. The steps are therefore chosen for each push, on a grid of levels:

    level 0: equal steps of 1/240 s                         level k > 0: steps of 1/240 s / 2^(k - 1) at most, with `resolve_events`
                                                            level k < 0: steps of 1/240 s * 2^-k at most, with `resolve_events`

The level is the lowest at which halving the steps moves the last pose by less than `SHARE` of the standard deviation of its noise (step
doubling: Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, section II.4). It is chosen before a fit, where it is 2 at
most, and kept during it, so that the cost stays smooth; finer levels are taken at its end (`identification/fitting/problem.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.physics.simulation import DEFAULT_STEP, SimulationSettings
from push_ident.types import Float64Array

SHARE: Final = 0.1
"""Largest effect of halving the steps on the last pose, in standard deviations of its noise [-]: it adds 1 % to a squared residual."""
MAX_LEVEL: Final = 7
"""Finest level: steps of 1/15360 s."""
MIN_LEVEL: Final = -5
"""Coarsest level: steps of 2/15 s, for a slow push."""

EndPose = Callable[[SimulationSettings], Float64Array]
"""Simulates a push and gives its last pose, shape (3,); NaN where the simulation fails."""


@dataclass(frozen=True, slots=True)
class StepChoice:
    """The steps of one push."""

    settings: SimulationSettings
    """With `step` set, unless the default is short enough."""
    level: int
    """0 where the settings are used as they were given."""
    error: float
    """Effect of halving the steps on the last pose, in standard deviations of its noise [-]; NaN where it was not asked for."""

    def at_most(self, level: int, given: SimulationSettings) -> StepChoice:
        """This choice, or a level of the grid of the `given` settings that is no finer and still to be judged."""
        return self if self.level <= level else StepChoice(at_level(given, level), level, 1.0)


def at_level(settings: SimulationSettings, level: int) -> SimulationSettings:
    """The settings on one level of the grid; those of level 0 are the given ones."""
    if level == 0:
        return settings
    return replace(settings, step=DEFAULT_STEP / 2.0 ** (level - 1 if level > 0 else level), resolve_events=True)


def quick_steps(settings: SimulationSettings | None) -> SimulationSettings:
    """The settings of level 1 where no step was given, for work that must be quick: it costs what level 0 does."""
    settings = settings or SimulationSettings()
    return at_level(settings, 1) if settings.step is None else settings


def halved(settings: SimulationSettings) -> SimulationSettings:
    """With half the steps and half the smoothing speed, and with events resolved unless steps were given without it."""
    return replace(
        settings,
        step=0.5 * settings.longest_step,
        resolve_events=settings.resolve_events or settings.step is None,
        smoothing_speed=0.5 * settings.smoothing_speed,
    )


def step_error(end_pose: EndPose, settings: SimulationSettings, covariance: Float64Array) -> float:
    """Effect of halving the steps and the smoothing speed on the last pose, in standard deviations of its noise [-].

    Args:
        end_pose: simulates the push.
        settings: with the steps to be judged.
        covariance: of the observed last pose (x, y, yaw) [m, m, rad], shape (3, 3).

    Returns:
        The Mahalanobis distance of the two poses; infinity where a simulation fails.
    """
    return _distance(end_pose(settings), end_pose(halved(settings)), np.linalg.inv(np.linalg.cholesky(covariance)))


def choose_steps(
    end_pose: EndPose,
    settings: SimulationSettings,
    covariance: Float64Array,
    duration: float,
    *,
    least: int = MIN_LEVEL,
    most: int = MAX_LEVEL,
) -> StepChoice:
    """The lowest level at which the steps are short enough for the noise.

    Args:
        end_pose: simulates the push.
        settings: numerics; a `step` that was given is kept.
        covariance: of the observed last pose (x, y, yaw) [m, m, rad], shape (3, 3).
        duration: of the push [s], which bounds the number of steps.
        least: level to begin with.
        most: level to end with, at most.

    Returns:
        The choice. Where no level is fine enough, that of the smallest error, which is then `SHARE` or more; and `least`, 0 at least,
        where none comes within a standard deviation, as of an impossible push, whose motion has no limit.
    """
    if settings.step is not None:
        return StepChoice(settings, 0, np.nan)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    poses: dict[int, Float64Array] = {}

    def pose(level: int) -> Float64Array:
        if level not in poses:
            poses[level] = end_pose(at_level(settings, level))
        return poses[level]

    # 10,000 steps of a push bound the time of one simulation with its derivative to some 0.1 s.
    finest = min(most, 1 + int(np.log2(max(1.0, 10_000 * DEFAULT_STEP / duration))))
    first = StepChoice(at_level(settings, max(least, 0)), max(least, 0), np.inf)
    best = first
    for level in range(least, max(finest, least) + 1):
        error = _distance(pose(level), pose(1 if level < 0 else max(level + 1, 2)), whitening)
        if error < best.error:
            best = StepChoice(at_level(settings, level), level, error)
        if error < SHARE:
            break
    return best if best.error < 1.0 else first


def _distance(pose: Float64Array, finer: Float64Array, whitening: Float64Array) -> float:
    distance = float(np.linalg.norm(whitening @ (pose - finer)))
    return distance if np.isfinite(distance) else np.inf
