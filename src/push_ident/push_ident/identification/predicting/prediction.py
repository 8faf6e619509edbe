"""Posterior predictive of a push: where the object will be, with its covariance, and the error of a prediction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from push_ident.geometry.cells import cell_displacement, cell_error_std, cell_errors
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.observing.observation import NoiseModel, Observation, observe_push
from push_ident.identification.results.posterior import ModelPosterior, square_root
from push_ident.identification.results.result import Identification
from push_ident.identification.unknowns.mechanics import mechanics_at
from push_ident.physics.accuracy import choose_steps
from push_ident.physics.effect_values import EffectsLike, effect_values, true_pose
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.types import CellGrid, Float64Array, ObjectModel, PushRecord, SolveStatus, short_repr

CHI2_90 = 6.251
"""Chi squared with 3 degrees of freedom is below it with probability 0.9."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted motion of an object under a push."""

    __repr__ = short_repr

    time: Float64Array
    """[s], shape (n_frames,)."""
    pose: Float64Array
    """Table frame, shape (n_frames, 3)."""
    covariance: Float64Array
    """Of each pose, shape (n_frames, 3, 3): posterior of the model, first pose and model discrepancy."""
    cell_error_std: float
    """Expected mean cell error of the last pose, root mean square [m]."""
    status: SolveStatus
    ends: Float64Array = field(default_factory=lambda: np.empty((0, 3)))
    """Last pose under each of the drawn models, shape (n_draws, 3); none where the prediction failed."""
    touched: float = np.nan
    """Share of the drawn models, each with its first pose, under which the pusher touches the object [1]."""


def predict(
    posterior: ModelPosterior,
    scenario: PushScenario,
    *,
    first_covariance: Float64Array | None = None,
    noise: NoiseModel | None = None,
    n_samples: int = 32,
) -> Prediction:
    """Predict the motion of an object at rest: that of the mean model, with the covariance of those of drawn models; look at `status`.

    The pose of the scenario is the first one as it is observed; its covariance has shape (3, 3), by default of 0.5 mm and 0.3 degrees.
    The model discrepancy of the noise, which grows with travel, is added, and the errors of a traced outline are. `n_samples`: models drawn
    from the posterior, each with a first pose.
    """
    unknowns = posterior.unknowns
    noise = (noise or NoiseModel()).with_outline_of(unknowns.shape)
    first = scenario.pose_object_in_table
    if first_covariance is None:
        first_covariance = np.diag([5e-4, 5e-4, 5e-3]) ** 2
    # A motion that switches (left or right of the centre of friction, stick or slip) is no linear function of the model: a few models from
    # the posterior describe it better than the derivative at the mean. The draws are the same for every push, so that the predictions of
    # two pushes can be compared.
    settings = _settings_of(posterior, scenario, first_covariance, noise)
    size = posterior.most_unknowns
    draws = np.random.default_rng(0).normal(size=(n_samples, size + 5))
    first_root, surface_std = square_root(first_covariance), noise.surface_std(unknowns.shape)
    poses, touched = [], []
    for (part, z), of_push in zip(posterior.drawn(draws), draws[:, size:], strict=True):
        drawn = mechanics_at(part.unknowns, z)
        moved = np.zeros(3)
        moved[:2] = surface_std * of_push[3:]
        start = true_pose(drawn.effects, first + first_root @ of_push[:3] - moved)
        motion = drawn.simulate(replace(scenario, pose_object_in_table=start), settings=settings)
        if motion.status is not SolveStatus.SIMULATION_FAILED:
            poses.append(motion.pose + moved)
            touched.append(motion.status is not SolveStatus.NO_CONTACT)
    mean = posterior.mean_mechanics
    centre = mean.simulate(replace(scenario, pose_object_in_table=true_pose(mean.effects, first)), settings=settings)
    if len(poses) < len(draws) // 2 or centre.status is SolveStatus.SIMULATION_FAILED:
        unknown = np.full((len(centre.time), 3, 3), np.nan)
        return Prediction(centre.time, np.full_like(centre.pose, np.nan), unknown, np.nan, SolveStatus.SIMULATION_FAILED)
    covariance = _covariance_of_draws(np.array(poses))
    travel = np.cumsum(np.linalg.norm(np.diff(np.vstack([first, centre.pose])[:, :2], axis=0), axis=1))
    covariance += np.einsum("f,i,ij->fij", travel**2, noise.model_discrepancy**2, np.eye(3))
    error_std = cell_error_std(unknowns.shape.cells, centre.pose[-1], covariance[-1])
    return Prediction(centre.time, centre.pose, covariance, error_std, centre.status, np.array(poses)[:, -1], float(np.mean(touched)))


def _settings_of(
    posterior: ModelPosterior, scenario: PushScenario, first_covariance: Float64Array, noise: NoiseModel
) -> SimulationSettings:
    """Numerics with steps short enough for the last pose of the mean model, to the accuracy of the first pose and of the model."""
    mechanics = posterior.mean_mechanics
    start = true_pose(mechanics.effects, scenario.pose_object_in_table)

    @cache
    def end_pose(numerics: SimulationSettings) -> Float64Array:
        return mechanics.simulate(replace(scenario, pose_object_in_table=start), settings=numerics).pose[-1]

    settings = SimulationSettings()
    travel = float(np.linalg.norm(end_pose(settings)[:2] - start[:2]))
    covariance = first_covariance + noise.floor + np.diag(travel * noise.model_discrepancy if np.isfinite(travel) else np.zeros(3)) ** 2
    # Draws of the model move in other ways than its mean: none longer than the default.
    return choose_steps(end_pose, settings, covariance, scenario.duration, least=0).settings


def _covariance_of_draws(poses: Float64Array) -> Float64Array:
    """Covariance whose 90 % region contains 90 % of the draws, at each frame: shape (n_draws, n_frames, 3) to (n_frames, 3, 3).

    Motions that switch have heavy tails: a few draws then inflate the covariance, and its regions would contain nearly all others.
    """
    deviation = poses - poses.mean(axis=0)
    covariance = np.einsum("sfi,sfj->fij", deviation, deviation) / (len(poses) - 1) + 1e-12 * np.eye(3)
    mahalanobis2 = np.einsum("sfi,fij,sfj->sf", deviation, np.linalg.inv(covariance), deviation)
    return np.asarray(covariance * (np.quantile(mahalanobis2, 0.9, axis=0) / CHI2_90)[:, None, None])


def held_out_errors(
    model: ObjectModel,
    records: Sequence[PushRecord],
    *,
    effects: EffectsLike | None = None,
    settings: SimulationSettings | None = None,
    observed: Sequence[Observation] | None = None,
) -> Float64Array:
    """Cell error at the end of each push [m], shape (n_records,); see `prediction_errors`."""
    return prediction_errors(model, records, effects=effects, settings=settings, observed=observed).at_end


@dataclass(frozen=True, slots=True)
class PredictionErrors:
    """Of some pushes; NaN where the simulation failed."""

    at_end: Float64Array
    """Cell error at the end of each push [m], shape (n,)."""
    over_motion: Float64Array
    """Root mean square of the cell error over all frames but the first [m], shape (n,)."""
    end_displacement: Float64Array
    """Observed minus predicted position at the end, table frame [m], shape (n, 2)."""


def prediction_errors(
    model: ObjectModel,
    records: Sequence[PushRecord],
    *,
    effects: EffectsLike | None = None,
    settings: SimulationSettings | None = None,
    observed: Sequence[Observation] | None = None,
) -> PredictionErrors:
    """Errors of each push, with the object simulated from its observed first pose.

    First and last pose are the means of the frames at rest. `effects` act beside the model; those of measured forces move nothing.
    `observed` are the condensed records, where they are known.
    """
    acting = effect_values(effects).of_poses
    condensed = [observe_push(record) for record in records] if observed is None else observed
    ends, motions, displacements = [], [], []
    for record, push in zip(records, condensed, strict=True):
        scenario = PushScenario(record.pusher, true_pose(acting, push.pose[0]), push.time[1:], record.order)

        @cache
        def poses(numerics: SimulationSettings, scenario: PushScenario = scenario) -> Float64Array:
            return simulate(model, scenario, settings=numerics, effects=acting).pose

        def end_pose(numerics: SimulationSettings, poses: Callable[[SimulationSettings], Float64Array] = poses) -> Float64Array:
            return np.asarray(poses(numerics)[-1])

        chosen = choose_steps(end_pose, settings or SimulationSettings(), push.last_covariance, scenario.duration)
        errors = cell_errors(record.shape.cells, poses(chosen.settings), push.pose[1:])
        displacements.append(push.pose[-1, :2] - end_pose(chosen.settings)[:2])
        ends.append(float(errors[-1]))
        motions.append(float(np.sqrt(np.mean(errors**2))))
    return PredictionErrors(np.array(ends), np.array(motions), np.array(displacements).reshape(-1, 2))


@dataclass(frozen=True, slots=True)
class PushErrors:
    """Cell errors of some pushes, see `held_out_errors`; NaN where a push could not be simulated."""

    pushes: tuple[int, ...]
    """Their numbers, from 0 over all pushes."""
    uniform: Float64Array
    """Of equal cells with nominal values [m], shape (n,)."""
    scalar: Float64Array
    """Of equal cells with fitted scalars [m], shape (n,)."""
    identified: Float64Array
    """[m], shape (n,)"""


def push_errors(result: Identification, records: Sequence[PushRecord], pushes: Sequence[int]) -> PushErrors:
    """Cell errors of some pushes of an object, by their numbers from 0, under equal cells, fitted equal cells and the identified model."""
    chosen = [records[i] for i in pushes]
    observed = [observe_push(record) for record in chosen]
    uniform, scalar = (held_out_errors(m, chosen, observed=observed) for m in (result.uniform, result.scalar))
    identified = held_out_errors(result.model, chosen, effects=result.posterior.effects, observed=observed)
    return PushErrors(tuple(pushes), uniform, scalar, identified)


@dataclass(frozen=True, slots=True)
class Outcome:
    """An end of a push under a part of the drawn models."""

    chance: float
    """[1]"""
    end: Float64Array
    """Last pose, table frame, shape (3,): of the mean model where there is one outcome, else the mean of these models."""


def outcomes_of(cells: CellGrid, prediction: Prediction, *, least_chance: float = 0.1, reach: float = 2.0) -> list[Outcome]:
    """One outcome, or two where the drawn models disagree (the object turns left under some, right under others), the likelier first; none
    where the prediction failed.

    The last poses under the drawn models are cut in two along the direction in which they differ most, where the variance within both
    parts is least (Otsu's threshold, IEEE Trans. SMC 9, 1979). Distances are root mean squares over the cells;
    outcomes that poses cannot distinguish are one. `least_chance`: of an outcome that is reported [1]: a rarer one lies outside the 90 %
    region of the prediction; `reach`: standard deviations about its mean to which an outcome reaches; outcomes that overlap are one.
    """
    ends = prediction.ends
    if len(ends) == 0:
        return []
    # Headings are counted from that of the prediction, so that none wraps.
    ends = np.column_stack([ends[:, :2], prediction.pose[-1, 2] + wrap_angle(ends[:, 2] - prediction.pose[-1, 2])])
    metric = cell_displacement(cells, float(prediction.pose[-1, 2]))
    offset = (ends - ends.mean(axis=0)) @ metric.T
    score = offset @ np.linalg.svd(offset, full_matrices=False)[2][0]
    order = np.argsort(score)
    least = max(1, int(np.ceil(least_chance * len(ends))))
    cuts = range(least, len(ends) - least + 1)
    if not cuts:
        return [Outcome(1.0, prediction.pose[-1])]
    cut = min(cuts, key=lambda n: np.var(score[order[:n]]) * n + np.var(score[order[n:]]) * (len(ends) - n))
    parts = [order[:cut], order[cut:]]
    gap = float(np.mean(score[parts[1]]) - np.mean(score[parts[0]]))
    floor = metric @ NoiseModel().floor @ metric.T
    if gap <= reach * sum(float(np.sqrt(np.var(score[part]) + np.trace(floor))) for part in parts):
        return [Outcome(1.0, prediction.pose[-1])]
    outcomes = [Outcome(len(part) / len(ends), ends[part].mean(axis=0)) for part in parts]
    return sorted(outcomes, key=lambda outcome: -outcome.chance)
