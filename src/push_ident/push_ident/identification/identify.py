"""From push records to maps: one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.checking.records import RecordCheck, check_records
from push_ident.errors import InputError
from push_ident.identification.fitting.budget import Budget, Meter, Progress
from push_ident.identification.fitting.fit import Fit, FitOptions
from push_ident.identification.fitting.levenberg_marquardt import minimise_roughly
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.fitting.solver import FitTask, Solver
from push_ident.identification.fitting.summary import Summary
from push_ident.identification.observing.observation import noise_at_rest
from push_ident.identification.results.explanation import explain
from push_ident.identification.results.known_effects import KnownEffect
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.results.result import Checkpoint, Identification, WarmStart
from push_ident.identification.solvers import DEFAULT_SOLVER, solver_of
from push_ident.identification.unknowns.mechanics import model_at
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec, nuisance_effects
from push_ident.types import PushRecord

_SCALARS: Final = "scalars"
"""Name of the start of the fit of equal cells, after those of the solver."""


@dataclass(frozen=True, slots=True)
class Earlier:
    """Results of an earlier identification of the same object by the same solver."""

    warm_starts: Sequence[WarmStart] = ()
    """`Identification.warm_starts`, of a fit to the first of the pushes that are given now."""
    past: Summary | None = None
    """Pushes that are not given now, summed up; used by solvers that can (`Capabilities.takes_past`)."""
    known: Sequence[KnownEffect] = ()
    """What is known of effects beside all these pushes; used by solvers that fit effects."""


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
        prior: of the object; accuracies of camera and force sensor are of the records unless it has them.
        method: name of a solver in `SOLVERS`.
        effects: names of effects that are fitted with the maps beside `nuisance_effects`, by solvers that can (`Capabilities`).
        options: noise, numerics, iterations and seed. Errors of poses count as at least as correlated as the frames at rest show.
        budget: limits of the solve; 30 s by default.
        earlier: results to start from.
        on_progress: called with every better point.

    Returns:
        The result; look at its `status` and `warnings` before its numbers: a fit can hide errors of the pushes in its maps.

    Raises:
        InputError: no push, pushes of different objects, an unknown method or effect, or effects with a method that fits none.
    """
    checked, solver, earlier = _checked(records), solver_of(method), earlier or Earlier()
    records = checked.records
    unknowns, options = _prepared(records, prior or Prior(), effects, solver, earlier, options or FitOptions())
    meter, scalars = Meter(budget, on_progress), unknowns.equal_cells().with_effects(()).as_traced()
    # Roughly: equal cells explain an uneven object badly, at a cost with many kinks. A candidate fits them to the end where it decides.
    problem = FitProblem(records, scalars, noise=options.noise, settings=options.numerics)
    warm = next((start.x for start in earlier.warm_starts if start.name == _SCALARS), np.empty(0))
    steps = 4 if len(warm) else options.max_iterations  # after one push more, only the evidence of equal cells depends on it
    scalar = Fit(problem, *minimise_roughly(problem, problem.continued(np.zeros(problem.size), warm), steps))
    past = earlier.past if solver.capabilities.takes_past else None
    fit = solver.fit(FitTask(records, unknowns, options, meter, scalar, earlier.warm_starts, past, earlier.known))
    explanation = explain(fit.posterior, records, settings=options.numerics)
    status = explanation.judged(fit.status, any(observed.touched for observed in fit.problem.observations))
    # Pushes that are summed up count in these unknowns.
    unknowns = unknowns if past is None else replace(unknowns, prior=unknowns.prior.on_feet(past.feet))
    return Identification(
        method=method,
        status=status,
        posterior=ModelPosterior.of_prior(unknowns) if status.is_failure else fit.posterior,
        scalar=model_at(scalars, scalar.z),
        uniform=model_at(scalars, np.zeros(scalars.size)),
        cost=fit.cost,
        reduced_chi2=fit.reduced_chi2,
        n_simulations=meter.n_simulations,
        time_s=meter.seconds,
        warm_starts=(*fit.warm_starts, WarmStart(_SCALARS, scalar.x)) if fit.warm_starts else (),
        history=_checkpoints(fit.problem),
        candidates=fit.candidates,
        explanation=explanation,
        checked=checked,
    )


def _checked(records: Sequence[PushRecord]) -> RecordCheck:
    if not records:
        raise InputError("There is no push to learn from; give at least one push record.")
    return check_records(records)


def _prepared(
    records: Sequence[PushRecord], prior: Prior, effects: Sequence[str], solver: Solver, earlier: Earlier, options: FitOptions
) -> tuple[UnknownsSpec, FitOptions]:
    """What is fitted of the object, and the options with the noise at rest, after a push was simulated.

    What is compiled then, once on a machine, may take longer than the budget of a solve.
    """
    unknowns = _unknowns_of(records, prior, effects, solver, earlier)
    equal = unknowns.equal_cells()
    without_effects = equal.with_effects(()).as_traced()
    options = replace(options, noise=noise_at_rest(records, options.noise))
    for spec in (without_effects, equal) if equal.effects.names else (equal,):  # pushes with effects have kernels of their own
        problem = FitProblem(records[:1], spec, noise=options.noise, settings=options.numerics)
        problem.evaluate(np.zeros(problem.size))
    return unknowns, options


def _unknowns_of(records: Sequence[PushRecord], prior: Prior, effects: Sequence[str], solver: Solver, earlier: Earlier) -> UnknownsSpec:
    """What is fitted of the object, with the accuracies of camera and force sensor.

    Raises InputError where the solver fits no effects, and somebody wants or knows some.
    """
    shape, can = records[0].shape, solver.capabilities
    names = tuple(dict.fromkeys((*effects, *(effect.name for effect in earlier.known))))
    if names and not can.takes_effects:
        raise InputError(f"`{solver.name}` fits no effects ({', '.join(names)}); take {DEFAULT_SOLVER}.")
    prior = prior.with_camera_accuracy(record.poses.camera for record in records)
    # Pushes that are summed up count in the unknowns that they have: no forces join them.
    if can.takes_effects and earlier.past is None:
        prior = prior.with_force_offset(records)
    if can.cell_by_cell:
        return UnknownsSpec.of(shape, prior, maps=False).cell_by_cell()
    modes, names = earlier.past.modes if earlier.past else None, tuple(dict.fromkeys((*names, *nuisance_effects(shape, prior))))
    unknowns = UnknownsSpec.of(shape, prior, modes=modes, effects=names, outline=can.takes_effects)
    # What is summed up of pushes before there was an outline among the unknowns has none.
    is_as_before = earlier.past is None or len(earlier.past.cost.point) == unknowns.size
    return unknowns if is_as_before else unknowns.as_traced()


def _checkpoints(problem: FitProblem) -> tuple[Checkpoint, ...]:
    checkpoints = []
    for sample in problem.meter.history:
        unknowns = sample.unknowns or problem.unknowns
        checkpoints.append(Checkpoint(sample.n_simulations, sample.time_s, sample.cost, model_at(unknowns, sample.x[: unknowns.size])))
    return tuple(checkpoints)
