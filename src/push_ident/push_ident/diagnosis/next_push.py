"""The next push: the one that would teach most of the maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from push_ident.diagnosis.policy import NextPushPolicy
from push_ident.errors import InputError, PlanningError
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.predicting.next_push import (
    PlannedPush,
    PoseSensor,
    RankingOptions,
    candidate_pushes,
    rank_pushes,
    reference_pushes,
)  # fmt: skip
from push_ident.pushing.push import PUSH_ACCELERATION, PushSettings
from push_ident.threads import map_in_threads
from push_ident.types import Float64Array, ObjectShape, PoseTrack


def most_informative_push(fit: Fit, pose: Float64Array, settings: PushSettings, policy: NextPushPolicy) -> PlannedPush | None:
    """The push after which the next pushes are expected to be predicted best, by the criterion of an identification.

    `pose`: where the object lies, table frame, shape (3,).

    Returns:
        None where no push is safe, or none would add information.
    """
    shape, problem = fit.unknowns.shape, fit.problem
    candidates = _candidates(shape, pose, settings, policy)
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
        return [
            push
            for speed in speeds
            for push in candidate_pushes(
                shape, pose, rng, each, replace(settings, speed_range=(speed, speed)), acceleration=PUSH_ACCELERATION
            )
        ]
    except PlanningError:
        return []


def _sensor(poses: PoseTrack) -> PoseSensor:
    """A sensor with the rate and the noise of the observed poses."""
    interval = float(np.median(np.diff(poses.time)))
    return PoseSensor(rate=1.0 / max(interval, 1e-3), covariance=np.mean(poses.covariance, axis=0))
