"""Structure in the residuals beyond every law of the catalogue: found where it is, with its coordinate, and not where there is none."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import block_diag

from helpers.diagnosis import TRUTH, simulated_pushes, wobbling
from helpers.objects import with_forces
from push_ident.diagnosis.fits import fit_base
from push_ident.diagnosis.held_out import folds_of
from push_ident.diagnosis.policy import DecisionPolicy, UnknownPolicy
from push_ident.diagnosis.scores import clipped_start
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.something_else.evidence import SomethingElse, error_with_patterns, find_something_else
from push_ident.diagnosis.something_else.family import Acts, VariesWith
from push_ident.diagnosis.something_else.patterns import PATTERNS, pattern_families
from push_ident.diagnosis.something_else.precision import AmplitudePrecision
from push_ident.diagnosis.something_else.words import PatternWords, describe_pattern
from push_ident.identification.fitting.discrepancy import departing_pushes
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effect import Mechanism
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import PushRecord

N_PUSHES, FIRST = 8, 4
"""Number of pushes, and of the first one with an effect."""


def found_in(records: list[PushRecord]) -> tuple[Fit, SomethingElse]:
    fit = fit_base(records, DiagnosisSettings())
    found = find_something_else(fit, DecisionPolicy(unknown=UnknownPolicy(draws=100)), folds_of(len(fit.problem.records), 7))
    assert found is not None
    return fit, found


def words_of(found: SomethingElse) -> PatternWords:
    return describe_pattern(found.best, [f"push {push}" for push in range(N_PUSHES)])


@pytest.fixture(scope="module")
def plain() -> list[PushRecord]:
    return simulated_pushes(N_PUSHES, 5)


def test_nothing_is_found_in_noise(plain: list[PushRecord]) -> None:
    _, found = found_in(plain)
    assert found.log_bayes_factor < 0.0 and found.p_value > 0.02
    assert sum(pattern.share for pattern in found.patterns) == pytest.approx(1.0)


def test_force_that_begins_with_a_push_is_found_with_that_push_and_predicts_the_others(plain: list[PushRecord]) -> None:
    tilted = simulated_pushes(N_PUSHES, 5, {"table_tilt": [0.03, 0.0]})
    fit, found = found_in([*plain[:FIRST], *tilted[FIRST:]])
    assert found.log_bayes_factor > 10.0 and found.p_value < 0.02
    beginning = [pattern for pattern in found.patterns if pattern.family.varies_with is VariesWith.FROM_PUSH]
    assert found.best in beginning and found.best.family.acts_on is Acts.FORCE and found.best.member.key == FIRST
    # A tilt pulls with its sine times the weight; the base model, fitted without it, has absorbed a part.
    expected = 0.03 * TRUTH.mass.sum() / float(TRUTH.mass @ TRUTH.friction)
    pull = found.best.amplitude.reshape(N_PUSHES, 3)[FIRST]
    assert 0.5 * expected < pull[0] < 1.2 * expected and abs(pull[1]) < 0.3 * pull[0]
    words = words_of(found)
    assert words.where == f"from push {FIRST} on" and "changed before that push" in words.look_for
    change = error_with_patterns(fit, found.patterns, [[push] for push in range(N_PUSHES)])
    assert float(np.median(change)) < -1e-4


def test_wobble_of_the_tool_is_found_by_its_frequency_whatever_its_phases(plain: list[PushRecord]) -> None:
    frequency, size = 3.4, 1.5e-3
    _, found = found_in(wobbling(plain, frequency, size, 3))
    assert found.best.family.mechanism is Mechanism.TOOL_WOBBLES and found.log_bayes_factor > 10.0 and found.least > 0.0
    assert found.best.member.key == pytest.approx(frequency, abs=0.5)
    assert np.max(np.abs(found.best.amplitude)) == pytest.approx(1e3 * size, rel=0.6)
    assert "times a second in all pushes" in words_of(found).where and "wobbling" in words_of(found).look_for


def test_tool_that_slipped_in_one_push_is_no_cause_but_a_push_to_look_at(plain: list[PushRecord]) -> None:
    slipped = simulated_pushes(N_PUSHES, 5, {"tool_offset": [8e-3, 8e-3]})
    fit, found = found_in([*plain[:FIRST], slipped[FIRST], *plain[FIRST + 1 :]])
    assert found.log_bayes_factor < 0.0
    assert set(departing_pushes(np.array(fit.problem.precisions), 0.05)) == {FIRST}
    assert not departing_pushes(np.array(fit_base(plain, DiagnosisSettings()).problem.precisions), 0.05)


@pytest.mark.long  # 10 s of the processor
def test_friction_that_rises_with_a_push_is_found_by_forces_where_poses_do_not_change(plain: list[PushRecord]) -> None:
    rougher = replace(TRUTH, friction=1.6 * TRUTH.friction)
    felt = [with_forces(record, TRUTH if push < FIRST else rougher) for push, record in enumerate(plain)]
    _, found = found_in(felt)
    assert found.log_bayes_factor > 10.0
    assert found.best.family.varies_with is VariesWith.FROM_PUSH and found.best.member.key == FIRST
    _, constant = found_in([with_forces(record, TRUTH) for record in plain])
    assert constant.log_bayes_factor < 0.0 and constant.p_value > 0.02


def test_push_in_which_nothing_moves_has_no_friction_however_few_steps_its_response_has(plain: list[PushRecord]) -> None:
    """Two steps, fewer than the last sample of the thinned steps may lie before them."""
    pusher, misses = plain[0].pusher, []
    for step in range(4):
        time = np.append(pusher.time[:-1], pusher.time[-1] + step / 240)
        misses.append(replace(plain[0], pusher=replace(pusher, time=time, position=pusher.position + 5.0)))
    fit = fit_base(misses, DiagnosisSettings(numerics=SimulationSettings(step=1 / 240)))
    responses = [fit.problem.respond(fit.x, push)[1] for push in range(4)]
    assert any(r is not None and len(r.time) < r.steps.start % PATTERNS.stride for r in responses)
    families = pattern_families(fit)
    assert families is not None and all(np.all(np.isfinite(family.columns)) for family in families)
    assert not any(np.any(family.columns) for family in families if family.acts_on is Acts.FRICTION)


def test_one_step_estimate_is_clipped_along_its_direction() -> None:
    np.testing.assert_allclose(clipped_start(np.array([3.0, 4.0]), 2.0), [1.2, 1.6])
    np.testing.assert_array_equal(clipped_start(np.array([0.3, 0.4]), 2.0), [0.3, 0.4])


def test_patterns_of_each_push_by_blocks_give_what_all_columns_at_once_give() -> None:
    rng, sizes, n_rows = np.random.default_rng(3), (4, 7, 2), 12
    blocks, jacobian = [rng.normal(size=(n_rows, n)) for n in sizes], rng.normal(size=(n_rows * len(sizes), 5))
    # The last column is nearly what the fit has explained already.
    blocks[2][:, 1] = jacobian[2 * n_rows :, 0] + 1e-4 * rng.normal(size=n_rows)
    hessian = jacobian.T @ jacobian + np.diag([1.0, 1.0, 0.3, 0.0, 0.0])
    columns, of_push = block_diag(*blocks), [slice(a, b) for a, b in pairwise(np.cumsum([0, *sizes]))]
    information = columns.T @ (columns - jacobian @ np.linalg.solve(hessian, jacobian.T @ columns))
    slope, scales = rng.normal(size=(sum(sizes), 3)), (0.1, 1.0, 30.0)

    together = AmplitudePrecision.of(information)
    apart = AmplitudePrecision.of_blocks([block.T @ block for block in blocks], of_push, jacobian.T @ columns, hessian)
    np.testing.assert_allclose(apart.log_bayes_factors(slope, scales), together.log_bayes_factors(slope, scales), rtol=1e-9)
    for scale in scales:
        expected = np.linalg.solve(information + np.eye(len(information)) / scale**2, slope[:, 0])
        np.testing.assert_allclose(together.amplitudes(slope[:, 0], scale), expected, rtol=1e-9)
        np.testing.assert_allclose(apart.amplitudes(slope[:, 0], scale), expected, rtol=1e-8)
    # By its definition, with the determinant of the prior predictive.
    both = information + np.eye(len(information))
    value = 0.5 * slope[:, 0] @ np.linalg.solve(both, slope[:, 0]) - 0.5 * np.linalg.slogdet(both)[1]
    assert together.log_bayes_factors(slope, (1.0,))[0, 0] == pytest.approx(value)
