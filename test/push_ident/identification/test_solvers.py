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
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.identify import Earlier, identify
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.solvers import SOLVERS
from push_ident.identification.solvers.autograd import reference_cost
from push_ident.identification.unknowns.mechanics import model_at, unknowns_of_maps
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import ObjectModel, PoseTrack, PusherPath, PushRecord, SolveStatus

QUICK = [name for name in SOLVERS if name != "autograd"]
RECORDS = random_records(hammer(1), 10, 1)
TRAIN, TEST = RECORDS[:2], RECORDS[2:]


def mean_error(model: ObjectModel, records: list[PushRecord]) -> float:
    """Mean cell error at the end of the pushes [m]: no solver minimises it, and no meter sorts by it."""
    return float(np.mean(held_out_errors(model, records)))


@pytest.mark.parametrize("method", QUICK)
def test_solver_predicts_its_training_pushes_and_others_better_than_a_uniform_object(method: str) -> None:
    result = identify(TRAIN, method=method, budget=Budget(max_simulations=600))
    assert mean_error(result.model, TRAIN) < 0.9 * mean_error(result.uniform, TRAIN)
    assert mean_error(result.model, TEST) < mean_error(result.uniform, TEST)


@pytest.mark.parametrize("method", QUICK)
def test_solver_returns_the_best_point_it_has_visited_within_its_simulations(method: str) -> None:
    result = identify(TRAIN, method=method, budget=Budget(max_simulations=100))
    # A step of Gauss-Newton or a pass of the fast gradient is finished first, and the fit of the scalars is needed anyway.
    assert result.n_simulations <= 100 + 100
    best = min(result.history, key=lambda checkpoint: checkpoint.cost)
    assert result.cost == best.cost
    assert result.model.friction == pytest.approx(best.model.friction, rel=1e-6)  # a posterior is polished
    assert result.model.mass / result.model.total_mass == pytest.approx(best.model.mass / best.model.total_mass, rel=1e-6)


@pytest.mark.parametrize("method", QUICK)
def test_every_solver_repeats_itself_from_a_seed(method: str) -> None:
    first, second = (identify(TRAIN, method=method, budget=Budget(max_simulations=200), options=FitOptions(seed=3)) for _ in range(2))
    assert first.status is second.status
    assert np.array_equal(first.model.mass, second.model.mass)
    assert np.array_equal(first.model.friction, second.model.friction)


def test_random_search_depends_on_its_seed() -> None:
    first, second = (
        identify(TRAIN, method="random_search", budget=Budget(max_simulations=200), options=FitOptions(seed=s)) for s in (0, 1)
    )
    assert not np.array_equal(first.model.mass, second.model.mass)


def test_autograd_learns_through_the_reference_engine() -> None:
    result = identify(TRAIN[:1], method="autograd", budget=Budget(max_simulations=4, max_seconds=60))
    assert result.status is SolveStatus.BUDGET_SPENT
    assert mean_error(result.model, TRAIN[:1]) < 0.9 * mean_error(result.uniform, TRAIN[:1])


def around_first_motion(record: PushRecord, seconds: float = 0.3) -> PushRecord:
    """The part of a push in which the object begins to move: the reference engine is slow."""
    poses, pusher = record.poses, record.pusher
    end = poses.time[np.argmax(np.linalg.norm(poses.pose[:, :2] - poses.pose[0, :2], axis=1) > 0.01)]
    kept, driven = (np.abs(time - end + seconds / 2) <= seconds / 2 for time in (poses.time, pusher.time))
    return replace(
        record,
        poses=PoseTrack(poses.time[kept], poses.pose[kept], poses.covariance[kept]),
        pusher=PusherPath(pusher.time[driven], pusher.position[driven], pusher.radius),
    )


def test_autograd_has_the_gradient_of_its_own_cost() -> None:
    record = around_first_motion(TRAIN[0])
    problem = FitProblem([record], UnknownsSpec.of(TRAIN[0].shape, Prior(max_modes=4).without_pressure()))
    x = 0.2 * np.random.default_rng(0).normal(size=problem.size)
    unknowns, cost = reference_cost(problem, x)
    cost.backward()  # type: ignore[no-untyped-call]
    assert unknowns.grad is not None
    for i in (0, 5, problem.unknowns.size - 1, problem.size - 1):
        step = np.zeros(problem.size)
        step[i] = 1e-5
        difference = float((reference_cost(problem, x + step)[1] - reference_cost(problem, x - step)[1]).detach()) / 2e-5
        assert abs(difference) > 0.1
        assert float(unknowns.grad[i]) == pytest.approx(difference, rel=2e-2, abs=1e-2)


def test_a_spent_budget_is_a_status() -> None:
    for method in ("gauss_newton", "random_search"):
        assert identify(TRAIN, method=method, budget=Budget(max_simulations=4)).status is SolveStatus.BUDGET_SPENT


def test_budget_refuses_what_is_no_limit() -> None:
    with pytest.raises(InputError, match="max_seconds is -1"):
        Budget(max_seconds=-1)


def test_gradient_of_the_fit_equals_central_differences_cell_by_cell() -> None:
    problem = FitProblem(TRAIN[:1], UnknownsSpec.of(TRAIN[0].shape, Prior(), modes=np.eye(len(TRAIN[0].shape.cells))))
    x = 0.2 * np.random.default_rng(1).normal(size=problem.size)
    gradient = problem.evaluate(x).gradient
    for i in (3, 60, 75, 130, problem.size - 2):
        step = np.zeros(problem.size)
        step[i] = 1e-5
        assert gradient[i] == pytest.approx((problem.cost(x + step) - problem.cost(x - step)) / 2e-5, rel=1e-3, abs=1e-3)


def test_unknowns_of_given_maps_are_those_maps() -> None:
    truth = hammer(2)
    parameters = UnknownsSpec.of(truth.shape, Prior(), modes=np.eye(len(truth.mass)))
    again = model_at(parameters, unknowns_of_maps(parameters, truth.mass, truth.friction, truth.pusher_friction))
    assert again.mass * truth.total_mass / again.total_mass == pytest.approx(truth.mass)
    assert again.friction == pytest.approx(truth.friction)
    assert again.pusher_friction == pytest.approx(truth.pusher_friction)


def with_second_half_moved(record: PushRecord, offset: tuple[float, float, float]) -> PushRecord:
    pose = record.poses.pose.copy()
    pose[len(pose) // 2 :] += offset
    return replace(record, poses=replace(record.poses, pose=pose))


def test_contradictory_pushes_are_a_status_and_widen_the_posterior() -> None:
    consistent = identify(TRAIN)
    assert consistent.status is SolveStatus.CONVERGED
    contradictory = identify([*TRAIN, *(with_second_half_moved(r, (0.05, -0.05, 1.0)) for r in TRAIN)])
    assert contradictory.status is SolveStatus.POOR_FIT
    assert contradictory.posterior.pusher_friction.std > consistent.posterior.pusher_friction.std


@pytest.mark.parametrize("method", QUICK)
def test_solvers_do_what_their_capabilities_state(method: str) -> None:
    can = SOLVERS[method].capabilities
    budget = Budget(max_simulations=60)
    result = identify(TRAIN, method=method, budget=budget)
    unknowns, n_cells = result.posterior.unknowns, len(TRAIN[0].shape.cells)
    assert can.cell_by_cell == np.array_equal(unknowns.modes, np.eye(n_cells))
    assert can.gives_posterior == (not np.array_equal(result.posterior.covariance, np.eye(unknowns.size)))
    assert can.gives_posterior == bool(np.isfinite(result.reduced_chi2))
    again = identify(TRAIN, method=method, budget=budget, earlier=Earlier(result.warm_starts))
    if can.resumes:
        assert again.history[0].cost <= result.cost * (1 + 1e-6)
    else:
        assert again.history[0].cost == result.history[0].cost
    if not can.takes_effects:
        with pytest.raises(InputError, match="fits no effects"):
            identify(TRAIN, method=method, effects=("table_tilt",))


def test_solver_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert online.add(TRAIN[0]).status is SolveStatus.CONVERGED
    assert online.update(TRAIN[1]) is not None


def test_file_of_a_solver_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "alias.py").write_text("from push_ident.identification.solvers.random_search import SOLVER\n")
    monkeypatch.setattr(solvers, "__path__", [*solvers.__path__, str(tmp_path)])
    with pytest.raises(ImportError, match="alias"):
        solvers.discover()
