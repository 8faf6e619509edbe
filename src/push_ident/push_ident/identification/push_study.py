"""Whether choosing pushes pays: prediction error over the number of pushes, for any way to choose the next one.

Any source of pushes will do, a simulated cell or a real one: it says where its object lies and makes a push.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from push_ident.identification.next_push import Criterion, PlannedPush, PoseSensor, candidate_pushes, rank_pushes, reference_pushes
from push_ident.identification.observation import NoiseModel
from push_ident.identification.online import OnlineIdentifier
from push_ident.identification.prediction import held_out_errors
from push_ident.identification.prior import Prior
from push_ident.identification.result import ModelPosterior
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PoseTrack, PushRecord

__all__ = ["Policy", "PushableObject", "SimulatedObject", "choose_at_random", "choose_by", "learning_curve", "random_pushes"]

Policy = Callable[[ModelPosterior, Sequence[PlannedPush], np.random.Generator], PlannedPush]
"""Picks the next push from candidates, given what is known."""


class PushableObject(Protocol):
    """An object on a table, and something to push it with."""

    @property
    def shape(self) -> ObjectShape: ...

    @property
    def pose(self) -> Float64Array:
        """Where the object lies now, shape (3,)."""

    def execute(self, push: PlannedPush) -> PushRecord:
        """Make a push planned from `pose`."""


class SimulatedObject:
    """A known model, pushed in this package's own simulation, seen with noise, and put back after each push.

    Args:
        model: the truth.
        rng: of the noise.
        pose: where the object lies before each push, shape (3,); the origin by default.
        sensor: how its poses are seen.
        settings: numerics; finer than those of identification, so that these do not cancel out.
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
        return self.model.shape

    @property
    def pose(self) -> Float64Array:
        return self._pose

    def execute(self, push: PlannedPush) -> PushRecord:
        time = np.arange(push.pusher.time[0], push.pusher.time[-1], 1.0 / self._sensor.rate)
        motion = simulate(self.model, PushScenario(push.pusher, self._pose, time), settings=self._settings)
        seen = motion.pose + self._rng.standard_normal(motion.pose.shape) @ self._noise_root.T
        covariance = np.broadcast_to(self._sensor.covariance, (len(time), 3, 3))
        return PushRecord("o1", self.shape, PoseTrack(time, seen, covariance), push.pusher)


def choose_at_random(posterior: ModelPosterior, candidates: Sequence[PlannedPush], rng: np.random.Generator) -> PlannedPush:
    """Any safe push, as in the paper."""
    return candidates[int(rng.integers(len(candidates)))]


def choose_by(
    criterion: Criterion, push_settings: PushSettings, *, n_reference: int = 40, n_draws: int = 1, noise: NoiseModel | None = None
) -> Policy:
    """The policy that takes the push ranked first by `rank_pushes`; `push_settings` are those of the reference pushes."""

    def choose(posterior: ModelPosterior, candidates: Sequence[PlannedPush], rng: np.random.Generator) -> PlannedPush:
        reference = reference_pushes(posterior.unknowns.shape, rng, n_reference, push_settings)
        ranked = rank_pushes(posterior, candidates, reference=reference, rng=rng, criterion=criterion, n_draws=n_draws, noise=noise)
        return ranked.best or choose_at_random(posterior, candidates, rng)

    return choose


def random_pushes(thing: PushableObject, n: int, push_settings: PushSettings, rng: np.random.Generator) -> list[PushRecord]:
    """Make `n` random pushes, one after another."""
    return [thing.execute(candidate_pushes(thing.shape, thing.pose, rng, 1, push_settings)[0]) for _ in range(n)]


def learning_curve(
    thing: PushableObject,
    policy: Policy,
    held_out: Sequence[PushRecord],
    rng: np.random.Generator,
    *,
    push_settings: PushSettings,
    n_pushes: int = 6,
    n_candidates: int = 100,
    prior: Prior | None = None,
    noise: NoiseModel | None = None,
) -> Float64Array:
    """Push an object as a policy says, learn from every push, and see how well others are predicted.

    Args:
        thing: what to push.
        policy: how to choose all pushes but the first, which is random: the same one for every policy started with the same `rng`.
        held_out: pushes of the same object that the error is measured on.
        rng: of the candidates and of the policy.
        push_settings: limits and ranges of the candidates.
        n_pushes: learned from.
        n_candidates: safe pushes to choose from, each time.
        prior: beliefs.
        noise: of the observed poses.

    Returns:
        Mean cell error of the held-out pushes after 1, 2, ... pushes [m], shape (n_pushes,); NaN where one of them could not be simulated.
    """
    online = OnlineIdentifier(OnlineIdentifier.new(thing.shape, prior), noise=noise)
    errors = np.empty(n_pushes)
    for n in range(n_pushes):
        candidates = candidate_pushes(thing.shape, thing.pose, rng, n_candidates, push_settings)
        choose = policy if n > 0 else choose_at_random
        online.add(thing.execute(choose(online.posterior, candidates, rng)))
        errors[n] = held_out_errors(online.posterior.model, held_out, noise=noise).mean()
    return errors
