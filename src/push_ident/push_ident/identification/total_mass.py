"""Total mass from measured forces: poses carry no information about it.

A force determines the product of total mass M and friction scale: log(F_measured / F_simulated at M = 1) = log M + log(friction scale).
Poses (through inertia) and the prior bound both factors weakly. So a force is one Gaussian measurement of the sum of their logarithms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from push_ident.identification.prior import Prior
from push_ident.identification.problem import FitProblem
from push_ident.identification.result import Estimate, ModelPosterior
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import Float64Array, ObjectModel, SolveStatus

__all__ = ["log_force", "with_measured_forces"]

_IDENTIFIABLE = 0.5
"""The total mass is identified when its posterior standard deviation is below this share of the prior's."""
_MIN_FORCE_STD = 0.05
"""Standard deviation of the logarithm of a force that all pushes share: no force sensor and no friction model is better."""


def with_measured_forces(posterior: ModelPosterior, problem: FitProblem, x: Float64Array, past: Sequence[float] = ()) -> ModelPosterior:
    """Condition a posterior on the wrenches of the pushes; unchanged where there are none.

    Args:
        posterior: from the poses alone.
        problem: pushes that it was fitted to.
        x: unknowns of the problem at the posterior's mean, for the first poses, shape (problem.size,).
        past: `log_force` of pushes that are not in the problem.
    """
    model = posterior.unknowns.model(posterior.z)
    forces = [f for push in range(len(problem.records)) if (f := log_force(model, problem, x, push)) is not None]
    if not forces and not len(past):
        return posterior
    logs = np.array([*past, *forces]) - _log_scale(model, posterior.prior)
    measured = float(np.median(logs))
    # The scale error of the sensor is the same in every push; other errors average out.
    variance = _MIN_FORCE_STD**2 + float(np.var(logs)) / len(logs)
    prior = posterior.prior
    row = np.zeros(len(posterior.z))
    row[posterior.unknowns.slice_of("friction_scale")] = prior.friction_std
    mass_variance = prior.total_mass_std**2
    spread = posterior.covariance @ row
    total = float(row @ spread) + mass_variance + variance
    # Kalman update of (z, log M), independent before.
    z = posterior.z + spread * (measured / total)
    covariance = posterior.covariance - np.outer(spread, spread) / total
    log_mass = mass_variance * measured / total
    log_variance = mass_variance - mass_variance**2 / total
    value = prior.total_mass * float(np.exp(log_mass))
    return replace(
        posterior,
        z=z,
        covariance=covariance,
        total_mass=Estimate(value, value * float(np.sqrt(log_variance))),
        total_mass_identifiable=bool(mass_variance == 0 or log_variance < (_IDENTIFIABLE * prior.total_mass_std) ** 2),
    )


def log_force(model: ObjectModel, problem: FitProblem, x: Float64Array, push: int) -> float | None:
    """Logarithm of the friction of the object over its nominal value, from the wrench of one push.

    That is log(measured over simulated force), median over the time in contact, plus the logarithm of the model's own friction.

    Args:
        model: for the simulated force, of the nominal mass.
        problem, x: for the push and its first pose.
        push: index of the push.

    Returns:
        None where nothing was measured.
    """
    ratio = _force_ratio(model, problem, x, push)
    return None if ratio is None else float(np.log(ratio)) + _log_scale(model, problem.unknowns.prior)


def _log_scale(model: ObjectModel, prior: Prior) -> float:
    """Logarithm of the friction of the whole object over its nominal value."""
    return float(np.log(model.mass @ model.friction / (prior.total_mass * prior.friction)))


def _force_ratio(model: ObjectModel, problem: FitProblem, x: Float64Array, push: int) -> float | None:
    """Measured over simulated force of one push, median over the time in contact; None where nothing was measured."""
    record = problem.records[push]
    if record.wrench is None:
        return None
    motion = simulate(
        model,
        PushScenario(record.pusher, problem.first_pose(x, push), record.pusher.time[-1:], record.order),
        settings=problem.settings,
        effects=problem.unknowns.effects_at(problem.object_unknowns(x)),
    )
    if motion.status is not SolveStatus.CONVERGED:
        return None
    wrench = record.wrench
    simulated = np.column_stack([np.interp(wrench.time, motion.force_time, motion.force[:, axis]) for axis in (0, 1)])
    size2 = np.sum(simulated**2, axis=1)
    steady = size2 > 0.25 * np.median(size2[size2 > 0]) if np.any(size2 > 0) else np.zeros(len(size2), dtype=bool)
    if not np.any(steady):
        return None
    # The median, since at the touch a small error of time makes a large error of force.
    ratio = float(np.median(np.sum(wrench.force[steady] * simulated[steady], axis=1) / size2[steady]))
    return ratio if np.isfinite(ratio) and ratio > 0 else None
