"""The unknowns are named blocks with a prior; that of the maps is set by the pushes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, random_records, uniform
from push_ident.errors import InputError
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.levenberg_marquardt import minimise
from push_ident.identification.fitting.map_prior import STARTS, LinearEvidence, MapTransforms
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.identify import identify
from push_ident.identification.unknowns.mechanics import model_at
from push_ident.identification.unknowns.prior import MapPrior, Prior
from push_ident.identification.unknowns.spec import UnknownsSpec, nuisance_effects
from push_ident.types import CameraAccuracy, ObjectShape

SHAPE = hammer(1).shape
PRIOR = Prior(max_modes=4)


def test_an_outline_that_a_camera_traced_is_an_unknown_as_uncertain_as_it_says() -> None:
    assert nuisance_effects(SHAPE, PRIOR) == ()
    square = ObjectShape(
        SHAPE.cells, np.array([(-0.1, -0.05), (0.1, -0.05), (0.1, 0.05), (-0.1, 0.05)]), np.array([1e-3, 2e-3, 1e-3, 2e-3])
    )
    assert square.outline_error == pytest.approx(np.sqrt((2 * 1e-6 + 4e-6) / 3))  # the long edges count twice
    unknowns = UnknownsSpec.of(square, PRIOR, effects=nuisance_effects(square, PRIOR))
    assert unknowns.effect_std == pytest.approx([square.outline_error])
    clockwise = ObjectShape(SHAPE.cells, square.outline[::-1], np.array([1e-3, 2e-3, 3e-3, 4e-3]))  # top, left, bottom, right
    assert clockwise.outline == pytest.approx(square.outline) and clockwise.outline_std == pytest.approx([3e-3, 2e-3, 1e-3, 4e-3])
    with pytest.raises(InputError, match="positive"):
        ObjectShape(SHAPE.cells, square.outline, np.zeros(4))


def test_the_accuracy_of_a_camera_makes_its_place_and_heading_unknowns() -> None:
    stated = PRIOR.with_camera_accuracy([CameraAccuracy(), CameraAccuracy(2e-3, 5e-3)])
    assert (stated.camera_position_std, stated.camera_heading_std) == (2e-3, 5e-3)
    assert stated.with_camera_accuracy([CameraAccuracy(1.0, 1.0)]) == stated  # what somebody states counts
    unknowns = UnknownsSpec.of(SHAPE, stated, effects=nuisance_effects(SHAPE, stated))
    stds = {name: unknowns.effect_std[unknowns.effects.slice_of(name)].tolist() for name in unknowns.effects.names}
    assert stds == {"camera_translation": [2e-3, 2e-3], "camera_rotation": [5e-3]}
    assert nuisance_effects(SHAPE, PRIOR.with_camera_accuracy([CameraAccuracy(position=1e-3)])) == ("camera_translation",)


# --- the prior of the maps, which the pushes set


OTHER = MapPrior(0.4, 1.2, 0.15, 0.4)
START = STARTS["uneven load"]


def test_unknowns_under_another_prior_are_the_same_object_in_other_units() -> None:
    transforms = MapTransforms(UnknownsSpec.of(SHAPE, Prior(max_modes=12)))
    other = transforms.spec_under(OTHER)
    y = np.random.default_rng(0).normal(size=other.size)
    expected = model_at(transforms.spec, transforms.matrix(OTHER) @ y)
    assert model_at(other, y).mass == pytest.approx(expected.mass, rel=1e-9)
    assert model_at(other, y).friction == pytest.approx(expected.friction, rel=1e-9)
    # Where every cell has a mode, the covariance of a map is that of its prior.
    n = len(SHAPE.cells)
    modes = MapTransforms(UnknownsSpec.of(SHAPE, Prior(max_modes=n))).spec_under(OTHER).modes
    direct = UnknownsSpec.of(SHAPE, Prior(max_modes=n, correlation_length=OTHER.length)).modes
    assert modes @ modes.T == pytest.approx(direct @ direct.T, abs=1e-6)


def test_linear_evidence_is_that_of_a_fit_nearby_and_has_the_slope_that_differences_show() -> None:
    records = random_records(hammer(1), 3, 1)
    transforms = MapTransforms(UnknownsSpec.of(SHAPE, Prior(max_modes=15)))
    problem = FitProblem(records, transforms.spec_under(START))
    fit = Fit(problem, *minimise(problem, np.zeros(problem.size)))
    evidence = LinearEvidence(transforms, fit, transforms.matrix(START), START.logs)
    for slope, step in zip(evidence.cost_and_slope(OTHER.logs)[1], 1e-4 * np.eye(4), strict=True):
        difference = (evidence.cost_and_slope(OTHER.logs + step)[0] - evidence.cost_and_slope(OTHER.logs - step)[0]) / 2e-4
        assert slope == pytest.approx(difference, rel=1e-2, abs=1e-3)
    near = MapPrior.of_logs(START.logs + 0.05)
    problem = FitProblem(records, transforms.spec_under(near))
    direct = Fit(problem, *minimise(problem, np.zeros(problem.size))).log_evidence - fit.log_evidence
    # The prior of the hyperparameters is in the linear evidence only.
    prior = 0.5 * float(np.sum(((near.logs - START.logs) / [1.0, 1.0, 1.0, 0.5]) ** 2))
    assert direct == pytest.approx(evidence.cost_and_slope(START.logs)[0] - evidence.cost_and_slope(near.logs)[0] + prior, abs=0.1)
    # An unstable motion has directions so steep that rounding makes the Hessian indefinite.
    steep = 1e10 * np.array([1.0, 2.0, -1.0])
    hessian = fit.end.hessian.copy()
    hessian[-3:, -3:] += np.outer(steep, steep) - 1e5 * np.eye(3)
    rounded = replace(fit, end=replace(fit.end, hessian=hessian))
    assert np.isfinite(LinearEvidence(transforms, rounded, transforms.matrix(START), START.logs).minimum(START.logs)).all()


@pytest.mark.long
def test_pushes_tell_an_even_object_from_an_uneven_one() -> None:
    of_even, of_uneven = (identify(random_records(truth, 6, 3)).candidates for truth in (uniform(SHAPE, 0.6, 0.3, 0.25), hammer(3)))
    equal = [sum(c.probability for c in found if c.maps is None) for found in (of_even, of_uneven)]
    assert equal[0] > 0.5 > 0.01 > equal[1]
    spread = [max(c.maps.mass_std + c.maps.friction_std for c in found if c.maps) for found in (of_even, of_uneven)]
    assert spread[0] < spread[1]
    assert sum(c.probability for c in of_even) == pytest.approx(1.0)


def test_a_linear_minimum_far_beyond_the_prior_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A push at the middle of a face, where its derivative is huge, once started the next round at values that are not finite."""
    records = random_records(hammer(1), 2, 3)
    minimum = LinearEvidence.minimum
    monkeypatch.setattr(LinearEvidence, "minimum", lambda self, logs: 1e8 * np.ones_like(minimum(self, logs)))
    result = identify(records, PRIOR)
    assert not result.status.is_failure and np.isfinite(result.posterior.model.friction).all()
