"""The smooth wrench of unknown cause."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from push_ident.diagnosis.policy import UnknownPolicy
from push_ident.diagnosis.scores import EffectInformation, clipped_start
from push_ident.diagnosis.unknown import SmoothWrench, best_parts
from push_ident.diagnosis.wording import describe_wrench
from push_ident.physics.effects import EFFECTS


def test_wrench_of_many_parts_is_limited_to_the_best_of_them() -> None:
    """The one-step estimate may support all 24 parts."""
    n = len(EFFECTS["unknown_wrench"].parameters)
    information = EffectInformation({"unknown_wrench": np.arange(n)}, 1e4 * np.eye(n), -1e4 * np.linspace(0.5, 1.5, n))
    parts, expected = best_parts(information, UnknownPolicy())
    assert len(parts) == UnknownPolicy().max_parts and expected > 0
    assert ("turning", "heading in the object") in parts and ("along", "even") not in parts


def test_parts_that_bring_less_than_they_cost_are_left_out() -> None:
    n = len(EFFECTS["unknown_wrench"].parameters)
    nothing = EffectInformation({"unknown_wrench": np.arange(n)}, np.eye(n), np.zeros(n))
    assert best_parts(nothing, UnknownPolicy()) == ([], pytest.approx(0.0))


def test_wrench_is_described_by_its_large_parts() -> None:
    wrench = SmoothWrench(cast(Any, None), 20.0, {"along": 0.9, "torque": 0.1}, {"even": 0.3, "speed": 0.7, "place": 0.0})
    assert describe_wrench(wrench, UnknownPolicy()) == "acts as a force along the motion, and varies with the speed"


def test_one_step_estimate_is_clipped_along_its_direction() -> None:
    np.testing.assert_allclose(clipped_start(np.array([3.0, 4.0]), 2.0), [1.2, 1.6])
    np.testing.assert_array_equal(clipped_start(np.array([0.3, 0.4]), 2.0), [0.3, 0.4])
