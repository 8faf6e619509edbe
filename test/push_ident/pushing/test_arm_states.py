"""What arm and hand report: where an arm can have gone, its clock between states, how far it is from its path, when a hand is a fist."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.pushing.arm_clock import ArmClock
from push_ident.pushing.arm_motion import nearest_on_path
from push_ident.pushing.hand import HandState
from push_ident.pushing.state_intake import StateCheck, no_positions

# --- which states are believed


@pytest.fixture
def check() -> StateCheck:
    """Two joints of up to 3 rad/s that have moved for a second at 2 rad/s."""
    check = StateCheck([-2.0, -3.0], [2.0, 3.0], [3.0, 3.0])
    for i in range(100):
        check.check(0.01 * i, 0.01 * i, np.array([0.02 * i - 1.0, 0.0]))
    return check


@pytest.mark.parametrize("q", [[1e300, 0.0], [1.0, -1e300], [1.0, 3.2], [-2.2, 0.0]])
def test_joint_beyond_its_limits_is_refused_however_often_it_comes(check: StateCheck, q: list[float]) -> None:
    for i in range(10):
        with pytest.raises(InputError, match="expected"):
            check.check(1.0 + 0.01 * i, 1.0 + 0.01 * i, np.array(q))
    check.check(1.1, 1.1, np.array([1.05, 0.0]))


def test_jump_is_refused_and_the_next_true_state_is_taken(check: StateCheck) -> None:
    with pytest.raises(InputError, match="joint 2 is 0.9 rad from where it was"):
        check.check(1.0, 1.0, np.array([1.0, 0.9]))
    with pytest.raises(InputError):
        check.check(1.01, 1e9, np.array([-1.5, 0.0]))
    check.check(1.02, 1.02, np.array([1.02, 0.0]))


def test_arm_that_was_moved_meanwhile_is_believed_after_a_second_of_states_that_agree(check: StateCheck) -> None:
    for i in range(100):
        with pytest.raises(InputError):
            check.check(1.0 + 0.01 * i, 1.0 + 0.01 * i, np.array([-1.0, 2.0]))
    check.check(2.0, 2.0, np.array([-1.0, 2.0]))
    check.check(2.01, 2.01, np.array([-1.0, 2.01]))


def test_wrong_states_among_true_ones_are_never_believed(check: StateCheck) -> None:
    for i in range(300):
        now = 1.0 + 0.01 * i
        if i % 5 == 0:
            check.check(now, now, np.array([1.0, 0.0]))
            continue
        with pytest.raises(InputError):
            check.check(now, now, np.array([-1.0 if i % 2 else -2.0, 2.0]))


def test_states_that_a_busy_node_takes_in_together_are_judged_by_their_stamps(check: StateCheck) -> None:
    check.check(1.0, 1.1, np.array([1.2, 0.0]))
    check.check(1.0, 1.2, np.array([1.4, 0.0]))


# --- clock


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


def test_clock_of_a_paused_arm_stays_near_its_latest_stamp_and_one_that_is_set_is_followed_at_once() -> None:
    clock = ArmClock()
    clock.observe(0.0, 10.0)
    assert clock.at(0.01)[0] == pytest.approx(10.01) and clock.rate == 1.0
    for i in range(1, 50):
        clock.observe(0.01 * i, 10.0 + 0.01 * i)
    assert clock.at(5.0) == (pytest.approx(10.49 + 0.05), False)
    assert clock.at(0.49)[0] >= 10.49 and clock.at(0.49)[1]
    for now, stamp in ((0.5, 13.5), (0.51, 10.5)):
        clock.observe(now, stamp)
        assert clock.at(now)[0] == pytest.approx(stamp)


# --- path


@pytest.mark.parametrize(
    ("point", "distance", "index"),
    [((0.25, 0.0, 0.5), 0.5, 0.25), ((1.5, 1.0, 0.0), 0.5, 1.5), ((-3.0, 0.0, 4.0), 5.0, 0.0), ((1.0, 3.0, 0.0), 1.0, 2.0)],
)
def test_nearest_point_of_a_path(point: tuple[float, float, float], distance: float, index: float) -> None:
    corner = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0]])
    assert nearest_on_path(corner, np.array(point)) == pytest.approx((distance, index))
    assert nearest_on_path(corner[1:2], np.array([1.0, 0.0, 2.0])) == (2.0, 0.0), "a single point is a path"


FIST = HandState(activated=True, mode=0, going=True, readiness=3, motion=2, fault=0, request=255)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({}, ""),
        ({"motion": 3}, ""),
        ({"motion": 0}, "moving"),
        ({"fault": 0x0D}, "0x0D"),
        ({"activated": False}, "not activated"),
        ({"readiness": 1}, "not activated"),
        ({"mode": 1}, "mode 1"),
        ({"request": 120}, "open"),
        ({"going": False}, "open"),
    ],
)
def test_hand_is_a_fist_only_when_closed_still_and_without_fault(change: dict[str, int], text: str) -> None:
    reason = replace(FIST, **change).why_no_fist
    assert text in reason and bool(reason) == bool(text)


def test_joints_without_numbers_are_told_from_joints_with_other_names() -> None:
    text = no_positions(["elbow", "wrist\n1"])
    assert text.startswith("positions are not numbers (NaN): the driver has no data of the arm yet") and "elbow, wrist" in text
    assert "\n" not in text and "names" not in text
