"""Prediction error over the number of pushes, for any policy that chooses the next push.

The pushes may come from a simulated cell or a real one: anything that reports the pose of its object and makes a push.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.predicting.next_push import (
    Criterion,
    PlannedPush,
    PoseSensor,
    RankingOptions,
    candidate_pushes,
    rank_pushes,
    reference_pushes,
)
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PoseTrack, PushRecord

__all__ = [
    "CurveOptions",
    "Policy",
    "PushableObject",
    "SimulatedObject",
    "choose_at_random",
    "choose_by",
    "learning_curve",
    "random_pushes",
]

Policy = Callable[[ModelPosterior, Sequence[PlannedPush], np.random.Generator], PlannedPush]
"""Chooses the next push from candidates, given the posterior."""


class PushableObject(Protocol):
    """An object on a table, and something to push it with."""

    @property
    def shape(self) -> ObjectShape:
        """Outline and cells of the object."""

    @property
    def pose(self) -> Float64Array:
        """Present pose of the object, shape (3,)."""

    def execute(self, push: PlannedPush) -> PushRecord:
        """Make a push planned from `pose`."""


class SimulatedObject:
    """A known model, pushed in the simulation of this package, observed with noise, and put back after each push.

    Args:
        model: the truth.
        rng: of the noise.
        pose: of the object before each push, shape (3,); the origin by default.
        sensor: of its poses.
        settings: numerics; finer than those of identification, so that their errors do not cancel.
    """

    def __init__(
        self,
        model: ObjectModel,
        rng: np.random.Generator,
        *,
        pose: Float64Array | None = None,
        sensor: PoseSensor | None = None,
        settings: SimulationSettings | None = None,
    ) -> None:
        self.model = model
        self._rng = rng
        self._pose = np.zeros(3) if pose is None else np.array(pose, dtype=np.float64)
        self._sensor = sensor or PoseSensor()
        self._noise_root = np.linalg.cholesky(self._sensor.covariance)
        self._settings = settings or SimulationSettings(step=1 / 960)

    @property
    def shape(self) -> ObjectShape:
        """As `PushableObject.shape`."""
        return self.model.shape

    @property
    def pose(self) -> Float64Array:
        """As `PushableObject.pose`; the same before every push."""
        return self._pose

    def execute(self, push: PlannedPush) -> PushRecord:
        """As `PushableObject.execute`, with noisy poses."""
        time = np.arange(push.pusher.time[0], push.pusher.time[-1], 1.0 / self._sensor.rate)
        motion = simulate(self.model, PushScenario(push.pusher, self._pose, time), settings=self._settings)
        observed = motion.pose + self._rng.standard_normal(motion.pose.shape) @ self._noise_root.T
        covariance = np.broadcast_to(self._sensor.covariance, (len(time), 3, 3))
        return PushRecord("o1", self.shape, PoseTrack(time, observed, covariance), push.pusher)


def choose_at_random(posterior: ModelPosterior, candidates: Sequence[PlannedPush], rng: np.random.Generator) -> PlannedPush:
    """Any safe push, as in the paper."""
    return candidates[int(rng.integers(len(candidates)))]


def choose_by(
    criterion: Criterion, push_settings: PushSettings, *, n_reference: int = 40, n_draws: int = 1, noise: NoiseModel | None = None
) -> Policy:
    """The policy that takes the best push of `rank_pushes`; `push_settings` are those of the reference pushes."""

    def choose(posterior: ModelPosterior, candidates: Sequence[PlannedPush], rng: np.random.Generator) -> PlannedPush:
        reference = reference_pushes(posterior.unknowns.shape, rng, n_reference, push_settings)
        options = RankingOptions(criterion=criterion, n_draws=n_draws, noise=noise)
        return rank_pushes(posterior, candidates, reference=reference, rng=rng, options=options).best or choose_at_random(
            posterior, candidates, rng
        )

    return choose


def random_pushes(thing: PushableObject, n: int, push_settings: PushSettings, rng: np.random.Generator) -> list[PushRecord]:
    """Make `n` random pushes, one after another."""
    return [thing.execute(candidate_pushes(thing.shape, thing.pose, rng, 1, push_settings)[0]) for _ in range(n)]


@dataclass(frozen=True, slots=True)
class CurveOptions:
    """Size and assumptions of a learning curve."""

    n_pushes: int = 6
    """Pushes to fit, one after another."""
    n_candidates: int = 100
    """Safe pushes to choose from, each time."""
    prior: Prior | None = None
    noise: NoiseModel | None = None
    """Of the observed poses."""


def learning_curve(
    thing: PushableObject,
    policy: Policy,
    held_out: Sequence[PushRecord],
    rng: np.random.Generator,
    *,
    push_settings: PushSettings,
    options: CurveOptions | None = None,
) -> Float64Array:
    """Push an object as a policy chooses, fit after every push, and measure how well other pushes are predicted.

    Args:
        thing: to push.
        policy: chooses all pushes but the first, which is random: the same one for every policy started with the same `rng`.
        held_out: pushes of the same object, for the error.
        rng: of the candidates and of the policy.
        push_settings: limits and ranges of the candidates.
        options: size and assumptions.

    Returns:
        Mean cell error of the held-out pushes after 1, 2, ... pushes [m], shape (n_pushes,); NaN where one of them could not be simulated.
    """
    options = options or CurveOptions()
    online = OnlineIdentifier(OnlineIdentifier.new(thing.shape, options.prior), noise=options.noise)
    errors = np.empty(options.n_pushes)
    for n in range(options.n_pushes):
        candidates = candidate_pushes(thing.shape, thing.pose, rng, options.n_candidates, push_settings)
        choose = policy if n > 0 else choose_at_random
        online.add(thing.execute(choose(online.posterior, candidates, rng)))
        errors[n] = held_out_errors(online.posterior.model, held_out, noise=options.noise).mean()
    return errors
