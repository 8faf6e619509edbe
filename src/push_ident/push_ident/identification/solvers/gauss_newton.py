"""Gauss-Newton on smooth maps or few feet, whatever the evidence prefers: the default solver, and the one with a posterior."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from math import factorial, log
from typing import ClassVar, Final

import numpy as np
from scipy.special import chdtri, softmax

from push_ident.identification.fitting.budget import Meter
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.levenberg_marquardt import FINE, minimise, minimise_roughly
from push_ident.identification.fitting.map_prior import STARTS, EvidenceFit, fit_by_evidence
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.fitting.solver import Capabilities, FitTask, FrameFit, FrameTask, MapFit, Solver, WarmStart
from push_ident.identification.observing.observation import UNCHECKED, NoiseModel
from push_ident.identification.results.known_effects import effects_cost
from push_ident.identification.results.posterior import ModelPosterior, with_total_mass
from push_ident.identification.results.result import Candidate
from push_ident.identification.unknowns.mechanics import foot_position_unknowns, model_at
from push_ident.identification.unknowns.prior import GIVEN_STD, MapPrior
from push_ident.identification.unknowns.quadratic import Quadratic
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import Float64Array, ObjectModel, SolveStatus

_POOR_FIT: Final = 4.0
"""Reduced chi-square above which the pushes contradict each other or the model: residuals are then twice the stated noise."""
_LEAST_WEIGHT: Final = 1.0 / 64.0
"""Weight below which a kind of support is left out [1]: half a model of the 32 that a prediction draws."""
_NEGLIGIBLE: Final = 7.0
"""Difference of log evidence [nat], odds of 1100 to 1: candidates so far below the best are not fitted to the end."""
_SQUARES: Final = chdtri(3.0, (np.arange(1000) + 0.5) / 1000)
"""Quantiles of the squared size of a normal residual of a pose: chi squared with 3 degrees of freedom."""
_WEIGHED: Final = float(np.mean(FitProblem.frame_weight(np.sqrt(_SQUARES / 3.0)[:, None] * np.ones(3)) * _SQUARES)) / 3.0
"""Mean weighted square of normal residuals [1], 0.87: as much smaller is the square of the scale of Student's t, which weighs them, than
the variance that predictions take for a normal one."""
_ADOPTED: Final = "adopted model"
_EQUAL: Final = "equal cells"
_NOMINAL: Final = "equal cells, nominal friction"
_FEET: Final = {2: "two feet", 3: "three feet"}


class GaussNewton(Solver):
    """Fits under several priors, with maps or on feet; see `_posterior`."""

    name: ClassVar[str] = "gauss_newton"
    capabilities: ClassVar[Capabilities] = Capabilities(
        gives_posterior=True, takes_effects=True, takes_past=True, resumes=True, cell_by_cell=False
    )

    def fit(self, task: FitTask) -> MapFit:
        """As `Solver.fit`."""
        task.meter.count(task.scalar.problem.meter.n_simulations)
        candidates = _Candidates(task)
        if task.past is not None and task.past.has_prior:
            candidates.fit_adopted()
        elif task.past is not None and task.past.feet:
            candidates.fit_feet(task.past.feet)
        else:
            candidates.fit_maps()
            candidates.fit_equal_cells()
            if candidates.may_stand_on_feet:
                for number in _FEET:
                    candidates.fit_feet(number)
        fits = candidates.fits
        if not fits:
            return _failed(task)
        best, noise_factor, reduced_chi2 = candidates.best, candidates.noise_factor, candidates.reduced_chi2
        weights = softmax(np.array([entry.log_evidence for entry in fits]))
        status = best.status if candidates.is_complete else SolveStatus.BUDGET_SPENT
        if status in (SolveStatus.CONVERGED, SolveStatus.STALLED) and reduced_chi2 > _POOR_FIT:
            status = SolveStatus.POOR_FIT
        return MapFit(
            status=status,
            problem=best.problem,
            x=best.x,
            cost=best.end.cost,
            reduced_chi2=reduced_chi2,
            warm_starts=tuple(candidates.warm_starts),
            candidates=tuple(_candidate(entry, float(weight)) for entry, weight in zip(fits, weights, strict=True)),
            posterior=_posterior(fits, weights, noise_factor),
        )

    def fit_frame(self, task: FrameTask) -> FrameFit | None:
        """As `Solver.fit_frame`: the posterior of the finished pushes is the prior, and only the push under way is simulated."""
        before, options = task.before, task.options
        past = Quadratic.beyond_unit_normal(before.z, before.covariance)
        problem = FitProblem([task.partial], before.unknowns, noise=options.noise, settings=options.numerics, past=past)
        if not problem.observations[0].touched:
            return None
        start = np.r_[before.z, np.zeros(problem.unknowns_of_push)] if task.latest is None else task.latest
        # It starts from the estimate of the frame before.
        fit = Fit(problem, *minimise(problem, start, 2, refine=False))
        return FrameFit(fit.x, replace(before, z=fit.z, covariance=fit.covariance), fit.status)


SOLVER = GaussNewton()


@dataclass(frozen=True, slots=True)
class _Entry:
    """A candidate with its fit, and what that says of unknowns in the units of the caller's prior."""

    name: str
    unknowns: UnknownsSpec
    log_evidence: float
    prior: MapPrior | None
    fit: Fit
    z: Float64Array
    covariance: Float64Array

    @property
    def feet(self) -> int:
        """Number of feet, 0 for a whole base."""
        return self.unknowns.prior.feet

    @property
    def model(self) -> ObjectModel:
        """At the fit."""
        return model_at(self.unknowns, self.z)


class _Candidates:
    """Fits of the same pushes under different priors."""

    def __init__(self, task: FitTask) -> None:
        self._task = task
        self._unknowns = self._on(task.past.feet) if task.past and task.past.feet else task.unknowns
        self._pushes = task.scalar.problem
        """The pushes with the noise that the fits assume."""
        self._inflation = UNCHECKED
        self.fits: list[_Entry] = []
        """Those whose pushes could be simulated."""
        self.warm_starts: list[WarmStart] = []
        self.is_complete = True
        """Whether no search was ended by the budget."""

    def _on(self, feet: int) -> UnknownsSpec:
        """Unknowns under the caller's prior, of an object on feet."""
        return replace(self._task.unknowns, prior=self._task.unknowns.prior.on_feet(feet))

    @property
    def best(self) -> Fit:
        """The fit of the largest evidence."""
        return max(self.fits, key=lambda entry: entry.log_evidence).fit

    @property
    def may_stand_on_feet(self) -> bool:
        """Two pushes give six numbers, fewer than feet have unknowns; and pushes that are summed up count in the unknowns of maps only."""
        return len(self._task.records) > 2 and self._task.past is None

    @property
    def _needed_evidence(self) -> float:
        """A candidate with less is negligible beside the best so far [nat]."""
        return max(entry.log_evidence for entry in self.fits) - _NEGLIGIBLE if self.fits else -np.inf

    def _problem(self, unknowns: UnknownsSpec, transform: Float64Array, meter: Meter | None = None) -> FitProblem:
        task = self._task
        past = task.past.cost.transformed(transform) if task.past else None
        if task.known and (known := effects_cost(unknowns, task.known)) is not None:
            past = known if past is None else past + known
        return self._pushes.of(unknowns, meter=meter or task.meter, past=past)

    def fit_adopted(self) -> None:
        """On from a model that was adopted: its prior stays."""
        task, unknowns = self._task, self._unknowns
        problem = self._problem(unknowns, np.eye(unknowns.size))
        start = np.zeros(problem.size)
        start[: unknowns.size] = task.past.cost.point if task.past else 0.0
        if warm := _warm_start(task.warm_starts, _ADOPTED, problem.size):
            start[: len(warm.x)] = warm.x
        fit = Fit(problem, *minimise(problem, start, task.options.max_iterations))
        if not np.isfinite(fit.end.cost):
            return
        self.fits.append(_Entry(_ADOPTED, unknowns, fit.log_evidence, None, fit, fit.z, fit.covariance))
        self.warm_starts.append(WarmStart(_ADOPTED, fit.x))

    def fit_equal_cells(self) -> None:
        """Without maps: with the frictions free, and with nominal ones."""
        task, full, equal = self._task, self._unknowns, self._task.unknowns.equal_cells()
        start, full_maps = task.scalar.x, np.arange(full.size)[full.maps]
        for name, prior in ((_EQUAL, equal.prior), (_NOMINAL, replace(equal.prior, friction_std=GIVEN_STD, pusher_friction_std=GIVEN_STD))):
            unknowns = replace(equal, prior=prior)
            transform = np.zeros((full.size, unknowns.size))
            for key, block in unknowns.blocks.items():
                if block.size == full.blocks[key].size:
                    transform[full.slices[key], unknowns.slices[key]] = np.diag(block.std / full.blocks[key].std)
            problem = self._problem(unknowns, transform)
            x0 = task.scalar.problem.layout.moved(start, problem.layout)
            if name == _NOMINAL:
                x0[: unknowns.size] = 0.0
            first = problem.evaluate(x0)
            if not np.isfinite(first.cost):
                continue
            status = task.scalar.status if name == _EQUAL and task.past is None else SolveStatus.MAX_ITERATIONS
            fit = self._fitted_if_needed(Fit(problem, x0, first, status))
            covariance = transform @ fit.covariance @ transform.T
            # Cells that are taken as equal: in units of the caller's prior some 4 % of a cell.
            covariance[full_maps, full_maps] += 0.05**2
            self.fits.append(_Entry(name, full, fit.log_evidence, None, fit, transform @ fit.z, covariance))

    def _fitted_if_needed(self, start: Fit) -> Fit:
        """A rough fit from a start, gone on with to the end only where it is not negligible; a start that has converged is one already."""
        problem, rough, steps = start.problem, start, self._task.options.max_iterations
        if start.status is not SolveStatus.CONVERGED:
            rough = Fit(problem, *minimise_roughly(problem, start.x, steps, start=start.end, needed_cost=self._needed_cost(start)))
        if rough.log_evidence < self._needed_evidence:
            return replace(rough, status=SolveStatus.OUT_OF_REACH)
        return Fit(problem, *minimise(problem, rough.x, steps, tolerance=FINE, start=rough.end, needed_cost=self._needed_cost(rough)))

    def _needed_cost(self, start: Fit) -> float:
        """Cost above which a fit from a start is negligible, as far as the curvature at the start is that at the end.

        It may lie above the cost at the start: with shorter time steps the cost of a good fit may rise.
        """
        return start.end.cost + start.log_evidence - self._needed_evidence

    def fit_maps(self, noise_rounds: int = 3) -> None:
        """With maps whose prior the pushes set, from each start; where nothing else shows the noise of the poses, they set it too."""
        self._set_inflation(1.0)
        for remaining in reversed(range(noise_rounds)):
            self.fits, self.warm_starts, earlier = [], [], self.warm_starts or self._task.warm_starts
            for candidate in self._maps_from_all_starts(earlier):
                if candidate is not None:
                    self._keep_maps(candidate)
            if remaining == 0 or not self.fits or not self._noise_is_open or not self._set_inflation(self._expected_inflation):
                break

    def _maps_from_all_starts(self, warm_starts: Sequence[WarmStart]) -> list[EvidenceFit | None]:
        """A fit from each start: they know nothing of each other, and run beside each other where the task has threads for it.

        A budget of simulations ends the second fit by what the first one used: then one runs after the other.
        """
        meter, n_threads = self._task.meter, self._task.options.threads
        if n_threads < 2 or meter.budget.max_simulations is not None:
            return [self._maps_from(name, warm_starts, meter) for name in STARTS]
        branches = [meter.branch() for _ in STARTS]
        with ThreadPoolExecutor(min(n_threads, len(STARTS))) as pool:
            candidates = list(pool.map(self._maps_from, STARTS, repeat(warm_starts), branches))
        for branch, fit in zip(branches, candidates, strict=True):
            meter.join(branch)
            if fit is not None:
                fit.fit.problem.meter = meter
        return candidates

    def _maps_from(self, name: str, warm_starts: Sequence[WarmStart], meter: Meter) -> EvidenceFit | None:
        unknowns = self._unknowns
        start, prior = self._flat(unknowns), STARTS[name]
        warm = _warm_start(warm_starts, name, len(start))
        if warm is not None and warm.prior is not None:
            start[: len(warm.x)], prior = warm.x, warm.prior
        return fit_by_evidence(name, unknowns, partial(self._problem, meter=meter), prior, start, self._task.options.max_iterations)

    def _keep_maps(self, candidate: EvidenceFit) -> None:
        task, unknowns, fit, name = self._task, self._unknowns, candidate.fit, candidate.name
        self.is_complete &= candidate.is_complete or not task.meter.spent
        self.fits.append(_Entry(name, unknowns, candidate.log_evidence, candidate.prior, fit, candidate.z, candidate.covariance))
        self.warm_starts.append(WarmStart(name, np.concatenate([candidate.z, fit.x[unknowns.size :]]), candidate.prior))

    @property
    def _expected_inflation(self) -> float:
        """Factor on the stated noise that the residuals of the best fit and the prior of the factor make most probable.

        The prior is inverse chi-square about 1 with 4 degrees of freedom: factors of 0.6 and 2.4 are its 90 % interval.
        """
        best, freedom = self.best, 4.0
        weight = best.problem.weigh(best.end.residual)[1]
        squares = self._inflation**2 * float(weight @ np.sum(best.end.residual**2, axis=1)) / _WEIGHED + freedom
        return float(np.sqrt(squares / (best.degrees_of_freedom + freedom)))

    @property
    def noise_factor(self) -> float | None:
        """Factor on the stated noise that the pushes set; None where they do not."""
        return None if self._pushes is self._task.scalar.problem else self._inflation

    @property
    def _noise_is_open(self) -> bool:
        noise = self._task.options.noise or NoiseModel()
        return noise.single_frame_inflation is None and all(o.is_unchecked for o in self._pushes.observations)

    @property
    def reduced_chi2(self) -> float:
        """Of the best fit, relative to the noise that is assumed where the pushes do not set it."""
        return self.best.reduced_chi2 * (self._inflation / UNCHECKED) ** 2

    def _set_inflation(self, inflation: float) -> bool:
        """Assume another factor on the noise of poses that nothing checks; whether it changes a fit, by a tenth and more."""
        if not self._noise_is_open or abs(np.log(inflation / self._inflation)) < 0.1:
            return False
        self._inflation = inflation
        noise = replace(self._task.options.noise or NoiseModel(), single_frame_inflation=inflation)
        first = self._task.scalar.problem
        self._pushes = FitProblem(first.records, first.unknowns, noise=noise, settings=first.settings, steps=first.steps)
        return True

    def fit_feet(self, number: int, n_starts: int = 3) -> None:
        """On feet whose places the pushes set, unless the first steps show that this explains them far worse.

        The cost has more than one minimum: of several starts, the best one after a step is fitted to the end. The best after three steps
        was no better (7 tripods, 2 to 10 pushes).
        """
        name, unknowns = _FEET[number], self._on(number)
        flat = self._flat(unknowns)
        problem = self._problem(unknowns, np.eye(unknowns.size))
        starts = []
        if warm := _warm_start(self._task.warm_starts, name, len(flat)):
            starts.append(flat.copy())
            starts[0][: len(warm.x)] = warm.x
        rng = np.random.default_rng(0)
        for _ in range(0 if warm else n_starts):
            start = flat.copy()
            start[unknowns.slices["foot_positions"]] = foot_position_unknowns(unknowns, self._clusters(number, rng))
            if not any(np.allclose(start, other) for other in starts):
                starts.append(start)
        first = min((Fit(problem, *minimise_roughly(problem, start, 1)) for start in starts), key=lambda fit: fit.end.cost)
        if not np.isfinite(first.end.cost):
            return
        fit = self._fitted_if_needed(first)
        # Any order of the feet is the same object.
        self.fits.append(_Entry(name, unknowns, fit.log_evidence + log(factorial(number)), None, fit, fit.z, fit.covariance))
        self.warm_starts.append(WarmStart(name, fit.x))

    def _clusters(self, number: int, rng: np.random.Generator, n_steps: int = 10) -> Float64Array:
        """Centres of clusters of the load of the best maps so far [m], shape (number, 2), unordered: Lloyd's algorithm."""
        cells = self._task.unknowns.shape.cells.centres
        maps = [entry for entry in self.fits if entry.unknowns is self._unknowns]
        load = np.ones(len(cells))
        if maps:
            model = max(maps, key=lambda entry: entry.log_evidence).model
            load = model.mass * model.friction
        centres = cells[rng.choice(len(cells), number, replace=False, p=load / load.sum())]
        for _ in range(n_steps):
            nearest = np.argmin(np.linalg.norm(cells[:, None] - centres[None], axis=2), axis=1)
            for k in range(number):
                if np.any(nearest == k):
                    centres[k] = np.average(cells[nearest == k], axis=0, weights=load[nearest == k])
        return centres[np.lexsort(centres.T)]

    def _flat(self, unknowns: UnknownsSpec) -> Float64Array:
        """The fit of equal cells in unknowns with maps and first poses."""
        scalar, target = self._task.scalar, self._problem(unknowns, np.eye(unknowns.size)).layout
        return scalar.problem.layout.moved(scalar.x, target)


def _warm_start(earlier: Sequence[WarmStart], name: str, size: int) -> WarmStart | None:
    """Of an earlier fit to the same pushes or the first of them."""
    return next((warm for warm in earlier if warm.name == name and len(warm.x) <= size), None)


def _failed(task: FitTask) -> MapFit:
    prior = ModelPosterior.of_prior(task.unknowns)
    scalar = task.scalar
    return MapFit(prior, SolveStatus.SIMULATION_FAILED, scalar.problem, scalar.x, np.inf, np.nan, tuple(task.warm_starts))


def _candidate(entry: _Entry, weight: float) -> Candidate:
    on_feet = _posterior([entry], np.ones(1), None) if entry.feet else None
    return Candidate(entry.name, entry.log_evidence, entry.prior, weight, on_feet)


def _posterior(fits: Sequence[_Entry], weights: Float64Array, noise_factor: float | None) -> ModelPosterior:
    """A Gaussian for each kind of support (whole base, two feet, three), the heaviest first."""
    kinds: dict[int, list[tuple[float, _Entry]]] = {}
    for weight, entry in zip(weights, fits, strict=True):
        kinds.setdefault(entry.feet, []).append((float(weight), entry))
    heaviest, *others = sorted(kinds.values(), key=lambda of_kind: -_total(of_kind))
    # What a part with less weight would change is below what the drawn models of a prediction resolve.
    alternatives = [(_total(of_kind), _moments(of_kind, noise_factor)) for of_kind in others if _total(of_kind) >= _LEAST_WEIGHT]
    return replace(_moments(heaviest, noise_factor), alternatives=tuple(alternatives))


def _total(of_kind: Sequence[tuple[float, _Entry]]) -> float:
    return sum(weight for weight, _ in of_kind)


def _moments(of_kind: Sequence[tuple[float, _Entry]], noise_factor: float | None) -> ModelPosterior:
    """The Gaussian with the mean and the covariance of a mixture of fits of the same unknowns, with their weights.

    A fit worse than its noise shows that the model lacks something: then nothing is known as well as the curvature suggests, and its
    covariance counts multiplied by the reduced chi-square.
    """
    unknowns, total = of_kind[0][1].unknowns, _total(of_kind)
    mean = np.sum([weight / total * entry.z for weight, entry in of_kind], axis=0)
    covariance = np.zeros((unknowns.size, unknowns.size))
    for weight, entry in of_kind:
        spread = entry.covariance * max(1.0, entry.fit.reduced_chi2) + np.outer(entry.z - mean, entry.z - mean)
        covariance += weight / total * spread
    posterior = replace(ModelPosterior.of_prior(unknowns), z=mean, covariance=0.5 * (covariance + covariance.T))
    return replace(with_total_mass(posterior), pose_noise_factor=noise_factor)
