"""From push records to maps: one call."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.gauss_newton import gauss_newton
from push_ident.identification.observation import NoiseModel
from push_ident.identification.parameters import MapParameters, Prior
from push_ident.identification.problem import Evaluation, FitProblem
from push_ident.identification.result import Estimate, Identification, ModelPosterior
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PushRecord, SolveStatus

__all__ = ["SOLVERS", "identify", "prior_posterior", "uniform_model"]

Solver = Callable[..., tuple[Float64Array, Evaluation, SolveStatus]]
SOLVERS: dict[str, Solver] = {"gauss_newton": gauss_newton}
"""By name; each takes (problem, x0, max_iterations=..., on_iteration=...)."""

_IDENTIFIABLE = 0.5  # total mass is identified when the data leave less than this share of the prior's deviation
_MIN_FORCE_STD = 0.05  # of the logarithm: no force sensor and no friction model is better over a push


def uniform_model(shape: ObjectShape, prior: Prior | None = None) -> ObjectModel:
    """Equal cells with nominal values."""
    parameters = MapParameters(shape, prior or Prior(), maps=False)
    return parameters.model(np.zeros(parameters.size))


def prior_posterior(shape: ObjectShape, prior: Prior | None = None) -> ModelPosterior:
    """What is known of an object that was never pushed."""
    prior = prior or Prior()
    parameters = MapParameters(shape, prior)
    return ModelPosterior(
        parameters=parameters,
        z=np.zeros(parameters.size),
        covariance=np.eye(parameters.size),
        total_mass=Estimate(prior.total_mass, prior.total_mass * prior.total_mass_std),
        total_mass_identifiable=prior.total_mass_std == 0,
    )


def identify(
    records: Sequence[PushRecord],
    prior: Prior | None = None,
    *,
    method: str = "gauss_newton",
    noise: NoiseModel | None = None,
    settings: SimulationSettings | None = None,
    max_iterations: int = 60,
    warm_start: Float64Array | None = None,
    on_iteration: Callable[[int, float], None] | None = None,
) -> Identification:
    """Fit the maps of one object to pushes.

    Args:
        records: pushes of one object. Only the end poses of a push may be known.
        prior: beliefs; nominal values by default.
        method: name of a solver in `SOLVERS`.
        noise: of the observed poses.
        settings: numerics of the simulation.
        max_iterations: of the solver.
        warm_start: `x` of an earlier result; a different number of pushes is filled up with zeros.
        on_iteration: told the number of the iteration and the cost.

    Returns:
        The result; look at its `status` before its numbers.

    Raises:
        InputError: no push, pushes of different objects, or an unknown method.
    """
    if method not in SOLVERS:
        raise InputError(f"There is no method `{method}`; choose one of {', '.join(SOLVERS)}.")
    prior = prior or Prior()
    started = time.perf_counter()
    if not records:
        raise InputError("There is no push to learn from; give at least one push record.")
    shape = records[0].shape
    scalar_problem = FitProblem(records, MapParameters(shape, prior, maps=False), noise=noise, settings=settings)
    x_scalar, _, _ = gauss_newton(scalar_problem, np.zeros(scalar_problem.size), max_iterations=max_iterations)
    scalar = scalar_problem.parameters.model(x_scalar[:2])

    problem = FitProblem(records, MapParameters(shape, prior), noise=noise, settings=settings)
    x0 = np.zeros(problem.size)
    if warm_start is not None and len(warm_start) >= problem.parameters.size:
        shared = min(len(warm_start), problem.size)
        x0[:shared] = warm_start[:shared]
    else:
        # The maps start flat, at the scales and first poses that fit best without them.
        x0[problem.parameters.size - 2 :] = x_scalar
    x, end, status = SOLVERS[method](problem, x0, max_iterations=max_iterations, on_iteration=on_iteration)
    if not any(o.touched for o in problem.observations):
        status = SolveStatus.NO_CONTACT
    if status is SolveStatus.SIMULATION_FAILED:
        posterior = prior_posterior(shape, prior)
    else:
        covariance = np.linalg.inv(end.hessian)
        n_z = problem.parameters.size
        posterior = _with_total_mass(
            ModelPosterior(
                parameters=problem.parameters,
                z=x[:n_z],
                covariance=0.5 * (covariance + covariance.T)[:n_z, :n_z],
                total_mass=Estimate(prior.total_mass, prior.total_mass * prior.total_mass_std),
                total_mass_identifiable=prior.total_mass_std == 0,
            ),
            problem,
            x,
            settings,
        )
    return Identification(
        method=method,
        status=status,
        posterior=posterior,
        scalar=scalar,
        uniform=uniform_model(shape, prior),
        cost=end.cost,
        n_simulations=problem.n_simulations + scalar_problem.n_simulations,
        time_s=time.perf_counter() - started,
        x=x,
    )


def _with_total_mass(
    posterior: ModelPosterior, problem: FitProblem, x: Float64Array, settings: SimulationSettings | None
) -> ModelPosterior:
    """Use measured forces.

    A force tells the product of total mass M and friction scale: log(F_measured / F_simulated at M = 1) = log M + log(friction scale).
    Poses tell the friction scale a little (through inertia), the prior tells both a little: one Gaussian measurement of their sum.
    """
    ratios = [
        r
        for push in range(len(problem.records))
        if (r := _force_ratio(posterior.parameters.model(posterior.z), problem, x, push, settings))
    ]
    if not ratios:
        return posterior
    logs = np.log(ratios)
    measured = float(np.median(logs))
    variance = (_MIN_FORCE_STD**2 + float(np.var(logs))) / len(logs)
    prior = posterior.prior
    row = posterior.friction_force_row
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


def _force_ratio(model: ObjectModel, problem: FitProblem, x: Float64Array, push: int, settings: SimulationSettings | None) -> float | None:
    """Measured over simulated force of one push, least squares over the time in contact; None where nothing was measured."""
    record = problem.records[push]
    if record.wrench is None:
        return None
    motion = simulate(model, record.pusher, problem.first_pose(x, push), record.pusher.time[-1:], settings=settings)
    if motion.status is not SolveStatus.CONVERGED:
        return None
    wrench = record.wrench
    simulated = np.column_stack([np.interp(wrench.time, motion.force_time, motion.force[:, axis]) for axis in (0, 1)])
    # Only the steady part: at the touch and at the stop a small error of time makes a large error of force.
    size = np.linalg.norm(simulated, axis=1)
    steady = size > 0.5 * np.quantile(size[size > 0], 0.5) if np.any(size > 0) else np.zeros(len(size), dtype=bool)
    if not np.any(steady):
        return None
    ratio = float(np.sum(wrench.force[steady] * simulated[steady]) / np.sum(simulated[steady] ** 2))
    return ratio if np.isfinite(ratio) and ratio > 0 else None
