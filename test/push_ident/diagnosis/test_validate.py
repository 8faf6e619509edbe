"""What held-out pushes confirm, and when the cause is unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import frame_residuals, stub_fit
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.policy import UnknownPolicy, ValidationPolicy
from push_ident.diagnosis.selection import Selection, Step
from push_ident.diagnosis.state import UnsupportedEffect
from push_ident.diagnosis.validate import failed_tests, supported_selection


@pytest.mark.parametrize(
    ("log_bayes_factors", "kept", "unsupported"),
    [
        ([[5.0, 9.0, 4.0], [3.0, 7.0, 2.0]], ("pusher_lag", "wear"), None),
        ([[5.0, 9.0, 4.0], [3.0, -1.5, 2.0]], ("pusher_lag",), UnsupportedEffect("wear", (1, 4))),
        ([[5.0, 9.0, -2.0], [3.0, -1.5, 2.0]], (), UnsupportedEffect("pusher_lag", (2,))),
    ],
)
def test_effect_that_one_push_supports_is_rejected_with_all_after_it(
    log_bayes_factors: list[list[float]], kept: tuple[str, ...], unsupported: UnsupportedEffect | None
) -> None:
    base, lag, both = stub_fit(), stub_fit("pusher_lag"), stub_fit("pusher_lag", "wear")
    selection = Selection(base, both, tuple(Step(fit, None, (), ()) for fit in (base, lag, both)))
    zero, policy = np.zeros(5), ValidationPolicy()
    folds = ((0, 3), (1, 4), (2,))
    gap = Gap(zero, zero, zero, np.ones(3), np.zeros((3, 2)), folds, np.array(log_bayes_factors))
    supported, found = supported_selection(selection, gap, policy)
    assert supported.selected == kept and found == unsupported
    assert unsupported is None or len(supported.steps) == len(kept) + 1
    # What predicts held-out pushes worse is rejected, whatever its evidence.
    worse = replace(gap, log_density_gain=-np.ones(3))
    assert supported_selection(selection, worse, policy)[0].selected == ()
    neither = Selection(base, base, selection.steps[:1])
    assert supported_selection(neither, replace(worse, log_bayes_factor_without=np.zeros((0, 3))), policy) == (neither, None)


def test_residuals_that_are_larger_or_smoother_than_noise_show_something_unknown() -> None:
    rng = np.random.default_rng(2)
    noise, slow = rng.normal(size=(14, 30, 3)), np.sin(np.linspace(0.0, 9.0, 30))[:, None] * np.ones((14, 1, 3))
    right, smooth, large = frame_residuals(noise), frame_residuals(0.8 * noise + 0.6 * slow), frame_residuals(1.2 * noise)
    policy = UnknownPolicy()
    assert not failed_tests(right, right, policy, correlation_std=0.01)
    assert failed_tests(right, smooth, policy, correlation_std=0.01)
    assert failed_tests(right, large, policy, correlation_std=0.01)
    # What a few frames at rest cannot exclude may be correlated noise.
    assert not failed_tests(right, smooth, policy, correlation_std=0.2)
    # Errors of a camera depend on the pose, so that they are as smooth; beside a strong effect its law may leave as much.
    assert not failed_tests(right, smooth, policy, correlation_std=np.inf)
    assert not failed_tests(frame_residuals(5.0 * noise), smooth, policy, correlation_std=0.01)
