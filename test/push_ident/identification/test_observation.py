"""Condensed pushes: how errors of the poses are correlated, and single wrong poses at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import simulated_pushes, with_correlated_noise
from push_ident.identification.observing.observation import NoiseModel, noise_correlation, observe_push


@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_correlation_of_noise_is_measured_at_rest_and_makes_means_less_precise(rho: float) -> None:
    records = with_correlated_noise(simulated_pushes(14, 1), rho, 2)
    measured = noise_correlation(records)
    assert measured == pytest.approx(rho, abs=0.2)
    correlated, white = (observe_push(records[0], noise) for noise in (NoiseModel(correlation=max(measured, 0.0)), NoiseModel()))
    ratio = correlated.last_covariance[0, 0] / white.last_covariance[0, 0]
    assert (2.0 < ratio < 5.0) if rho else ratio == pytest.approx(1.0, abs=0.35)


def test_one_wrong_pose_at_rest_does_not_move_the_rest_pose() -> None:
    record = simulated_pushes(1, 1)[0]
    pose = record.poses.pose.copy()
    pose[2, 2] += np.pi
    spoilt = observe_push(replace(record, poses=replace(record.poses, pose=pose)))
    assert np.abs(spoilt.pose[0] - observe_push(record).pose[0]).max() < 3e-3
