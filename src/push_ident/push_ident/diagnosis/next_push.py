"""The push that would resolve what these data cannot: the one whose outcome the competing explanations predict most differently."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import ndtri

from push_ident.diagnosis.policy import NextPushPolicy, SelectionPolicy
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.threads import map_in_threads
from push_ident.errors import InputError, PlanningError
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.observing.observation import NoiseModel, Observation, observe_push
from push_ident.identification.predicting.next_push import (
    PlannedPush,
    PoseSensor,
    RankingOptions,
    candidate_pushes,
    imagine_push,
    rank_pushes,
    reference_pushes,
)  # fmt: skip
from push_ident.identification.unknowns.mechanics import Mechanics
from push_ident.physics.effect_values import reported_poses, true_pose
from push_ident.physics.effects import EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings
from push_ident.pushing.push import PUSH_ACCELERATION, PushSettings
from push_ident.types import Float64Array, ObjectShape, PoseTrack, SolveStatus

NO_EFFECT = "no effect"
"""Name of the explanation that no effect is missing."""


@dataclass(frozen=True, slots=True)
class SeparatingPush:
    """A push, and how well it would resolve what is open."""

    push: PlannedPush
    between: tuple[str, str]
    """The pair of explanations whose predictions differ least, among those that a push can distinguish."""
    mahalanobis2: float
    """Squared Mahalanobis distance of their predictions, as the sensor would observe them and the model may be wrong."""
    n_pushes: int
    """Such pushes that are probably enough: each brings half the distance in log evidence on average, with the distance as variance."""

    @property
    def aim(self) -> str:
        """Its purpose, to continue "the push that"."""
        first, second = self.between
        if first == NO_EFFECT:
            return f"would show {second} best"
        return f"confirms {second} best" if first == without(second) else f"distinguishes {first} from {second} best"


def without(name: str) -> str:
    """Name of the explanation that an effect that was found is absent."""
    return f"without {name}"


def competing_explanations(selection: Selection, policy: SelectionPolicy) -> dict[str, Fit]:
    """Fits that a push should distinguish, by name: first those in a tie with the last effect, then with one before it.

    Exact twins are left out, since no push distinguishes them. Where nothing was found, the most promising effects compete with none; where
    nothing is in a tie, the last effect competes with its absence, so that the push confirms it.
    """
    if not selection.selected:
        first = selection.steps[0] if selection.steps else None
        return {NO_EFFECT: selection.base, **({c.name: c.fit for c in first.candidates[:2]} if first else {})}
    rivals = [rival for rival in selection.tied_rivals(policy) if rival.name not in EFFECTS[rival.replaces].exact_twins]
    if rivals:
        replaced = rivals[0].replaces
        return {replaced: selection.fit, **{rival.name: rival.fit for rival in rivals if rival.replaces == replaced}}
    step, last = list(selection.added.values())[-1]
    return {without(last.name): step.before, last.name: selection.fit}


def needed_evidence(fits: Mapping[str, Fit], policy: SelectionPolicy) -> float:
    """Log evidence that pushes have to bring to decide between explanations [nat]: what excludes a rival, or detects an effect."""
    first = next(iter(fits))
    return policy.min_log_bayes_factor if first == NO_EFFECT or first.startswith(without("")) else policy.tie_margin


def separating_push(
    fits: Mapping[str, Fit], pose: Float64Array, settings: PushSettings, policy: NextPushPolicy, *, needed: float
) -> SeparatingPush | None:
    """The best of some safe candidate pushes: it has the largest distance between the two explanations that it separates least.

    Args:
        fits: explanations by name, at least two, all of one object.
        pose: where it lies, table frame, shape (3,).
        settings: limits of the push.
        policy: candidates, and how many pushes are worth while.
        needed: log evidence that decides [nat].

    Returns:
        None where no push is safe, or no few pushes are expected to decide.
    """
    problem = next(iter(fits.values())).problem
    candidates = _candidates(problem.unknowns.shape, pose, settings, policy)
    models = {name: _Predictor.of(fit) for name, fit in fits.items()}
    sensor = _sensor(problem.records[-1].poses)
    first_variance = np.array(policy.first_pose_std) ** 2
    outcomes = map_in_threads(lambda push: _outcomes(models, push, sensor, problem.noise, first_variance), candidates)
    pairs = list(combinations(fits, 2))
    distances = np.array([[_mahalanobis2(outcome[a], outcome[b]) for a, b in pairs] for outcome in outcomes]).reshape(-1, len(pairs))
    # A pair that no push separates does not count against any: the others can still be decided.
    separable = np.flatnonzero([_n_pushes(float(np.max(of_pair, initial=0.0)), needed, policy) is not None for of_pair in distances.T])
    if not len(separable):
        return None
    hardest = distances[:, separable].min(axis=1)
    best = int(np.argmax(hardest))
    n_pushes = _n_pushes(float(hardest[best]), needed, policy)
    if n_pushes is None:
        return None
    pair = pairs[separable[int(np.argmin(distances[best, separable]))]]
    return SeparatingPush(candidates[best], pair, float(hardest[best]), n_pushes)


def _n_pushes(mahalanobis2: float, needed: float, policy: NextPushPolicy) -> int | None:
    """Pushes that bring the log evidence `needed` [nat] with the probability of the policy; None where the most that it allows do not."""
    least = float(ndtri(policy.success))
    evidence = [n * mahalanobis2 / 2.0 - least * np.sqrt(n * mahalanobis2) for n in range(1, policy.max_pushes + 1)]
    return next((n for n, value in enumerate(evidence, 1) if value >= needed), None)


def most_informative_push(fit: Fit, pose: Float64Array, settings: PushSettings, policy: NextPushPolicy) -> PlannedPush | None:
    """The push after which the next pushes are expected to be predicted best, by the criterion of an identification.

    Returns:
        None where no push is safe, or none would add information.
    """
    shape, problem = fit.unknowns.shape, fit.problem
    # Their order is that of the speeds: every third one is an even sample, and enough where no explanations compete.
    candidates = _candidates(shape, pose, settings, policy)[:: len(policy.speeds)]
    if not candidates:
        return None
    rng = np.random.default_rng(0)
    reference = reference_pushes(shape, rng, policy.references, settings)
    options = RankingOptions(sensor=_sensor(problem.records[-1].poses), noise=problem.noise, run_all=map_in_threads)
    try:
        return rank_pushes(fit.posterior, candidates, reference=reference, rng=rng, options=options).best
    except InputError:  # no reference push moves the object
        return None


def _candidates(shape: ObjectShape, pose: Float64Array, settings: PushSettings, policy: NextPushPolicy) -> list[PlannedPush]:
    """Safe pushes at several speeds; none where there is no safe one at one of them."""
    rng = np.random.default_rng(0)
    speeds = [min(speed, settings.max_speed) for speed in policy.speeds]
    each = policy.candidates // len(speeds)
    try:
        # With the ramps of a real arm: lag and latency differ by these only.
        return [
            push
            for speed in speeds
            for push in candidate_pushes(
                shape, pose, rng, each, replace(settings, speed_range=(speed, speed)), acceleration=PUSH_ACCELERATION
            )
        ]
    except PlanningError:
        return []


@dataclass(frozen=True, slots=True)
class _Predictor:
    """What predictions of a fit need, computed once."""

    mechanics: Mechanics
    covariance: Float64Array
    settings: SimulationSettings
    order: int
    """Number of pushes made before."""

    @classmethod
    def of(cls, fit: Fit) -> _Predictor:
        return cls(fit.mechanics, fit.covariance, fit.problem.settings, len(fit.problem.records))


_Outcome = tuple[Float64Array, Float64Array]
"""What an explanation predicts that the sensor observes of a push: poses in standard deviations of the observation, shape (3 n_frames,),
and their covariance, from the posterior of the fit, the first pose and the discrepancy, shape (3 n_frames, 3 n_frames)."""


def _sensor(poses: PoseTrack) -> PoseSensor:
    """A sensor with the rate and the noise of the observed poses."""
    interval = float(np.median(np.diff(poses.time)))
    return PoseSensor(rate=1.0 / max(interval, 1e-3), covariance=np.mean(poses.covariance, axis=0))


def _outcomes(
    models: Mapping[str, _Predictor], push: PlannedPush, sensor: PoseSensor, noise: NoiseModel | None, first_variance: Float64Array
) -> dict[str, _Outcome | None]:
    """What each explanation predicts of a push, at the frames that would be observed if the first one were true."""
    first = next(iter(models.values()))
    start = true_pose(first.mechanics.effects, push.pose_object_in_table)
    record, _ = imagine_push(first.mechanics, push, start, sensor=sensor, settings=first.settings, order=first.order)
    if record is None:
        return dict.fromkeys(models)
    observation = observe_push(record, noise)
    return {name: _outcome(model, push, observation, first_variance) for name, model in models.items()}


def _outcome(model: _Predictor, push: PlannedPush, observation: Observation, first_variance: Float64Array) -> _Outcome | None:
    mechanics = model.mechanics
    # The reported pose is given; with an error of the camera, the object lies elsewhere.
    start = true_pose(mechanics.effects, push.pose_object_in_table)
    motion = mechanics.simulate(PushScenario(push.pusher, start, observation.time, model.order), settings=model.settings, jacobian=True)
    if motion.status is not SolveStatus.CONVERGED:
        return None
    _, by_pose, by_value = reported_poses(mechanics.effects, start[None])
    derivative = mechanics.derivative.copy()
    derivative[:3] = -np.linalg.solve(by_pose[0], by_value[:, 0].T) @ derivative[len(derivative) - len(by_value) :]
    whitened = np.einsum("fij,fjp->fip", observation.whitening, motion.jacobian).reshape(3 * len(observation.time), -1)
    by_first, rows = whitened[:, :3], whitened @ derivative
    # Of a discrepancy that the frames of the push share, too.
    discrepancy = np.einsum("fij,fjm->fim", observation.whitening, observation.shared).reshape(len(rows), -1)
    covariance = rows @ model.covariance @ rows.T + (by_first * first_variance) @ by_first.T + discrepancy @ discrepancy.T
    return np.einsum("fij,fj->fi", observation.whitening, motion.pose).ravel(), covariance


def _mahalanobis2(a: _Outcome | None, b: _Outcome | None) -> float:
    """Squared Mahalanobis distance of two predictions; 0 where a simulation failed."""
    if a is None or b is None:
        return 0.0
    difference = a[0] - b[0]
    covariance = 0.5 * (a[1] + b[1]) + np.eye(len(difference))
    return float(difference @ np.linalg.solve(covariance, difference))
