"""The push that would tell apart what these data cannot: the one whose outcome the rivals predict most differently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from push_ident.diagnosis.fits import EffectFit
from push_ident.diagnosis.parallel import side_by_side
from push_ident.errors import PlanningError
from push_ident.identification.next_push import PlannedPush, PoseSensor, candidate_pushes, imagine_push
from push_ident.identification.observation import NoiseModel, Observation, observe_push
from push_ident.identification.parameters import Mechanics
from push_ident.physics.effect_values import reported_poses, true_pose
from push_ident.physics.effects import EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings
from push_ident.pushing.push import PUSH_ACCELERATION, PushSettings
from push_ident.types import Float64Array, PoseTrack, SolveStatus

__all__ = ["NO_EFFECT", "SeparatingPush", "check_without_a_push", "separating_push", "without"]

NO_EFFECT = "no effect"
"""Name of the explanation that nothing is left out."""

_N_CANDIDATES = 120
_SPEEDS = (0.04, 0.12, 0.25)
"""Speeds that candidates are spread over [m/s]: some effects differ by their speed alone."""
_ANYWHERE = np.array([0.01, 0.01, 0.1]) ** 2
"""Variance of the first pose apart from where it is seen [m^2, m^2, rad^2]: a fit may put it anywhere."""

_TELLS = 1.0
"""Squared distance from which a push is worth making: two explanations that no push sets further apart are the same to this cell."""
_SETTLES = 9.0
"""Squared distance of predictions, in units of what would be seen, that is rarely mistaken."""


@dataclass(frozen=True, slots=True)
class SeparatingPush:
    """A push, and how well it would settle what is open."""

    push: PlannedPush
    between: tuple[str, str]
    """The two explanations that it tells apart best of those that are hardest to tell apart."""
    distance2: float
    """Squared distance of their predictions in units of what would be seen."""
    tells_all: bool
    """False where there are explanations among them that no push tells apart."""

    @property
    def aim(self) -> str:
        """What it does, to go on with after "the push that"."""
        first, second = self.between
        if first == NO_EFFECT:
            return f"would show {second} best"
        return f"confirms {second} best" if first == without(second) else f"tells {first} from {second} best"

    @property
    def settles(self) -> bool:
        """Whether one such push can be expected to be enough."""
        return self.tells_all and self.distance2 >= _SETTLES


def without(name: str) -> str:
    """Name of the explanation that an effect that was found is not there."""
    return f"without {name}"


def check_without_a_push(names: Sequence[str]) -> str:
    """What somebody at the cell can do to settle it without a push; empty where nothing is known."""
    return next((EFFECTS[name].check for name in names if EFFECTS[name].check), "")


def separating_push(fits: dict[str, EffectFit], pose: Float64Array, settings: PushSettings) -> SeparatingPush | None:
    """The best of some 120 safe pushes.

    Args:
        fits: explanations to tell apart, at least two, all of one object.
        pose: where the object lies, table frame, shape (3,).
        settings: limits and ranges of pushes.

    Returns:
        None where no push is safe, or none of them would tell anything that noise does not hide.
    """
    rng = np.random.default_rng(0)
    shape = next(iter(fits.values())).parameters.shape
    speeds = [min(speed, settings.max_speed) for speed in _SPEEDS]
    spread = [replace(settings, speed_range=(speed, speed)) for speed in speeds]
    try:
        # Lag and latency differ by the ramps alone.
        candidates = [
            push
            for own in spread
            for push in candidate_pushes(shape, pose, rng, _N_CANDIDATES // len(spread), own, acceleration=PUSH_ACCELERATION)
        ]
    except PlanningError:
        return None
    names = list(fits)
    models = {name: _Predictor.of(fit) for name, fit in fits.items()}
    problem = next(iter(fits.values())).problem
    sensor = _sensor(problem.records[-1].poses)
    outcomes = side_by_side(lambda push: _outcomes(models, push, sensor, problem.noise), candidates)
    pairs = list(combinations(names, 2))
    distances = np.array([[_distance2(seen[a], seen[b]) for a, b in pairs] for seen in outcomes])
    told = np.flatnonzero(np.max(distances, axis=0, initial=0.0) >= _TELLS)
    if not len(told):
        return None
    # What no push tells apart does not count against any.
    hardest = distances[:, told].min(axis=1)
    best = int(np.argmax(hardest))
    pair = pairs[told[int(np.argmin(distances[best, told]))]]
    return SeparatingPush(candidates[best], pair, float(hardest[best]), len(told) == len(pairs))


@dataclass(frozen=True, slots=True)
class _Predictor:
    """What predictions of a fit need, made once."""

    mechanics: Mechanics
    covariance: Float64Array
    settings: SimulationSettings
    order: int
    """Pushes made before."""

    @classmethod
    def of(cls, fit: EffectFit) -> _Predictor:
        return cls(fit.parameters.mechanics(fit.z), fit.covariance, fit.problem.settings, len(fit.problem.records))


@dataclass(frozen=True, slots=True)
class _Outcome:
    """What an explanation expects to be seen of a push."""

    frames: Float64Array
    """Poses in deviations of what is seen, shape (3 n_frames,)."""
    covariance: Float64Array
    """Of them by what the fit does not know, and by where the object lay, shape (3 n_frames, 3 n_frames)."""


def _sensor(poses: PoseTrack) -> PoseSensor:
    """Sees as often and as well as the poses were seen."""
    apart = float(np.median(np.diff(poses.time)))
    return PoseSensor(rate=1.0 / max(apart, 1e-3), covariance=np.mean(poses.covariance, axis=0))


def _outcomes(models: dict[str, _Predictor], push: PlannedPush, sensor: PoseSensor, noise: NoiseModel | None) -> dict[str, _Outcome | None]:
    """What each explanation expects to be seen of a push, at the frames that would be seen if the first one were true."""
    first = next(iter(models.values()))
    start = true_pose(first.mechanics.effects, push.pose_object_in_table)
    record, _ = imagine_push(first.mechanics, push, start, sensor=sensor, settings=first.settings, order=first.order)
    seen = observe_push(record, noise) if record is not None else None
    return {name: _outcome(model, push, seen) if seen is not None else None for name, model in models.items()}


def _outcome(model: _Predictor, push: PlannedPush, seen: Observation) -> _Outcome | None:
    mechanics = model.mechanics
    # The object lies where it is reported: with a camera that is off, elsewhere.
    start = true_pose(mechanics.effects, push.pose_object_in_table)
    motion = mechanics.simulate(PushScenario(push.pusher, start, seen.time, model.order), settings=model.settings, jacobian=True)
    if motion.status is not SolveStatus.CONVERGED:
        return None
    _, by_pose, by_value = reported_poses(mechanics.effects, start[None])
    derivative = mechanics.derivative.copy()
    derivative[:3] = -np.linalg.solve(by_pose[0], by_value[:, 0].T) @ derivative[len(derivative) - len(by_value) :]
    whitened = np.einsum("fij,fjp->fip", seen.whitening, motion.jacobian).reshape(3 * len(seen.time), -1)
    by_first, rows = whitened[:, :3], whitened @ derivative
    covariance = rows @ model.covariance @ rows.T + (by_first * _ANYWHERE) @ by_first.T
    return _Outcome(np.einsum("fij,fj->fi", seen.whitening, motion.pose).ravel(), covariance)


def _distance2(a: _Outcome | None, b: _Outcome | None) -> float:
    """0 where a simulation failed."""
    if a is None or b is None:
        return 0.0
    off = a.frames - b.frames
    return float(off @ np.linalg.solve(0.5 * (a.covariance + b.covariance) + np.eye(len(off)), off))
