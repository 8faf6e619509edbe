"""The push that would tell apart what these data cannot: the one whose outcome the rivals predict most differently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.diagnosis.fits import EffectFit
from push_ident.diagnosis.parallel import side_by_side
from push_ident.errors import PlanningError
from push_ident.identification.next_push import PlannedPush, candidate_pushes
from push_ident.identification.parameters import Mechanics
from push_ident.physics.effect_values import seen_poses, true_pose
from push_ident.physics.simulation import SimulationSettings
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, SolveStatus

__all__ = ["SeparatingPush", "check_without_a_push", "separating_push"]

_N_CANDIDATES = 120
_SPEEDS = (0.04, 0.12, 0.25)
"""Speeds that candidates are spread over [m/s]: some effects differ by their speed alone."""
_N_FRAMES = 12
_POSE = np.array([1e-3, 1e-3, np.radians(0.5)])
"""Deviation of an observed pose that is expected [m, m, rad]."""

_SETTLES = 9.0
"""Squared distance of predictions, in units of what would be seen, that is rarely mistaken."""

_CHECKS = {
    "table_tilt": "Put a spirit level on the table.",
    "tether": "Disconnect every cable and hose of the object and push again.",
    "moving_contents": "Shake the object and listen; wait ten seconds and repeat a push.",
    "push_height": "Repeat a push with the tool 20 mm lower.",
    "pusher_friction": "See that the tip of the pusher does not turn; tape over it with something of known friction.",
    "tool_offset": "Touch a mark of known position with the tool.",
    "camera_translation": "Look at a mark of known position with the camera.",
    "camera_rotation": "Look at two marks of known positions with the camera.",
    "camera_scale": "Look at two marks of known distance with the camera.",
    "outline_error": "Measure the object with a calliper.",
    "pusher_lag": "Compare the commanded with the measured path of the tool in a fast move in free air.",
    "pusher_speed_scale": "Measure the length of a long move of the tool with a ruler.",
    "pose_latency": "Tap the object with the tool and compare the stamps of the tool and of the first moved pose.",
    "table_anisotropy": "Turn the object by 90 degrees and repeat a push; or lay a sheet of glass on the table.",
    "base_anisotropy": "Look at the underside of the object for a grain.",
    "position_dependent_friction": "Clean the table and repeat two pushes at places far apart.",
    "speed_dependent_friction": "See that there is no film of oil; repeat a push at a quarter of its speed.",
    "stribeck_friction": "Repeat a push at 10 mm/s.",
    "restitution": "Film an impact at a high frame rate.",
    "wear": "Repeat the first push last.",
}


@dataclass(frozen=True, slots=True)
class SeparatingPush:
    """A push, and how well it would settle what is open."""

    push: PlannedPush
    between: tuple[str, str]
    """The two explanations that it tells apart best of those that are hardest to tell apart."""
    distance2: float
    """Squared distance of their predictions in units of what would be seen."""

    @property
    def settles(self) -> bool:
        """Whether one such push can be expected to be enough."""
        return self.distance2 >= _SETTLES


def check_without_a_push(names: Sequence[str]) -> str:
    """What somebody at the cell can do to settle it without a push; empty where nothing is known."""
    return next((_CHECKS[name] for name in names if name in _CHECKS), "")


def separating_push(fits: dict[str, EffectFit], pose: Float64Array, settings: PushSettings) -> SeparatingPush | None:
    """The best of some 120 safe pushes.

    Args:
        fits: explanations to tell apart, at least two, all of one object.
        pose: where the object lies, table frame, shape (3,).
        settings: limits and ranges of pushes.

    Returns:
        None where no push is safe, or none would tell anything.
    """
    rng = np.random.default_rng(0)
    shape = next(iter(fits.values())).parameters.shape
    speeds = [min(speed, settings.max_speed) for speed in _SPEEDS]
    spread = [replace(settings, speed_range=(speed, speed)) for speed in speeds]
    try:
        candidates = [push for own in spread for push in candidate_pushes(shape, pose, rng, _N_CANDIDATES // len(spread), own)]
    except PlanningError:
        return None
    names = list(fits)
    models = {name: _Predictor.of(fit) for name, fit in fits.items()}
    outcomes = side_by_side(lambda push: {name: _outcome(models[name], push) for name in names}, candidates)
    best: SeparatingPush | None = None
    for push, seen in zip(candidates, outcomes, strict=True):
        pairs = [
            (_distance2(seen[a], seen[b]), (a, b))  # type: ignore[arg-type]
            for i, a in enumerate(names)
            for b in names[i + 1 :]
            if seen[a] is not None and seen[b] is not None
        ]
        if not pairs:
            continue
        hardest, pair = min(pairs)
        if best is None or hardest > best.distance2:
            best = SeparatingPush(push, pair, hardest)
    return best


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


def _outcome(model: _Predictor, push: PlannedPush) -> tuple[Float64Array, Float64Array] | None:
    """Predicted poses, shape (n_frames, 3), and their covariance by the uncertainty of the fit, all frames together."""
    pusher, mechanics = push.pusher, model.mechanics
    time = np.linspace(pusher.time[0], pusher.time[-1], _N_FRAMES)
    # The object lies where it is reported: with a camera that is off, elsewhere.
    start = true_pose(mechanics.effects, push.pose_object_in_table)
    motion = mechanics.simulate(pusher, start, time, settings=model.settings, order=model.order, jacobian=True)
    if motion.status is not SolveStatus.CONVERGED:
        return None
    _, by_pose, by_value = seen_poses(mechanics.effects, start[None])
    derivative = mechanics.derivative.copy()
    derivative[:3] = -np.linalg.solve(by_pose[0], by_value[:, 0].T) @ derivative[len(derivative) - len(by_value) :]
    rows = (motion.jacobian @ derivative).reshape(3 * _N_FRAMES, -1)
    return motion.pose, np.asarray(rows @ model.covariance @ rows.T)


def _distance2(a: tuple[Float64Array, Float64Array], b: tuple[Float64Array, Float64Array]) -> float:
    off = (a[0] - b[0]).ravel()
    noise = np.diag(np.tile(_POSE**2, _N_FRAMES))
    return float(off @ np.linalg.solve(0.5 * (a[1] + b[1]) + noise, off))
