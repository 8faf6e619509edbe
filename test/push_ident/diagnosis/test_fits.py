"""Maps fitted together with effects: start, end, and what is left out."""

from __future__ import annotations

from copy import copy

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.fits import fit_base, without_pushes
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.fitting.budget import Meter
from push_ident.identification.fitting.levenberg_marquardt import minimise
from push_ident.types import SolveStatus


def test_no_clock_decides_how_far_a_diagnosis_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine, or one that compiles its kernels first, takes longer and reports the same."""
    before = fit_base(simulated_pushes(4, 1), DiagnosisSettings())
    monkeypatch.setattr(Meter, "seconds", property(lambda meter: 1e6))
    after = fit_base(simulated_pushes(4, 1), DiagnosisSettings())
    assert after.status is before.status and np.array_equal(after.x, before.x)
    assert not before.problem.meter.spent and not before.problem.without([0]).meter.spent


def test_pushes_simulated_in_parallel_give_the_same_fit_to_the_last_bit() -> None:
    parallel = fit_base(simulated_pushes(5, 1), DiagnosisSettings()).problem
    serial = copy(parallel)
    serial.run_all = map
    x = 0.1 * np.random.default_rng(0).normal(size=parallel.size)
    for own in (lambda problem: problem.evaluate(x).hessian, lambda problem: problem.step_errors(x), lambda problem: problem.cost(x)):
        np.testing.assert_array_equal(own(parallel), own(serial))


def test_fit_that_cannot_reach_the_target_ends_early() -> None:
    problem = fit_base(simulated_pushes(4, 1), DiagnosisSettings()).problem
    _, full, status = minimise(problem.of(problem.unknowns), np.zeros(problem.size))
    hopeless = problem.of(problem.unknowns)
    _, early, given_up = minimise(hopeless, np.zeros(problem.size), needed_cost=full.cost - 1e3)
    assert (status, given_up) == (SolveStatus.CONVERGED, SolveStatus.OUT_OF_REACH)
    assert early.cost > full.cost
    # A target that the full solve reaches is within reach at every step.
    assert minimise(problem.of(problem.unknowns), np.zeros(problem.size), needed_cost=full.cost + 1.0)[1].cost == full.cost


def test_push_held_out_is_not_part_of_the_fit() -> None:
    base = fit_base(simulated_pushes(5, 1), DiagnosisSettings())
    rest = without_pushes(base, [2])
    assert [record.source for record in rest.problem.records] == ["push 0", "push 1", "push 3", "push 4"]
    # As good as a fit that starts from nothing.
    assert rest.end.cost < minimise(rest.problem, np.zeros(rest.problem.size))[1].cost + 0.5
