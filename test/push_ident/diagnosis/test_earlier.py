"""A diagnosis of one more push starts from the one before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.earlier import EarlierFits
from push_ident.diagnosis.fits import fit_base
from push_ident.diagnosis.held_out import HeldOutFits, folds_of
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.fitting.fit import Fit
from push_ident.types import PushRecord

SETTINGS = DiagnosisSettings()
N = 5


@pytest.fixture(scope="module")
def records() -> list[PushRecord]:
    return simulated_pushes(N + 1, 1)


@pytest.fixture(scope="module")
def before(records: list[PushRecord]) -> tuple[Fit, HeldOutFits]:
    base, held_out = fit_base(records[:N], SETTINGS), HeldOutFits()
    held_out.of([base], folds_of(N, N))
    return base, held_out


def n_simulations(fits: HeldOutFits) -> int:
    return sum(fit.problem.meter.n_simulations for fit, _ in fits.fits)


def test_fits_with_one_more_push_take_less_and_end_as_well(records: list[PushRecord], before: tuple[Fit, HeldOutFits]) -> None:
    earlier = EarlierFits.of(records, [before[0]], before[1].fits)
    cold, warm = fit_base(records, SETTINGS), fit_base(records, SETTINGS, earlier)
    assert warm.log_evidence == pytest.approx(cold.log_evidence, abs=0.5)
    fits = [HeldOutFits(), HeldOutFits(earlier)]
    first, again = (own.of([cold], folds_of(N + 1, N + 1))[0] for own in fits)
    assert n_simulations(fits[1]) < 0.8 * n_simulations(fits[0])
    np.testing.assert_allclose([own.log_density for own in again], [own.log_density for own in first], atol=0.7)


def test_fit_without_a_push_starts_where_one_without_it_ended(records: list[PushRecord], before: tuple[Fit, HeldOutFits]) -> None:
    base, held_out = before
    earlier = EarlierFits.of(records, [base], held_out.fits)
    now = fit_base(records, SETTINGS, earlier)
    scale = base.unknowns.amplitude_unit(base.amplitude / now.amplitude)
    without = {fold: fit for fit, fold in held_out.fits}
    n_z, start = now.unknowns.size, earlier.start(now, [2])
    assert start is not None
    np.testing.assert_array_equal(start, np.r_[without[2,].z * scale, without[2,].x[n_z:], np.zeros(3)])
    # All earlier pushes are outside the fold of the new one.
    np.testing.assert_array_equal(earlier.start(now, [N]), np.r_[base.z * scale, base.x[n_z:]])
    assert earlier.start(now, [2, 3]) is None


def test_other_pushes_are_no_start(records: list[PushRecord], before: tuple[Fit, HeldOutFits]) -> None:
    base, held_out = before
    moved = replace(records[0], pusher=replace(records[0].pusher, position=records[0].pusher.position + 1e-4))
    for others in ([moved, *records[1:]], records[1:], records[: N - 1]):
        assert EarlierFits.of(others, [base], held_out.fits).n_pushes == 0
