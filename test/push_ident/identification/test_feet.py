"""How the weight rests on the cells: loads balance about the centre of mass, feet bear what statics gives them, and pushes find them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import softmax

from helpers.objects import random_records, square
from push_ident.identification.fitting.problem import Evaluation, FitProblem
from push_ident.identification.identify import identify
from push_ident.identification.online.identifier import OnlineIdentifier, OnlineState
from push_ident.identification.predicting.prediction import held_out_errors, push_errors
from push_ident.identification.report.result_json import result_json
from push_ident.identification.results.identifiability import supports
from push_ident.identification.results.result import Identification
from push_ident.identification.unknowns.load import balanced_load, feet_load
from push_ident.types import Float64Array, ObjectModel, SolveStatus

SHAPE = square(9, 0.012)
CELLS = SHAPE.cells.centres
PLACES = np.array([[-0.036, -0.036], [0.036, -0.024], [-0.012, 0.036]])


def statics(centre: Float64Array) -> Float64Array:
    """Shares of three supports that balance a weight at a centre."""
    return np.linalg.solve(np.vstack([PLACES.T, np.ones(3)]), np.append(centre, 1.0))


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), amplitude=st.sampled_from([0.1, 1.0, 5.0, 20.0]), metres=st.sampled_from([1e-3, 1.0, 1e3]))
def test_load_balances_about_the_centre_of_mass_whatever_the_map_and_the_unit(seed: int, amplitude: float, metres: float) -> None:
    rng = np.random.default_rng(seed)
    weight, excess = softmax(rng.normal(size=len(CELLS))), amplitude * rng.normal(size=len(CELLS))
    load = balanced_load(weight, excess, metres * CELLS)
    assert np.all(load >= 0) and load.sum() == pytest.approx(1.0)
    assert load @ CELLS == pytest.approx(weight @ CELLS, abs=1e-9)


def test_load_of_even_and_tilted_maps_is_the_weight_and_that_of_three_points_statics() -> None:
    weight, even = softmax(np.random.default_rng(0).normal(size=len(CELLS))), np.full(len(CELLS), 1 / len(CELLS))
    assert balanced_load(weight, np.full(len(CELLS), 3.0), CELLS) == pytest.approx(weight, rel=1e-9)
    # A slope alone cannot be borne: on a bed of springs a plane undoes it.
    assert balanced_load(even, 2e-3 * CELLS[:, 0], CELLS) == pytest.approx(even, rel=1e-9)
    assert balanced_load(np.array([1.0]), np.array([4.0]), np.array([[0.1, 0.2]])) == pytest.approx([1.0])
    points = [int(np.argmin(np.linalg.norm(CELLS - place, axis=1))) for place in PLACES]
    excess = np.full(len(CELLS), -60.0)
    excess[points] = [0.3, -0.2, 1.0]
    assert balanced_load(even, excess, CELLS)[points] == pytest.approx(statics(even @ CELLS), abs=1e-9)


def test_three_feet_bear_what_statics_gives_them_and_feet_that_cannot_balance_still_have_a_load() -> None:
    weight = softmax(0.3 * np.random.default_rng(0).normal(size=len(CELLS)))
    feet = feet_load(weight, CELLS, PLACES, 0.6 * 0.012, np.array([0.3, -0.5, 0.2]))
    assert feet.position == pytest.approx(PLACES, abs=1e-4)
    assert feet.share == pytest.approx(statics(weight @ CELLS), abs=1e-2)
    assert feet.load.sum() == pytest.approx(1.0) and np.all(feet.load > 0)
    assert feet.load @ CELLS == pytest.approx(weight @ CELLS, abs=2e-4)
    aside = feet_load(weight, CELLS, np.array([[0.03, 0.03], [0.03, 0.02], [0.02, 0.03]]), 0.007, np.zeros(3))
    assert np.all(np.isfinite(aside.load)) and aside.load.sum() == pytest.approx(1.0)


def tripod() -> ObjectModel:
    """An even plate on three points, each on a cell of its own."""
    n = len(CELLS)
    mass, load = np.full(n, 0.9 / n), np.full(n, 1e-6)
    for place, share in zip(PLACES, statics(CELLS.mean(axis=0)), strict=True):
        load[np.argmin(np.linalg.norm(CELLS - place, axis=1))] += share
    return ObjectModel(SHAPE, mass, 0.28 * load * 0.9 / mass, 0.25)


RECORDS = random_records(tripod(), 20, 5)
TRAIN, LATER, TEST = RECORDS[:8], RECORDS[8:10], RECORDS[11:]


@pytest.fixture(scope="module")
def result() -> Identification:
    return identify(TRAIN)


@pytest.fixture
def trained(result: Identification) -> OnlineState:
    """After as many pushes as the window holds."""
    done = {name: getattr(result, name) for name in ("warm_starts", "posterior", "status")}
    return replace(OnlineIdentifier.new(SHAPE), records=tuple(TRAIN), **done)


def test_feet_of_a_tripod_are_found_and_written(result: Identification) -> None:
    probability = {candidate.name: candidate.probability for candidate in result.candidates}
    assert probability["three feet"] > 0.5
    found = supports(result.posterior)
    nearest = [min(found, key=lambda support: float(np.linalg.norm(support.position - place))) for place in PLACES]
    assert np.array([support.position for support in nearest]) == pytest.approx(PLACES, abs=0.01)
    assert [support.share for support in nearest] == pytest.approx(statics(CELLS.mean(axis=0)), abs=0.1)
    errors = push_errors(result, TRAIN, [0]), push_errors(result, TRAIN, [])
    (written,) = (candidate for candidate in result_json(result, "1", *errors)["priors"] if candidate["name"] == "three feet")
    assert written["feet"][0]["share"] == pytest.approx(found[0].share)


def test_feet_stay_where_pushes_leave_the_window(trained: OnlineState) -> None:
    """Summed-up pushes count in the unknowns of the kind that was more probable when the first one left."""
    online = OnlineIdentifier(trained, window=len(TRAIN))
    assert online.posterior.prior.feet == 3
    for record in LATER:
        later = online.add(record)
        assert later.status is SolveStatus.CONVERGED
        assert [candidate.name for candidate in later.candidates] == ["three feet"]
    assert held_out_errors(online.posterior.model, TEST).mean() < 1.5e-3
    again = OnlineIdentifier(OnlineIdentifier.known(online.posterior))
    again.add(TRAIN[0])
    assert again.posterior.prior.feet == 3


def test_pushes_that_cannot_be_simulated_end_in_a_status(monkeypatch: pytest.MonkeyPatch, trained: OnlineState) -> None:
    def evaluate(problem: FitProblem, _: Float64Array) -> Evaluation:
        return Evaluation(np.inf, np.zeros(problem.size), np.eye(problem.size), np.empty((0, 3)))

    monkeypatch.setattr(FitProblem, "evaluate", evaluate)
    for state in (OnlineIdentifier.new(SHAPE), trained):
        ended = OnlineIdentifier(state, window=len(TRAIN)).add(LATER[0])
        assert ended.status is SolveStatus.SIMULATION_FAILED and not ended.candidates and np.isnan(ended.reduced_chi2)
