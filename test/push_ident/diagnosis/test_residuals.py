"""Standardized residuals, and the noise that they are compared with."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from helpers.diagnosis import frame_residuals, simulated_pushes
from push_ident.diagnosis.policy import ResidualPolicy
from push_ident.diagnosis.residuals import draw_noise, group_residuals
from push_ident.identification.observing.observation import NoiseModel, observe_push

N_DRAWS = ResidualPolicy().draws


def test_correlated_noise_is_drawn_as_small_as_its_whitening_makes_it() -> None:
    rho, n = 0.6, 40
    observation = SimpleNamespace(time=np.zeros(n), correlation=rho, whitening=np.tile(np.eye(3), (n, 1, 1)), shared=np.zeros((n, 3, 0)))
    drawn = draw_noise(cast(Any, observation), np.random.default_rng(5), N_DRAWS)[:, 1:-1]
    # Frames are smaller by (1 - rho) / (1 + rho), and their mean is as uncertain as that of independent frames of unit variance.
    assert float(np.var(drawn)) == pytest.approx((1 - rho) / (1 + rho), rel=0.03)
    assert float(np.mean(drawn[:, 1:] * drawn[:, :-1]) / np.var(drawn)) == pytest.approx(rho, abs=0.02)
    assert float(np.var(drawn.mean(axis=1))) * drawn.shape[1] == pytest.approx(1.0, rel=0.15)


def test_model_discrepancy_is_drawn_once_a_push_and_grows_with_the_travel() -> None:
    (record,) = simulated_pushes(1, 1)
    observation = observe_push(record, NoiseModel(discrepancy_modes=20, model_discrepancy_position=0.5, model_discrepancy_yaw=0.0))
    deviation, _, of_yaw = observation.discrepancy[-1]
    assert deviation == pytest.approx(0.5 * np.linalg.norm(observation.pose[-1, :2] - observation.pose[0, :2]), rel=0.3)
    assert of_yaw == 0.0 and not observation.discrepancy[0].any()
    noise = draw_noise(observation, np.random.default_rng(5), N_DRAWS)
    drawn = np.einsum("fij,dfj->dfi", np.linalg.inv(observation.whitening), noise)
    np.testing.assert_allclose(drawn[:, -1, :2].std(axis=0), deviation, rtol=0.15)
    assert np.corrcoef(drawn[:, -1, 0], drawn[:, -2, 0])[0, 1] > 0.95 > 0.2 > abs(np.corrcoef(drawn[:, -1, 2], drawn[:, -2, 2])[0, 1])


def test_residual_ratio_is_that_of_variances_overall_and_of_single_pushes_whose_groups_name_the_largest() -> None:
    noise = np.random.default_rng(2).normal(size=(14, 30, 3))
    noise[3] *= 2.0
    residuals = frame_residuals(noise)
    ratio, p_value = residuals.residual_ratio()
    assert ratio == pytest.approx(1.0 + 3.0 / 14.0, abs=0.05) and p_value < 0.003
    pushes = group_residuals(residuals, ResidualPolicy())["push"]
    assert [group.name for group in pushes] == [str(push) for push in range(14)]
    assert max(pushes, key=lambda group: group.rms).name == "3" and max(pushes[3].p_value) == 0.0 and min(pushes[0].p_value) > 0.01


def test_noise_has_no_excess_autocorrelation_and_a_missing_effect_has() -> None:
    rng = np.random.default_rng(2)
    noise, slow = rng.normal(size=(14, 30, 3)), np.sin(np.linspace(0.0, 9.0, 30))[:, None] * np.ones((14, 1, 3))
    excess, p_value = frame_residuals(noise).excess_autocorrelation()
    assert abs(excess) < 0.1 and p_value > 0.01
    excess, p_value = frame_residuals(noise + 0.8 * slow).excess_autocorrelation()
    assert excess == pytest.approx(0.8**2 * float(np.mean(slow**2)), abs=0.1) and p_value < 0.003
    # Of two frames a push the second is the rest that ends it.
    assert frame_residuals(noise[:, :2]).excess_autocorrelation() == (0.0, 1.0)
