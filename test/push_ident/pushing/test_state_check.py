"""An arm is only where it can have gone."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.pushing.state_intake import StateCheck


def moving() -> StateCheck:
    """Two joints of up to 3 rad/s that have moved for a second at 2 rad/s."""
    check = StateCheck([-2.0, -3.0], [2.0, 3.0], [3.0, 3.0])
    for i in range(100):
        check.check(0.01 * i, 0.01 * i, np.array([0.02 * i - 1.0, 0.0]))
    return check


@pytest.mark.parametrize("q", [[1e300, 0.0], [1.0, -1e300], [1.0, 3.2], [-2.2, 0.0]])
def test_joint_beyond_its_limits_is_refused_however_often_it_comes(q: list[float]) -> None:
    check = moving()
    for i in range(10):
        with pytest.raises(InputError, match="expected"):
            check.check(1.0 + 0.01 * i, 1.0 + 0.01 * i, np.array(q))
    check.check(1.1, 1.1, np.array([1.05, 0.0]))


def test_jump_is_refused_and_the_next_true_state_is_taken() -> None:
    check = moving()
    with pytest.raises(InputError, match="joint 2 is 0.9 rad from where it was"):
        check.check(1.0, 1.0, np.array([1.0, 0.9]))
    with pytest.raises(InputError):
        check.check(1.01, 1e9, np.array([-1.5, 0.0]))
    check.check(1.02, 1.02, np.array([1.02, 0.0]))


def test_arm_that_was_moved_meanwhile_is_believed_after_a_second_of_states_that_agree() -> None:
    check = moving()
    for i in range(100):
        with pytest.raises(InputError):
            check.check(1.0 + 0.01 * i, 1.0 + 0.01 * i, np.array([-1.0, 2.0]))
    check.check(2.0, 2.0, np.array([-1.0, 2.0]))
    check.check(2.01, 2.01, np.array([-1.0, 2.01]))


def test_wrong_states_among_true_ones_are_never_believed() -> None:
    check = moving()
    for i in range(300):
        q = [1.0, 0.0] if i % 5 == 0 else [-1.0 if i % 2 else -2.0, 2.0]
        if i % 5:
            with pytest.raises(InputError):
                check.check(1.0 + 0.01 * i, 1.0 + 0.01 * i, np.array(q))
        else:
            check.check(1.0 + 0.01 * i, 1.0 + 0.01 * i, np.array(q))


def test_states_that_a_busy_node_takes_in_together_are_judged_by_their_stamps() -> None:
    check = moving()
    check.check(1.0, 1.1, np.array([1.2, 0.0]))
    check.check(1.0, 1.2, np.array([1.4, 0.0]))
