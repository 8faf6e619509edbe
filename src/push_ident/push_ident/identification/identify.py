"""From push records to maps: one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.budget import Budget, Meter, Progress
from push_ident.identification.evidence import explain
from push_ident.identification.explanation import Explanation
from push_ident.identification.fit import Fit, FitOptions
from push_ident.identification.known_effects import KnownEffect
from push_ident.identification.levenberg_marquardt import minimise_roughly
from push_ident.identification.nuisances import nuisances_of
from push_ident.identification.observation import noise_at_rest
from push_ident.identification.prior import Prior
from push_ident.identification.problem import FitProblem
from push_ident.identification.result import Checkpoint, Identification, ModelPosterior, WarmStart
from push_ident.identification.solver import FitTask, MapFit, Solver
from push_ident.identification.solvers import DEFAULT_SOLVER, solver_of
from push_ident.identification.summary import Summary
from push_ident.identification.total_mass import with_total_mass
from push_ident.identification.unknowns import Unknowns
from push_ident.types import ObjectModel, ObjectShape, PushRecord, SolveStatus

__all__ = ["Earlier", "identify", "uniform_model"]

_SCALARS: Final = "scalars"
"""Name of the start of the fit of equal cells, after those of the solver."""
_WARM_STEPS: Final = 4
"""Of the fit of equal cells after one push more: nothing depends on it then but what equal cells are compared by."""


@dataclass(frozen=True, slots=True)
class Earlier:
    """Results of an earlier identification of the same object by the same solver."""

    warm_starts: Sequence[WarmStart] = ()
    """`Identification.warm_starts`, of a fit to the first of the pushes that are given now."""
    past: Summary | None = None
    """Pushes that are not given now, summed up; used by solvers that can (`Capabilities.takes_past`)."""
    known: Sequence[KnownEffect] = ()
    """What is known of effects beside all these pushes; used by solvers that fit effects."""


def uniform_model(shape: ObjectShape, prior: Prior | None = None) -> ObjectModel:
    """Equal cells with nominal values."""
    unknowns = Unknowns(shape, prior or Prior(), maps=False)
    return unknowns.model(np.zeros(unknowns.size))


def identify(
    records: Sequence[PushRecord],
    prior: Prior | None = None,
    *,
    method: str = DEFAULT_SOLVER,
    effects: Sequence[str] = (),
    options: FitOptions | None = None,
    budget: Budget | None = None,
    earlier: Earlier | None = None,
    on_progress: Progress | None = None,
) -> Identification:
    """Fit the maps of one object to pushes.

    Args:
        records: pushes of one object. The two end poses of a push are enough.
        prior: nominal values and standard deviations; accuracies of camera and force sensor are of the records unless it has them.
        method: name of a solver in `SOLVERS`.
        effects: names of effects (`physics/effects/`) that are fitted with the maps, by solvers that can (`Capabilities.takes_effects`),
            beside those of `nuisances_of`.
        options: noise, numerics, iterations and seed. Errors of poses count as at least as correlated as the frames at rest show.
        budget: limits of the solve; 30 s by default.
        earlier: results to start from.
        on_progress: called with every better point.

    Returns:
        The result; look at its `status` before its numbers.

    Raises:
        InputError: no push, pushes of different objects, an unknown method or effect, or effects with a method that fits none.
    """
    solver = solver_of(method)
    if not records:
        raise InputError("There is no push to learn from; give at least one push record.")
    earlier = earlier or Earlier()
    effects = _fitted(effects, earlier.known, solver)
    prior = _measured(prior or Prior(), records, solver.capabilities.takes_effects and earlier.past is None)
    effects = tuple(dict.fromkeys((*effects, *nuisances_of(records[0].shape, prior)))) if solver.capabilities.takes_effects else ()
    options = _prepared(records, prior, effects, options or FitOptions())
    meter = Meter(budget, on_progress)
    scalar = _fit_scalars(records, prior, options, earlier.warm_starts)
    past = earlier.past if solver.capabilities.takes_past else None
    fit = solver.fit(FitTask(records, prior, options, meter, scalar, effects, earlier.warm_starts, past, earlier.known))
    explanation = explain(fit.posterior, records, settings=options.numerics)
    posterior, status = _checked(fit, explanation, prior, effects, earlier.past)
    return Identification(
        method=method,
        status=status,
        posterior=posterior,
        scalar=scalar.model,
        uniform=uniform_model(records[0].shape, prior),
        cost=fit.cost,
        reduced_chi2=fit.reduced_chi2,
        n_simulations=meter.n_simulations,
        time_s=meter.seconds,
        warm_starts=(*fit.warm_starts, WarmStart(_SCALARS, scalar.x)) if fit.warm_starts else (),
        history=_checkpoints(fit.problem),
        candidates=fit.candidates,
        explanation=explanation,
    )


def _fitted(effects: Sequence[str], known: Sequence[KnownEffect], solver: Solver) -> tuple[str, ...]:
    """Names of effects that somebody wants or knows. Raises InputError where the solver fits none."""
    names = tuple(dict.fromkeys((*effects, *(own.name for own in known))))
    if names and not solver.capabilities.takes_effects:
        raise InputError(f"`{solver.name}` fits no effects ({', '.join(names)}); take {DEFAULT_SOLVER}.")
    return names


def _measured(prior: Prior, records: Sequence[PushRecord], takes_forces: bool) -> Prior:
    """The prior with the accuracies of camera and force sensor. Pushes that are summed up count in the unknowns that they have: no forces
    join them."""
    prior = prior.seen_by(record.poses.camera for record in records)
    return prior.felt_in(records) if takes_forces else prior


def _prepared(records: Sequence[PushRecord], prior: Prior, effects: Sequence[str], options: FitOptions) -> FitOptions:
    """The options with the noise at rest, after one push was simulated: what is compiled then, once on a machine, may take longer than the
    budget of a solve."""
    options = replace(options, noise=noise_at_rest(records, options.noise))
    for compiled in dict.fromkeys(((), tuple(effects))):  # pushes with effects have kernels of their own
        unknowns = Unknowns(records[0].shape, prior, maps=False, effects=compiled)
        problem = FitProblem(records[:1], unknowns, noise=options.noise, settings=options.numerics)
        problem.evaluate(np.zeros(problem.size))
    return options


def _fit_scalars(records: Sequence[PushRecord], prior: Prior, options: FitOptions, warm_starts: Sequence[WarmStart]) -> Fit:
    """Equal cells with the friction scale and the pusher friction fitted.

    Roughly: they explain pushes of an uneven object badly, at a cost with many kinks. Fits of maps start from
    them, and a candidate fits them to the end where that decides something.
    """
    unknowns = Unknowns(records[0].shape, prior, maps=False)
    problem = FitProblem(records, unknowns, noise=options.noise, settings=options.numerics)
    warm = next((start.x for start in warm_starts if start.name == _SCALARS), np.empty(0))
    start, steps = problem.continued(np.zeros(problem.size), warm), _WARM_STEPS if len(warm) else options.max_iterations
    return Fit(problem, *minimise_roughly(problem, start, steps))


def _checked(
    fit: MapFit, explanation: Explanation, prior: Prior, effects: Sequence[str], past: Summary | None
) -> tuple[ModelPosterior, SolveStatus]:
    """The posterior with its total mass; the prior where the pushes cannot be simulated, explained, or never touch the object."""
    problem, status = fit.problem, fit.status
    if status is not SolveStatus.SIMULATION_FAILED and not any(o.touched for o in problem.observations):
        status = SolveStatus.NO_CONTACT
    status = explanation.judged(status)
    if status.is_failure:
        same = prior.on_feet(past.feet) if past else prior  # pushes that are summed up count in these unknowns
        return ModelPosterior.of_prior(Unknowns(problem.unknowns.shape, same, effects=effects)), status
    return with_total_mass(fit.posterior), status


def _checkpoints(problem: FitProblem) -> tuple[Checkpoint, ...]:
    checkpoints = []
    for sample in problem.meter.history:
        unknowns = sample.unknowns or problem.unknowns
        checkpoints.append(Checkpoint(sample.n_simulations, sample.time_s, sample.cost, unknowns.model(sample.x[: unknowns.size])))
    return tuple(checkpoints)
