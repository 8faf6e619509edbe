"""From push records to maps: one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.budget import Budget, Meter, Progress
from push_ident.identification.map_fit import MapFit, fit_maps
from push_ident.identification.observation import NoiseModel
from push_ident.identification.parameters import MapParameters, Prior
from push_ident.identification.problem import FitProblem
from push_ident.identification.result import Checkpoint, Estimate, Identification, ModelPosterior
from push_ident.identification.solvers import SOLVERS
from push_ident.identification.solvers.gauss_newton import MAX_ITERATIONS, minimise
from push_ident.identification.summary import Summary
from push_ident.identification.total_mass import with_measured_forces
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PushRecord, SolveStatus

__all__ = ["identify", "prior_posterior", "uniform_model"]


def uniform_model(shape: ObjectShape, prior: Prior | None = None) -> ObjectModel:
    """Equal cells with nominal values."""
    parameters = MapParameters(shape, prior or Prior(), maps=False)
    return parameters.model(np.zeros(parameters.size))


def prior_posterior(shape: ObjectShape, prior: Prior | None = None, parameters: MapParameters | None = None) -> ModelPosterior:
    """What is known of an object that was never pushed."""
    prior = prior or Prior()
    parameters = parameters or MapParameters(shape, prior)
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
    budget: Budget | None = None,
    seed: int = 0,
    starts: Sequence[Float64Array] = (),
    past: Summary | None = None,
    effects: Sequence[str] = (),
    max_iterations: int = MAX_ITERATIONS,
    on_progress: Progress | None = None,
) -> Identification:
    """Fit the maps of one object to pushes.

    Args:
        records: pushes of one object. Only the end poses of a push may be known.
        prior: beliefs; nominal values by default.
        method: name of a solver in `SOLVERS`.
        noise: of the observed poses.
        settings: numerics of the simulation.
        budget: limits of the solve; 30 s by default.
        seed: of the solvers that draw at random.
        starts: `starts` of an earlier result of the same method for the first of these pushes.
        past: earlier pushes, summed up; for `gauss_newton` alone.
        effects: names of effects (`physics/effects/`) that are fitted with the maps; for `gauss_newton` alone.
        max_iterations: of `gauss_newton`.
        on_progress: told of every better point.

    Returns:
        The result; look at its `status` before its numbers.

    Raises:
        InputError: no push, pushes of different objects, an unknown method or effect, or effects with a method that fits none.
    """
    if method not in SOLVERS:
        raise InputError(f"There is no method `{method}`; choose one of {', '.join(SOLVERS)}.")
    if not records:
        raise InputError("There is no push to learn from; give at least one push record.")
    if effects and method != "gauss_newton":
        raise InputError(f"`{method}` fits no effects ({', '.join(effects)}); take gauss_newton.")
    prior = prior or Prior()
    shape = records[0].shape
    meter = Meter(budget, on_progress)
    scalar_problem = FitProblem(records, MapParameters(shape, prior, maps=False), noise=noise, settings=settings)
    x_scalar, _, _ = minimise(scalar_problem, np.zeros(scalar_problem.size), max_iterations)
    if method == "gauss_newton":
        meter.count(scalar_problem.meter.n_simulations)
        fit = fit_maps(
            records,
            prior,
            noise=noise,
            settings=settings,
            meter=meter,
            x_scalar=x_scalar,
            warm_starts=starts,
            past=past,
            effects=effects,
            max_iterations=max_iterations,
        )
    else:
        meter.restart()
        fit = _fit_cell_by_cell(records, prior, method, noise, settings, meter, np.random.default_rng(seed), starts)
    posterior, status = fit.posterior, fit.status
    if status is SolveStatus.SIMULATION_FAILED:
        posterior = prior_posterior(shape, prior, MapParameters(shape, prior, effects=effects))
    elif not any(o.touched for o in fit.problem.observations):
        posterior, status = prior_posterior(shape, prior, MapParameters(shape, prior, effects=effects)), SolveStatus.NO_CONTACT
    else:
        posterior = with_measured_forces(posterior, fit.problem, fit.x, past.log_forces.tolist() if past else ())
    return Identification(
        method=method,
        status=status,
        posterior=posterior,
        scalar=scalar_problem.parameters.model(x_scalar[:2]),
        uniform=uniform_model(shape, prior),
        cost=fit.cost,
        misfit=fit.misfit,
        n_simulations=meter.n_simulations,
        time_s=meter.seconds,
        starts=fit.starts,
        history=_checkpoints(fit.problem),
    )


def _fit_cell_by_cell(
    records: Sequence[PushRecord],
    prior: Prior,
    method: str,
    noise: NoiseModel | None,
    settings: SimulationSettings | None,
    meter: Meter,
    rng: np.random.Generator,
    starts: Sequence[Float64Array],
) -> MapFit:
    """The paper's way: every cell an unknown of its own, and no posterior: the deviations stay those of the prior."""
    shape = records[0].shape
    parameters = MapParameters(shape, prior, modes=np.eye(len(shape.cells)))
    problem = FitProblem(records, parameters, noise=noise, settings=settings, meter=meter)
    x0 = np.zeros(problem.size)
    if starts and len(starts[0]) <= problem.size:
        x0[: len(starts[0])] = starts[0]
    x, status = SOLVERS[method](problem, x0, rng)
    meter.stop()
    return MapFit(
        posterior=replace(prior_posterior(shape, prior, parameters), z=x[: parameters.size]),
        status=status,
        problem=problem,
        x=x,
        cost=meter.best.cost if meter.best else np.inf,
        misfit=np.nan,
        starts=(x,),
    )


def _checkpoints(problem: FitProblem) -> tuple[Checkpoint, ...]:
    n_z, model = problem.parameters.size, problem.parameters.model
    return tuple(Checkpoint(s.n_simulations, s.time_s, s.cost, model(s.x[:n_z])) for s in problem.meter.history)
