"""Objects on feet: loads by statics, derivatives, and feet that pushes find."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from helpers.objects import hammer, random_records, square
from push_ident.errors import InputError
from push_ident.identification.fitting.problem import Evaluation, FitProblem
from push_ident.identification.identify import identify
from push_ident.identification.online.identifier import OnlineIdentifier, OnlineState
from push_ident.identification.predicting.prediction import held_out_errors, push_errors
from push_ident.identification.report.result_json import result_json
from push_ident.identification.results.supports import supports
from push_ident.identification.unknowns.load import Feet, feet_load
from push_ident.identification.unknowns.mechanics import feet_at, foot_position_unknowns, log_derivatives_at, model_at
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import Float64Array, ObjectModel, SolveStatus

SHAPE = square(9, 0.012)
PLACES = np.array([[-0.036, -0.036], [0.036, -0.024], [-0.012, 0.036]])


def statics(centre: Float64Array) -> Float64Array:
    """Shares of three supports that balance a weight at a centre."""
    return np.linalg.solve(np.vstack([PLACES.T, np.ones(3)]), np.append(centre, 1.0))


def tripod() -> ObjectModel:
    """An even plate on three points, each on a cell of its own."""
    n = len(SHAPE.cells)
    mass, load = np.full(n, 0.9 / n), np.full(n, 1e-6)
    for place, share in zip(PLACES, statics(SHAPE.cells.centres.mean(axis=0)), strict=True):
        load[np.argmin(np.linalg.norm(SHAPE.cells.centres - place, axis=1))] += share
    return ObjectModel(SHAPE, mass, 0.28 * load * 0.9 / mass, 0.25)


RECORDS = random_records(tripod(), 24, 5)
TRAIN, LATER, TEST = RECORDS[:8], RECORDS[8:11], RECORDS[11:]


def test_three_feet_bear_what_statics_gives_them() -> None:
    weight = np.exp(0.3 * np.random.default_rng(0).normal(size=len(SHAPE.cells)))
    weight /= weight.sum()
    feet = feet_load(weight, SHAPE.cells.centres, Feet(PLACES, 0.6 * 0.012, np.array([0.3, -0.5, 0.2])))
    assert feet.position == pytest.approx(PLACES, abs=1e-4)
    assert feet.share == pytest.approx(statics(weight @ SHAPE.cells.centres), abs=1e-2)
    assert feet.load.sum() == pytest.approx(1.0) and np.all(feet.load > 0)
    assert feet.load @ SHAPE.cells.centres == pytest.approx(weight @ SHAPE.cells.centres, abs=2e-4)


def test_feet_that_cannot_balance_still_have_a_load() -> None:
    weight = np.full(len(SHAPE.cells), 1.0 / len(SHAPE.cells))
    feet = feet_load(weight, SHAPE.cells.centres, Feet(np.array([[0.03, 0.03], [0.03, 0.02], [0.02, 0.03]]), 0.007, np.zeros(3)))
    assert np.all(np.isfinite(feet.load)) and feet.load.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("number", [2, 3, 4])
def test_derivative_is_that_of_differences(number: int) -> None:
    unknowns = UnknownsSpec.of(hammer(1).shape, Prior(max_modes=5, feet=number))
    z, h = np.random.default_rng(number).normal(size=unknowns.size), 1e-6
    d_mass, d_friction = log_derivatives_at(unknowns, z)
    for k in range(unknowns.size):
        step = h * np.eye(unknowns.size)[k]
        above, below = model_at(unknowns, z + step), model_at(unknowns, z - step)
        assert d_mass[:, k] == pytest.approx(np.log(above.mass / below.mass) / (2 * h), abs=1e-6)
        assert d_friction[:, k] == pytest.approx(np.log(above.friction / below.friction) / (2 * h), abs=1e-6)


def test_places_are_unknowns_and_back() -> None:
    unknowns = UnknownsSpec.of(SHAPE, Prior(max_modes=5, feet=3))
    z = np.zeros(unknowns.size)
    z[unknowns.slices["foot_positions"]] = foot_position_unknowns(unknowns, PLACES)
    z[unknowns.slices["foot_width"]] = -8.0
    assert feet_at(unknowns, z).position == pytest.approx(PLACES, abs=1e-3)
    with pytest.raises(InputError, match="whole base"):
        feet_at(UnknownsSpec.of(SHAPE, Prior(max_modes=5)), np.zeros(3))


@pytest.mark.parametrize("number", [1, -1])
def test_one_foot_is_refused(number: int) -> None:
    with pytest.raises(InputError, match=r"Prior\.feet"):
        Prior(feet=number)


def test_feet_of_a_tripod_are_found_and_written() -> None:
    result = identify(TRAIN)
    probability = {candidate.name: candidate.probability for candidate in result.candidates}
    assert probability["three feet"] > 0.5
    found = supports(result.posterior)
    places, shares = np.array([s.position for s in found]), np.array([s.share for s in found])
    true = statics(SHAPE.cells.centres.mean(axis=0))
    best = min(permutations(range(3)), key=lambda order: float(np.abs(places[list(order)] - PLACES).max()))
    assert places[list(best)] == pytest.approx(PLACES, abs=0.01)
    assert shares[list(best)] == pytest.approx(true, abs=0.1)
    (written,) = (
        c
        for c in result_json(result, "1", push_errors(result, TRAIN, range(len(TRAIN))), push_errors(result, TRAIN, []))["priors"]
        if c["name"] == "three feet"
    )
    assert json.loads(json.dumps(written))["feet"][0]["share"] == pytest.approx(found[0].share)


@pytest.fixture(scope="module")
def trained() -> OnlineState:
    """After as many pushes as the window holds."""
    online = OnlineIdentifier(OnlineIdentifier.new(SHAPE), window=len(TRAIN))
    for record in TRAIN:
        online.add(record)
    return online.state


def test_feet_stay_where_pushes_leave_the_window(trained: OnlineState) -> None:
    """Summed-up pushes count in the unknowns of the kind that was more probable when the first one left."""
    online = OnlineIdentifier(trained, window=len(TRAIN))
    assert online.posterior.prior.feet == 3
    for record in LATER:
        result = online.add(record)
        assert result.status is SolveStatus.CONVERGED
        assert [candidate.name for candidate in result.candidates] == ["three feet"]
    assert held_out_errors(online.posterior.model, TEST).mean() < 1.5e-3
    again = OnlineIdentifier(OnlineIdentifier.known(online.posterior))
    again.add(TRAIN[0])
    assert again.posterior.prior.feet == 3


@pytest.mark.parametrize("summed_up", [False, True], ids=["any kind", "on feet for sure"])
def test_pushes_that_cannot_be_simulated_end_in_a_status(monkeypatch: pytest.MonkeyPatch, summed_up: bool, trained: OnlineState) -> None:
    online = OnlineIdentifier(trained if summed_up else OnlineIdentifier.new(SHAPE), window=len(TRAIN))
    for record in () if summed_up else TRAIN[:2]:
        online.add(record)
    assert not summed_up or online.posterior.prior.feet == 3
    failed = Evaluation(np.inf, np.zeros(0), np.zeros((0, 0)), np.empty((0, 3)))

    def evaluate(problem: FitProblem, x: Float64Array) -> Evaluation:
        return replace(failed, gradient=np.zeros(problem.size), hessian=np.eye(problem.size))

    monkeypatch.setattr(FitProblem, "evaluate", evaluate)
    result = online.add(LATER[0])
    assert result.status is SolveStatus.SIMULATION_FAILED
    assert not result.candidates and np.isnan(result.reduced_chi2)
