"""The prior of the maps is set by the pushes: its change of units, its evidence, and what it makes of even and uneven objects."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import hammer, random_records
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.levenberg_marquardt import minimise
from push_ident.identification.fitting.map_prior import STARTS, LinearEvidence, MapTransforms
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.identify import identify
from push_ident.identification.unknowns.mechanics import model_at
from push_ident.identification.unknowns.prior import MapPrior, Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import ObjectModel

OTHER = MapPrior(0.4, 1.2, 0.15, 0.4)
CENTRE = STARTS["uneven load"].logs


def test_unknowns_under_another_prior_are_the_same_object_in_other_units() -> None:
    shape = hammer(0).shape
    transforms = MapTransforms(UnknownsSpec.of(shape, Prior(max_modes=12)))
    other = transforms.spec_under(OTHER)
    y = np.random.default_rng(0).normal(size=other.size)
    expected = model_at(transforms.spec, transforms.matrix(OTHER) @ y)
    assert model_at(other, y).mass == pytest.approx(expected.mass, rel=1e-9)
    assert model_at(other, y).friction == pytest.approx(expected.friction, rel=1e-9)


def test_covariance_of_a_map_is_that_of_its_prior_where_every_cell_has_a_mode() -> None:
    shape = hammer(0).shape
    transforms = MapTransforms(UnknownsSpec.of(shape, Prior(max_modes=len(shape.cells))))
    direct = UnknownsSpec.of(shape, Prior(max_modes=len(shape.cells), correlation_length=OTHER.length)).modes
    modes = transforms.spec_under(OTHER).modes
    assert modes @ modes.T == pytest.approx(direct @ direct.T, abs=1e-6)


@pytest.fixture(scope="module")
def linear() -> tuple[LinearEvidence, Fit, MapTransforms]:
    records = random_records(hammer(1), 3, 1)
    transforms = MapTransforms(UnknownsSpec.of(records[0].shape, Prior(max_modes=15)))
    start = STARTS["uneven load"]
    problem = FitProblem(records, transforms.spec_under(start))
    fit = Fit(problem, *minimise(problem, np.zeros(problem.size)))
    return LinearEvidence(transforms, fit, transforms.matrix(start), CENTRE), fit, transforms


def test_evidence_has_the_slope_that_differences_show(linear: tuple[LinearEvidence, Fit, MapTransforms]) -> None:
    evidence, _, _ = linear
    logs = OTHER.logs
    _, slope = evidence.cost_and_slope(logs)
    for k in range(4):
        step = np.zeros(4)
        step[k] = 1e-4
        difference = (evidence.cost_and_slope(logs + step)[0] - evidence.cost_and_slope(logs - step)[0]) / 2e-4
        assert slope[k] == pytest.approx(difference, rel=1e-2, abs=1e-3)


def test_linear_evidence_is_that_of_a_fit_nearby(linear: tuple[LinearEvidence, Fit, MapTransforms]) -> None:
    evidence, fit, transforms = linear
    start = STARTS["uneven load"]
    near = MapPrior.of_logs(start.logs + 0.05)
    problem = FitProblem(fit.problem.records, transforms.spec_under(near))
    x0 = evidence.minimum(near.logs)
    n = transforms.spec.size
    x0[:n] = np.linalg.solve(transforms.matrix(near), x0[:n])
    direct = Fit(problem, *minimise(problem, x0)).log_evidence - fit.log_evidence
    # The prior of the hyperparameters is in the linear evidence only.
    prior = 0.5 * float(np.sum(((near.logs - CENTRE) / [1.0, 1.0, 1.0, 0.5]) ** 2))
    expected = evidence.cost_and_slope(start.logs)[0] - evidence.cost_and_slope(near.logs)[0] + prior
    assert direct == pytest.approx(expected, abs=0.1)


@pytest.mark.long
def test_pushes_tell_an_even_object_from_an_uneven_one() -> None:
    uneven = hammer(3)
    cells = len(uneven.shape.cells)
    even = ObjectModel(uneven.shape, np.full(cells, uneven.total_mass / cells), np.full(cells, 0.3), uneven.pusher_friction)
    of_even, of_uneven = (identify(random_records(truth, 6, 3)).candidates for truth in (even, uneven))
    equal = [sum(c.probability for c in found if c.maps is None) for found in (of_even, of_uneven)]
    assert equal[0] > 0.5 > 0.01 > equal[1]
    spread = [max(c.maps.mass_std + c.maps.friction_std for c in found if c.maps) for found in (of_even, of_uneven)]
    assert spread[0] < spread[1]
    assert sum(c.probability for c in of_even) == pytest.approx(1.0)
