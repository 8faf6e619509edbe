"""All solvers fit the same problem under the same budget."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import hammer, random_records
from push_ident.errors import InputError
from push_ident.identification import solvers
from push_ident.identification.fitting.budget import Budget
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import Earlier, identify
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.result import Identification
from push_ident.identification.solvers import SOLVERS
from push_ident.types import ObjectModel, PushRecord, SolveStatus

QUICK = [name for name in SOLVERS if name != "autograd"]
RECORDS = random_records(hammer(1), 10, 1)
TRAIN, TEST = RECORDS[:2], RECORDS[2:]


def mean_error(model: ObjectModel, records: list[PushRecord]) -> float:
    """Mean cell error at the end of the pushes [m]: no solver minimises it, and no meter sorts by it."""
    return float(np.mean(held_out_errors(model, records)))


@pytest.fixture(scope="module", params=QUICK)
def solved(request: pytest.FixtureRequest) -> Identification:
    """After 600 simulations at most."""
    return identify(TRAIN, method=request.param, budget=Budget(max_simulations=600), options=FitOptions(seed=3))


def test_solver_predicts_its_training_pushes_and_others_better_than_a_uniform_object(solved: Identification) -> None:
    assert mean_error(solved.model, TRAIN) < 0.9 * mean_error(solved.uniform, TRAIN)
    assert mean_error(solved.model, TEST) < mean_error(solved.uniform, TEST)


def test_solver_returns_the_best_point_it_has_visited_within_its_simulations(solved: Identification) -> None:
    # A step of Gauss-Newton or a pass of the fast gradient is finished first, and the fit of the scalars is needed anyway.
    assert solved.n_simulations <= 600 + 100
    best = min(solved.history, key=lambda checkpoint: checkpoint.cost)
    assert solved.cost == best.cost
    if not SOLVERS[solved.method].capabilities.gives_posterior:  # that is a mean over several fits
        assert solved.model.friction == pytest.approx(best.model.friction, rel=1e-6)
        assert solved.model.mass / solved.model.total_mass == pytest.approx(best.model.mass / best.model.total_mass, rel=1e-6)


def test_solver_does_what_its_capabilities_state_and_repeats_itself_from_a_seed(solved: Identification) -> None:
    can, unknowns = SOLVERS[solved.method].capabilities, solved.posterior.unknowns
    assert can.cell_by_cell == np.array_equal(unknowns.modes, np.eye(len(unknowns.shape.cells)))
    assert can.gives_posterior == (not np.array_equal(solved.posterior.covariance, np.eye(unknowns.size)))
    assert can.gives_posterior == bool(np.isfinite(solved.reduced_chi2))
    few = Budget(max_simulations=60)
    one, same, other = (identify(TRAIN, method=solved.method, budget=few, options=FitOptions(seed=seed)) for seed in (3, 3, 4))
    later = identify(TRAIN, method=solved.method, budget=few, options=FitOptions(seed=3), earlier=Earlier(one.warm_starts))
    assert one.status is same.status
    assert np.array_equal(one.model.mass, same.model.mass) and np.array_equal(one.model.friction, same.model.friction)
    is_random = solved.method not in ("gauss_newton", "finite_differences")
    assert is_random != np.array_equal(one.model.friction, other.model.friction)
    # The first point may be of a candidate that was not taken, and is a little worse.
    assert later.history[0].cost <= 1.05 * one.cost if can.resumes else later.history[0].cost == one.history[0].cost
    if not can.takes_effects:
        with pytest.raises(InputError, match="fits no effects"):
            identify(TRAIN, method=solved.method, effects=("table_tilt",))


def test_autograd_learns_through_the_reference_engine() -> None:
    result = identify(TRAIN[:1], method="autograd", budget=Budget(max_simulations=3, max_seconds=60))
    assert result.status is SolveStatus.BUDGET_SPENT
    assert mean_error(result.model, TRAIN[:1]) < 0.9 * mean_error(result.uniform, TRAIN[:1])


def test_a_spent_budget_is_a_status_and_what_is_no_limit_is_refused() -> None:
    for method in ("gauss_newton", "random_search"):
        assert identify(TRAIN, method=method, budget=Budget(max_simulations=4)).status is SolveStatus.BUDGET_SPENT
    with pytest.raises(InputError, match="max_seconds is -1"):
        Budget(max_seconds=-1)


def test_contradictory_pushes_are_a_status_and_widen_the_posterior() -> None:
    def jumping(record: PushRecord) -> PushRecord:
        later = np.arange(len(record.poses.time))[:, None] >= len(record.poses.time) // 2
        return replace(record, poses=replace(record.poses, pose=record.poses.pose + later * [0.05, -0.05, 1.0]))

    consistent, contradictory = identify(TRAIN), identify([*TRAIN, *map(jumping, TRAIN)])
    assert consistent.status is SolveStatus.CONVERGED and contradictory.status is SolveStatus.POOR_FIT
    assert contradictory.posterior.pusher_friction.std > consistent.posterior.pusher_friction.std


def test_solver_is_one_file_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "stays_put.py").write_text(
        """
from push_ident.identification.fitting.solver import CellByCellSolver
from push_ident.types import SolveStatus

class StaysPut(CellByCellSolver):
    name = "stays_put"

    def solve(self, problem, x0, rng):
        problem.meter.offer(x0, problem.cost(x0))
        return x0, SolveStatus.CONVERGED

SOLVER = StaysPut()
"""
    )
    monkeypatch.setattr(solvers, "__path__", [*solvers.__path__, str(tmp_path)])
    monkeypatch.setitem(SOLVERS, "stays_put", solvers.discover()["stays_put"])
    result = identify(TRAIN[:1], method="stays_put")
    assert (result.method, result.status, result.n_simulations) == ("stays_put", SolveStatus.CONVERGED, 1)
    online = OnlineIdentifier(OnlineIdentifier.new(TRAIN[0].shape), method="stays_put")
    assert online.add(TRAIN[0]).status is SolveStatus.CONVERGED and online.update(TRAIN[1]) is not None
    (tmp_path / "alias.py").write_text("from push_ident.identification.solvers.random_search import SOLVER\n")
    with pytest.raises(ImportError, match="alias"):
        solvers.discover()
