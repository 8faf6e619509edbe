"""The size of a discrepancy that the frames of a push share, set by the pushes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.fits import fit_base, fit_effects, fit_with_reference
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.fitting.discrepancy import (
    DiscrepancySize,
    LinearPushes,
    log_bayes_factor_of_larger,
    log_prior_of_size,
    with_size,
)
from push_ident.identification.fitting.fit import Fit
from push_ident.types import Float64Array, PushRecord

N_PUSHES = 6


def displaced(records: list[PushRecord], std: float) -> list[PushRecord]:
    """Each push with its own displacement of the tool, of this standard deviation along each axis [m]."""
    rng = np.random.default_rng(3)
    moved = [replace(r.pusher, position=r.pusher.position + std * rng.normal(size=2)) for r in records]
    return [replace(record, pusher=pusher) for record, pusher in zip(records, moved, strict=True)]


@pytest.fixture(scope="module")
def fit() -> Fit:
    return fit_base(simulated_pushes(N_PUSHES, 5, {"table_tilt": [0.025, 0.0]}), DiagnosisSettings())


def linear(fit: Fit) -> LinearPushes:
    return LinearPushes.of(fit.problem, fit.x, fit.end.hessian, fit.end.gradient)


def test_pushes_that_differ_by_a_displacement_of_the_contact_show_its_size() -> None:
    std = 1.5e-3
    noise = fit_base(displaced(simulated_pushes(N_PUSHES, 5), std), DiagnosisSettings()).problem.noise
    assert noise is not None
    found = noise.discrepancy_factor[0] * noise.floor_position
    assert 0.5 * std < found < 2.0 * std
    plain = fit_base(simulated_pushes(N_PUSHES, 5), DiagnosisSettings()).problem.noise
    assert plain is not None and plain.discrepancy_factor[0] * plain.floor_position < 0.2 * std
    assert 1.0 <= plain.frame_factor < 1.2


def test_evidence_of_a_size_is_that_of_the_whole_hessian_and_its_slope_that_of_differences(fit: Fit) -> None:
    pushes, n = linear(fit), fit.unknowns.size
    at_fit = pushes.solve(np.zeros(3))
    assert at_fit.volume == pytest.approx(fit.end.log_volume, abs=1e-6)
    newton = fit.x - np.linalg.solve(fit.end.hessian, fit.end.gradient)
    np.testing.assert_allclose(at_fit.unknowns, newton[:n], atol=1e-6)
    # Under another size: the same by the dense Hessian, without eliminating the unknowns of the pushes.
    logs = np.array([0.4, -0.3, 0.2])
    by_all = np.where(pushes.group < 0, 0.0, np.exp(-2.0 * logs)[pushes.group] - 1.0)
    added = np.outer(fit.problem.precisions, by_all).ravel()
    hessian = fit.end.hessian + np.diag(np.r_[np.zeros(n), added])
    gradient = fit.end.gradient + np.r_[np.zeros(n), added] * fit.x
    moved = fit.x - np.linalg.solve(hessian, gradient)
    np.testing.assert_allclose(pushes.solve(logs).unknowns, moved[:n], atol=1e-6)
    assert pushes.solve(logs).volume == pytest.approx(0.5 * np.linalg.slogdet(hessian)[1], abs=1e-6)
    slope = pushes.cost(logs)[1]
    for k, step in enumerate(1e-5 * np.eye(3)):
        assert slope[k] == pytest.approx((pushes.cost(logs + step)[0] - pushes.cost(logs - step)[0]) / 2e-5, rel=1e-4, abs=1e-4)


SIZES = SelectionPolicy().usual_discrepancy, SelectionPolicy().larger_discrepancy


def test_evidence_of_usual_and_larger_sizes_is_the_integral_over_all_sizes(fit: Fit) -> None:
    pushes = linear(fit)
    width = float(np.log(SIZES[0]))
    for middle in (0.0, float(np.log(SIZES[1]))):
        # By Gauss-Hermite quadrature about the prior of the sizes; its density has the constant that the evidence leaves out.
        nodes, weights = np.polynomial.hermite_e.hermegauss(9)
        total = 0.0
        for k in np.ndindex(9, 9, 9):
            logs = middle + width * nodes[[*k]] - pushes.first
            total += float(np.prod(weights[[*k]])) * np.exp(-pushes.cost(logs, np.inf)[0] + pushes.cost(np.zeros(3), np.inf)[0])
        integral = np.log(total) - 1.5 * np.log(2.0 * np.pi) + 3.0 * np.log(width) - pushes.cost(np.zeros(3), np.inf)[0]
        assert pushes.log_evidence_about(middle, width) == pytest.approx(integral, abs=0.3)


def test_discrepancy_is_larger_than_usual_where_each_push_departs_in_its_own_way() -> None:
    even = simulated_pushes(N_PUSHES, 5)
    plain, departing = (fit_base(records, DiagnosisSettings()) for records in (even, displaced(even, 2e-3)))
    assert log_bayes_factor_of_larger(plain.problem, plain.x, plain.end, *SIZES) < -2.0 and not plain.has_discrepancy_above(SIZES[0])
    assert log_bayes_factor_of_larger(departing.problem, departing.x, departing.end, *SIZES) > 2.0
    assert departing.has_discrepancy_above(SIZES[0])


def test_log_densities_of_pushes_are_the_parts_of_the_evidence(fit: Fit) -> None:
    n, hessian, precisions = fit.unknowns.size, fit.end.hessian, np.array(fit.problem.precisions)
    reduced = hessian[:n, :n] - hessian[:n, n:] @ np.linalg.solve(hessian[n:, n:], hessian[n:, :n])
    of_object = -0.5 * float(fit.z @ fit.z) - 0.5 * float(np.linalg.slogdet(reduced)[1])
    of_precisions = 0.5 * 4.0 * float(np.sum(np.log(precisions) - precisions + 1.0))
    of_sizes = log_prior_of_size(fit.problem.noise) + of_precisions + fit.discrepancy_size.log_evidence_gain
    assert np.sum(fit.push_log_densities) + of_object + of_sizes == pytest.approx(fit.log_evidence, abs=1e-6)


def test_without_an_effect_pushes_are_those_at_its_null_value(fit: Fit) -> None:
    tilted = fit_effects(fit, ("table_tilt",))
    pushes, at = linear(tilted), tilted.unknowns.slice_of_effect("table_tilt")
    without = pushes.of_unknowns(np.setdiff1d(np.arange(tilted.unknowns.size), np.r_[at]))
    gain = without.least_cost() - pushes.least_cost()
    assert gain > 10.0
    # In the linear range, as the fit with and without it.
    assert gain == pytest.approx(tilted.log_evidence - fit.log_evidence, rel=0.35)
    assert tilted.effects.values[0] == pytest.approx(0.025, abs=0.01)  # two standard deviations


def test_another_size_has_the_same_motions_and_displacements(fit: Fit) -> None:
    problem, x = with_size(fit.problem, fit.x, DiscrepancySize(1.3, np.array([2.0, 0.5, 3.0]), np.full(N_PUSHES, 0.7), 0.0))
    before, after = ([p.displacement(at, push) for push in range(N_PUSHES)] for p, at in ((fit.problem, fit.x), (problem, x)))
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-12)
    assert problem.noise is not None and fit.problem.noise is not None
    assert problem.noise.frame_factor == pytest.approx(1.3 * fit.problem.noise.frame_factor)
    first: list[Float64Array] = [p.first_pose(at, 0) for p, at in ((fit.problem, fit.x), (problem, x))]
    np.testing.assert_array_equal(*first)


def test_a_push_that_the_model_explains_badly_counts_with_a_precision_of_its_own() -> None:
    records, std = simulated_pushes(N_PUSHES, 5), 1e-4
    slipped = replace(records[2].pusher, position=records[2].pusher.position + np.array([0.004, 0.003]))
    found = fit_base([*records[:2], replace(records[2], pusher=slipped), *records[3:]], DiagnosisSettings())
    others = np.delete(found.problem.precisions, 2)
    assert found.problem.precisions[2] < 0.1 * np.min(others) and np.all(others > 0.3)
    pushes, logs = linear(found), np.zeros(3)
    assert pushes.solve(logs).volume == pytest.approx(found.end.log_volume, abs=1e-6)
    # The fixed point: the cost does not fall along any precision.
    for _ in range(200):
        pushes = pushes.with_precisions(logs)
    for push in range(N_PUSHES):
        factor = np.where(np.arange(N_PUSHES) == push, 1.0 + std, 1.0)
        above, below = (replace(pushes, precisions=pushes.precisions * f).cost(logs)[0] for f in (factor, 1.0 / factor))
        assert above - below == pytest.approx(0.0, abs=1e-3 * std)


def test_very_steep_pushes_keep_the_evidence_of_a_size(fit: Fit) -> None:
    """A push whose end depends on 1e-9 of an unknown has a Hessian beside which rounding hides all others."""
    pushes, n = linear(fit), fit.unknowns.size
    steep = 1e8 * np.random.default_rng(1).normal(size=(60, n + pushes.at_push.shape[1]))
    hessian = steep.T @ steep
    steeper = replace(
        pushes,
        hessian=pushes.hessian + hessian[:n, :n],
        cross=np.concatenate([pushes.cross[:-1], pushes.cross[-1:] + hessian[:n, n:]]),
        hessian_of_push=np.concatenate([pushes.hessian_of_push[:-1], pushes.hessian_of_push[-1:] + hessian[n:, n:]]),
    )
    at = steeper.solve(np.zeros(3))
    assert np.isfinite(at.volume) and np.isfinite(at.cost) and np.all(np.isfinite(at.unknowns))


def test_a_change_since_a_reference_may_be_below_zero() -> None:
    """A spring of the reference that is gone, of which there is less than none."""
    fit = fit_with_reference(simulated_pushes(3, 5), simulated_pushes(3, 6), DiagnosisSettings())
    changed = fit_effects(fit, ("tether",), np.array([-0.5, 0.0, 0.0]))
    below = replace(changed, x=np.where(np.arange(len(changed.x)) == changed.unknowns.slices["effects"].start, -0.5, changed.x))
    assert below.fitted_effects.values[0] < 0.0 <= below.effects.values[0]
