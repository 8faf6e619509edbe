"""The arm's clock between its states."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.pushing.arm_clock import ArmClock


@pytest.mark.parametrize("rate", [0.3, 1.0, 3.0])
def test_jitter_of_the_receipt_is_averaged_whatever_the_rate(rate: float) -> None:
    rng, clock, errors = np.random.default_rng(1), ArmClock(), []
    for i in range(200):
        stamp = 50.0 + 0.01 * i
        clock.observe(7.0 + 0.01 * i / rate + 0.003 * rng.random(), stamp)
        if i > 50:
            errors.append(clock.at(7.0 + 0.01 * (i + 0.5) / rate + 0.003)[0] - (stamp + 0.005))
    assert np.std(errors) < 1.0e-3 * rate and abs(np.mean(errors)) < 2.5e-3 * rate
    assert clock.rate == pytest.approx(rate, rel=0.1)


def test_clock_of_a_paused_arm_stays_near_its_latest_stamp() -> None:
    clock = ArmClock()
    for i in range(50):
        clock.observe(0.01 * i, 10.0 + 0.01 * i)
    assert clock.at(5.0) == (pytest.approx(10.49 + 0.05), False)
    assert clock.at(0.49)[0] >= 10.49 and clock.at(0.49)[1]


@pytest.mark.parametrize("jump", [-3.0, 3.0])
def test_clock_that_is_set_is_followed_at_once(jump: float) -> None:
    clock = ArmClock()
    for i in range(50):
        clock.observe(0.01 * i, 10.0 + 0.01 * i)
    clock.observe(0.5, 10.5 + jump)
    assert clock.at(0.5)[0] == pytest.approx(10.5 + jump)


def test_first_state_sets_the_clock() -> None:
    clock = ArmClock()
    clock.observe(1.0, 20.0)
    assert clock.at(1.01)[0] == pytest.approx(20.01) and clock.rate == 1.0
