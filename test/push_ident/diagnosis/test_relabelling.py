"""What a change since a reference gains by chance."""

from __future__ import annotations

import numpy as np

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.fits import fit_base, fit_with_reference
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.relabelling import gains_by_chance
from push_ident.diagnosis.settings import DiagnosisSettings

POLICY = SelectionPolicy()


def test_without_a_reference_nothing_is_relabelled() -> None:
    assert gains_by_chance(fit_base(simulated_pushes(4, 5), DiagnosisSettings()), POLICY) == {}


def test_pushes_of_a_right_model_gain_next_to_nothing() -> None:
    fit = fit_with_reference(simulated_pushes(5, 5), simulated_pushes(5, 6), DiagnosisSettings())
    gains = gains_by_chance(fit, POLICY)
    assert gains and all(0.0 <= gain < POLICY.min_log_bayes_factor for gain in gains.values())


def test_what_differs_among_the_pushes_of_both_recordings_is_no_evidence_of_a_change() -> None:
    """Every other push of both recordings lies on a tilted table: any half of them is fitted better by a tilt."""
    level, tilted = simulated_pushes(12, 5), simulated_pushes(12, 5, {"table_tilt": [0.04, 0.0]})
    mixed = [tilted[push] if push % 2 else level[push] for push in range(12)]
    gains = gains_by_chance(fit_with_reference(mixed[:6], mixed[6:], DiagnosisSettings()), POLICY)
    assert gains["table_tilt"] > 5.0
    assert gains["table_tilt"] > 3.0 * np.median(list(gains.values()))
