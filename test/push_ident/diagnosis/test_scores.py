"""Score tests of absent effects from one information matrix."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.scores import EffectInformation, score_effects
from push_ident.physics.effects import EFFECTS

POLICY = SelectionPolicy()


def information_of(**slopes: tuple[float, float]) -> EffectInformation:
    """Of effects with one parameter: precision of its unknown and slope of the cost."""
    places = {name: np.array([k]) for k, name in enumerate(slopes)}
    return EffectInformation(places, np.diag([p for p, _ in slopes.values()]), np.array([g for _, g in slopes.values()]))


def test_effects_are_ranked_by_the_log_bayes_factor_that_they_promise() -> None:
    scores = score_effects(information_of(wear=(2.0, 1.0), pose_latency=(101.0, -60.0)), POLICY)
    assert [score.name for score in scores] == ["pose_latency", "wear"]
    best = scores[0]
    assert best.expected_log_bayes_factor == pytest.approx(0.5 * 60.0**2 / 101.0 - 0.5 * np.log(101.0))
    np.testing.assert_allclose(best.start, [60.0 / 101.0])
    np.testing.assert_allclose(best.information, [[100.0]])
    assert score_effects(None, POLICY) == []


def test_smallest_detectable_size_brings_the_threshold_on_average() -> None:
    (score,) = score_effects(information_of(pose_latency=(101.0, 0.0)), POLICY)
    true = score.smallest_detectable / EFFECTS["pose_latency"].parameters[0].scale
    # A true value e makes a mean slope of -S e.
    (found,) = score_effects(information_of(pose_latency=(101.0, -100.0 * true)), POLICY)
    assert found.expected_log_bayes_factor == pytest.approx(POLICY.min_log_bayes_factor)
    (nothing,) = score_effects(information_of(pose_latency=(1.0, 0.0)), POLICY)
    assert nothing.smallest_detectable == np.inf
