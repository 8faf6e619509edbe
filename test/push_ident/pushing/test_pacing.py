"""Pieces of a motion: what the arm makes of them, whenever they come."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from push_ident.pushing.pacing import PathPacing
from push_ident.pushing.trajectory import JointTrajectory, join, joint_move, path_at_speed, stand_still
from push_ident.types import Float64Array
from push_ident_sim.cell.trajectory import JointTrajectory as Followed

LIMIT = np.array([10.0, 6.0, 8.0])
HORIZON = 0.08
PERIOD = 0.02
ONE_SAMPLE = 0.01


def make_plan() -> JointTrajectory:
    """A free move, a pause, a bent path at constant speed with ramps near the limits, and a pause."""
    start, above = np.array([0.3, -0.2, 0.5]), np.array([-0.4, 0.6, 0.2])
    free = joint_move(start, above, np.array([1.3, 1.3, 1.3]), 0.5 * LIMIT)
    share = np.linspace(0.0, 1.0, 30)[:, None]
    bent = above + share * np.array([0.3, -0.2, 0.1]) + 0.05 * np.sin(np.pi * share) * np.array([0.0, 1.0, -1.0])
    push = path_at_speed(bent, 0.12, 0.15, 2.0)
    return join([free, stand_still(above, 0.2), push, stand_still(bent[-1], 0.3)])


PLAN = make_plan()


def made_by_arm(sends: list[float], *, delay: float = 0.0, end: float | None = None) -> tuple[PathPacing, Float64Array, Float64Array]:
    """Send pieces at given times to an arm as ros2_control makes one; times from 0 [s], (n,), and joints [rad], (n, 3)."""
    pacing, followed = PathPacing(PLAN, LIMIT, HORIZON, 0.0), Followed.hold(PLAN.position[0])
    last = sends[-1] + 0.5 if end is None else end
    times, joints = np.arange(0.0, last, 0.001), []
    ahead = [(t, t + delay) for t in sends]
    for now in times:
        while ahead and ahead[0][1] <= now + 1e-12:
            sent, received = ahead.pop(0)
            piece = pacing.piece(sent)
            followed = Followed(piece.time, piece.position, piece.velocity).from_state(received, *followed.sample(received))
        joints.append(followed.sample(now)[0])
    return pacing, times, np.array(joints)


def regular(until: float) -> list[float]:
    return [float(t) for t in np.arange(0.0, until, PERIOD)]


def at(path_time: Float64Array) -> Float64Array:
    return PLAN.follow(path_time)[0]


def test_pieces_in_time_make_the_planned_motion() -> None:
    pacing, time, q = made_by_arm(regular(PLAN.duration), delay=0.003, end=PLAN.duration + 0.1)
    assert pacing.is_complete and pacing.time_of(PLAN.duration) == pytest.approx(PLAN.duration)
    assert q == pytest.approx(at(time - 0.003), abs=2e-4)
    speed = np.diff(q, axis=0) / 0.001
    assert np.abs(speed - np.diff(at(time - 0.003), axis=0) / 0.001).max() < 0.05


@given(st.floats(0.0, 1.0))
@settings(max_examples=15, deadline=None)
def test_without_another_piece_the_arm_stands_on_its_path_within_the_horizon_and_braking(share: float) -> None:
    last = share * PLAN.duration
    pacing, time, q = made_by_arm([*regular(last), last])
    stands = np.flatnonzero(np.abs(np.diff(q, axis=0)).max(axis=1) > 1e-9)
    still = time[stands[-1] + 1] - last if len(stands) else 0.0
    around = (PLAN.time > last - 0.05) & (PLAN.time < last + HORIZON + 0.15)
    speed = np.abs(PLAN.velocity[around]).max(axis=0, initial=0.0)
    # Room for braking is what the plan itself leaves of the limit.
    slowest = max(float(np.max(speed / (LIMIT - np.abs(PLAN.acceleration).max(axis=0)))), 0.03)
    assert still < HORIZON + slowest + 2 * ONE_SAMPLE
    # On the path: the end is a posture of the plan.
    assert np.abs(PLAN.position - q[-1]).max(axis=1).min() < 1.3 * ONE_SAMPLE
    assert q[-1] == pytest.approx(PLAN.follow(np.array([pacing.path_time(math.inf)]))[0][0], abs=1e-3)
    piece = PathPacing(PLAN, LIMIT, HORIZON, 0.0).piece(last)
    steps = np.diff(piece.velocity, axis=0) / np.diff(piece.time)[:, None]
    assert np.all(np.abs(steps) <= 1.15 * LIMIT), "braking keeps the acceleration limits of the joints"
    assert np.all(piece.velocity[-1] == 0.0) and np.all(np.diff(piece.time) > 0) and piece.time[0] > 0


@given(st.lists(st.tuples(st.floats(0.1, 0.9), st.floats(0.0, 0.6)), max_size=4))
@settings(max_examples=8, deadline=None)
def test_late_pieces_make_the_arm_wait_on_its_path_and_go_on(stutters: list[tuple[float, float]]) -> None:
    sends, now = [], 0.0
    pauses = sorted((share * PLAN.duration, length) for share, length in stutters)
    end = PLAN.duration + sum(length for _, length in pauses) + 1.0
    while now < end:
        sends.append(now)
        now += PERIOD
        if pauses and now >= pauses[0][0]:
            now += pauses.pop(0)[1]
    pacing, time, q = made_by_arm(sends)
    assert q[-1] == pytest.approx(PLAN.position[-1], abs=1e-6)
    path_time = np.array([pacing.path_time(t) for t in time])
    assert np.all(np.diff(path_time) >= -1e-12) and path_time[-1] == PLAN.duration
    assert np.all(np.diff(path_time) <= 0.001 + 1e-9)  # never faster than planned
    assert q == pytest.approx(at(path_time), abs=2e-3)
    acceleration = np.diff(q, 2, axis=0) / 1e-6
    smooth = np.abs(acceleration[:-1] + acceleration[1:]) / 2
    assert np.all(smooth <= 2.0 * LIMIT)
    for s in np.linspace(0.0, PLAN.duration, 50):
        assert pacing.path_time(pacing.time_of(s)) == pytest.approx(s, abs=1e-6)


def test_halt_is_one_point_on_the_path_at_which_the_arm_stands_sooner_than_by_itself() -> None:
    pacing = PathPacing(PLAN, LIMIT, HORIZON, 0.0)
    for now in regular(0.6):
        piece = pacing.piece(now)
    halt = pacing.halt(0.59)
    assert len(halt.time) == 1 and np.all(halt.velocity == 0.0)
    assert 0.59 + halt.time[0] < 0.58 + piece.time[-1] - 0.5 * HORIZON
    assert np.abs(PLAN.position - halt.position).max(axis=1).min() < 1.3 * ONE_SAMPLE
    assert pacing.path_time(10.0) < pacing.path_time(0.59) + 0.2 and not pacing.is_complete
    assert pacing.time_of(PLAN.duration) == math.inf
