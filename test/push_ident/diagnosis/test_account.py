"""The account of a gap: parts that add up, each as large as what the world has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import NOISE, TRUTH, account_of_parts, gap_of, simulated_pushes
from push_ident.diagnosis.account import Account, account_of
from push_ident.diagnosis.fits import fit_base, fit_effects
from push_ident.diagnosis.held_out import measure_gap
from push_ident.diagnosis.policy import AccountPolicy, ValidationPolicy
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.geometry.cells import cell_error
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.observing.observation import Observation, observe_push
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import Float64Array, PushRecord


def account_by(base: Fit, *added: str) -> Account:
    """The account of the pushes of a base fit, by a model with the `added` effects."""
    fit = fit_effects(base, added, np.array([1.0, 0.0])) if added else base
    return account_of(measure_gap(base, fit, ValidationPolicy()), base.problem, AccountPolicy())


def account_without_effects(n: int, seed: int, noise: Float64Array = NOISE) -> Account:
    """The account of some pushes in a world without effects."""
    return account_by(fit_base(simulated_pushes(n, seed, noise=noise), DiagnosisSettings()))


@pytest.fixture(scope="module")
def base_of_tilted() -> Fit:
    """The base model, fitted to pushes on a tilted table."""
    return fit_base(simulated_pushes(8, 1, {"table_tilt": [0.02, 0.0]}), DiagnosisSettings())


@pytest.fixture(scope="module")
def tilted(base_of_tilted: Fit) -> Account:
    return account_by(base_of_tilted, "table_tilt")


def test_parts_add_up_to_the_error_of_the_base_model_for_every_push(tilted: Account) -> None:
    np.testing.assert_allclose(sum(tilted.per_push.values()), tilted.gap.before, atol=1e-15)
    assert sum(part.mean for part in tilted.parts) == pytest.approx(tilted.before, abs=1e-15)
    assert [part.name for part in tilted.parts] == ["noise", "maps", "model", "table_tilt", "unexplained"]
    assert all(part.interval[0] < part.mean < part.interval[1] for part in tilted.parts)


def test_effect_that_is_there_has_its_part_and_leaves_nothing_unexplained(tilted: Account) -> None:
    assert tilted["table_tilt"].mean > 0.5 * tilted.before and tilted["table_tilt"].interval[0] > 0.0
    assert not tilted.is_unexplained


def test_effect_that_the_model_lacks_is_unexplained(base_of_tilted: Fit, tilted: Account) -> None:
    lacking = account_by(base_of_tilted)
    assert lacking.is_unexplained and not lacking.is_within_chance and lacking.effects == ()
    # What the effect closes is what was unexplained without it, up to what the maps then absorb.
    assert lacking["unexplained"].mean == pytest.approx(tilted["table_tilt"].mean, rel=0.4)


def test_noise_has_the_part_that_known_noise_makes() -> None:
    """Against other draws of the noise in the true world: pushes from displaced first poses, ends displaced as the mean of a rest is."""
    records = simulated_pushes(8, 2)
    account = account_without_effects(8, 2)
    rng, errors = np.random.default_rng(5), []
    for record in records:
        observed = observe_push(record)
        n_first, n_last = (np.count_nonzero(np.abs(record.poses.time - end) <= 0.5 * length) for end, length in rests(observed, record))
        scenario = PushScenario(record.pusher, observed.pose[0], observed.time[-1:], record.order)
        end = simulate(TRUTH, scenario).pose[-1]
        for _ in range(20):
            first = observed.pose[0] + NOISE / np.sqrt(n_first) * rng.normal(size=3)
            moved = simulate(TRUTH, replace(scenario, pose_object_in_table=first)).pose[-1]
            errors.append(cell_error(record.shape.cells, moved + NOISE / np.sqrt(n_last) * rng.normal(size=3), end))
    assert account["noise"].mean == pytest.approx(np.mean(errors), rel=0.35)
    assert not account.is_unexplained and account["noise"].mean > account["maps"].mean > account["model"].mean


def rests(observed: Observation, record: PushRecord) -> tuple[tuple[float, float], tuple[float, float]]:
    """Mean time and length of the two rests of a push [s]: a rest begins or ends with the record."""
    first, last = observed.time[0], observed.time[-1]
    return (first, 2 * (first - record.poses.time[0]) + 1e-6), (last, 2 * (record.poses.time[-1] - last) + 1e-6)


def test_few_pushes_leave_more_open_than_many_and_say_how_many_more_would_tell() -> None:
    few, many = (account_without_effects(n, 3, NOISE / 3) for n in (3, 8))
    assert few["maps"].mean > 2.0 * many["maps"].mean
    assert few.maps_are_open and few["maps"].mean > few["noise"].mean
    assert few.more_pushes is None or few.more_pushes > 1
    fewer_needed = replace(few.policy, max_maps_share=3.0 * few["maps"].mean / few["noise"].mean)
    assert not replace(few, policy=fewer_needed).maps_are_open


def test_effects_added_in_stages_have_a_part_each() -> None:
    gap = replace(gap_of([5e-3] * 4, [1e-3] * 4, 1e-3, names=("wear", "tether", "pusher_lag")), stages={"wear": np.full(4, 3e-3)})
    account = account_of_parts(gap, 1e-3, 0.0, 0.0)
    assert {part.name: part.mean for part in account.effects} == pytest.approx({"wear": 2e-3, "tether and pusher_lag": 2e-3})
    assert account["unexplained"].mean == pytest.approx(0.0)
    with pytest.raises(KeyError):
        account["table_tilt"]


def test_error_that_all_pushes_share_widens_the_interval_of_the_unexplained_part() -> None:
    account = account_of_parts(gap_of([2e-3, 2.1e-3] * 3, [2e-3, 2.1e-3] * 3, 1e-3), 1e-3, 5e-4, 1e-4)
    shared = replace(account, expected=replace(account.expected, shared_std=1e-3))
    assert account.is_unexplained and not shared.is_unexplained and shared.is_within_chance
    assert shared["noise"] == account["noise"]
