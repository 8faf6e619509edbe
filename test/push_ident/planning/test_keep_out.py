"""What must not be touched: distances, clearances from stated uncertainties, and the way round."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import square
from push_ident.geometry.outline import dense, signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.planning.goal import Goal
from push_ident.planning.keep_out import KeepOut, WayRound, distance_between, overlapping, risk_of
from push_ident.planning.obstacle import DEVIATIONS, RISK, Obstacle, clearance
from push_ident.pushing.push import PushSettings
from push_ident.types import CellGrid, Float64Array, ObjectShape

SETTINGS = PushSettings(workspace=(-0.4, 0.4, -0.4, 0.4), pusher_radius=0.008, clearance=0.02)
SQUARE = square(6, 0.01)
BAR = ObjectShape(CellGrid(np.zeros((1, 2)), 0.02), np.array([[-0.1, -0.01], [0.1, -0.01], [0.1, 0.01], [-0.1, 0.01]]))


def block(x0: float, y0: float, x1: float, y1: float) -> Float64Array:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def test_distance_of_two_outlines_is_that_of_the_polygons_and_negative_where_they_cross() -> None:
    rng, other = np.random.default_rng(1), block(-0.05, -0.02, 0.05, 0.02)
    poses = np.column_stack([rng.uniform(-0.12, 0.12, (400, 2)), rng.uniform(-np.pi, np.pi, 400)])
    gaps, exact = KeepOut(SQUARE, [other], SETTINGS).gaps(poses.reshape(20, 20, 3)).ravel(), []
    for pose in poses:
        outline = transform_points(pose, SQUARE.outline)
        exact.append(min(np.min(signed_distance(dense(outline, 1e-3), other)), np.min(signed_distance(dense(other, 1e-3), outline))))
    apart = np.array(exact) > 0.0
    assert 50 < np.count_nonzero(apart) < 350
    assert np.max(np.abs(gaps - exact)[apart & (gaps < 0.05)]) < 1.5e-3
    assert np.all(gaps[~apart] < 1.5e-3)
    # A cross: no corner of one is in the other.
    assert KeepOut(BAR, [block(-0.01, -0.1, 0.01, 0.1)], SETTINGS).gaps(np.zeros(3)) < 0.0
    assert distance_between(BAR.outline, block(-0.01, -0.1, 0.01, 0.1)) < 0.0
    assert KeepOut(BAR, [other], SETTINGS).gaps(np.array([np.nan, 0.0, 0.0])) == -np.inf


def test_clearance_holds_the_points_of_an_outline_as_often_as_stated() -> None:
    std = np.array([2e-3, 1e-3, 0.02])
    wide, rng = clearance(BAR.outline, np.diag(std**2)), np.random.default_rng(2)
    # The corner at the end of the bar, and the direction in which its place is least certain.
    errors = rng.normal(size=(40_000, 3)) * std
    moved = errors[:, 0] - 0.01 * errors[:, 2], errors[:, 1] + 0.1 * errors[:, 2]
    worst = max(float(np.mean(direction > wide)) for direction in moved)
    assert worst <= RISK, "on one side"
    assert wide < 1.3 * DEVIATIONS * np.hypot(1e-3, 0.1 * 0.02), "and not much wider than needed"
    grown = Obstacle.of_object("o2", BAR.outline, np.array([0.1, 0.0, 0.0]), np.diag(std**2))
    assert grown.name == "`o2`" and grown.outline[:, 0].max() == pytest.approx(0.2 + wide, abs=2e-3)
    assert overlapping(SQUARE.outline, np.array([0.2, 0.0, 0.0]), [grown]) == ["`o2`"]
    assert overlapping(SQUARE.outline, np.array([0.1, 0.1, 0.0]), [grown]) == []


def test_risk_is_that_of_a_normal_distribution_and_counts_models_that_enter() -> None:
    rng = np.random.default_rng(3)
    least = 0.006 + 0.003 * rng.normal(size=(4000, 1))
    assert risk_of(least, np.full((4000, 1), 0.05))[0] == pytest.approx(0.0228, abs=0.005)  # two deviations
    assert risk_of(np.full((9, 1), 0.006), np.full((9, 1), 0.05), 0.003)[0] == pytest.approx(0.0255, abs=0.002)
    one_enters = np.full((9, 1), 0.05)
    one_enters[4] = -0.01
    assert risk_of(one_enters, np.full((9, 1), 0.05))[0] >= 1.0 / 9.0
    one_enters[4] = -np.inf
    assert risk_of(one_enters, np.full((9, 1), 0.05))[0] == 1.0
    # However near the object lies: a push that does not come nearer enters nothing.
    near = 0.002 * np.abs(rng.normal(size=(33, 1)))
    assert risk_of(near - 5e-4, near)[0] == 0.0 and risk_of(near - 4e-3, near)[0] > 0.3
    # What is within its clearance already may leave, and may not go further in.
    inside = np.full((9, 1), -0.003)
    assert risk_of(np.full((9, 1), 0.001), inside)[0] < 1e-6 and risk_of(np.full((9, 1), -0.006), inside)[0] > 0.99


def way_to(goal: Float64Array, outlines: list[Float64Array], room: float = 0.0) -> WayRound | None:
    return WayRound.to(Goal(goal), KeepOut(SQUARE, outlines, SETTINGS), SQUARE, SETTINGS, room)


def test_way_round_a_wall_is_longer_by_what_the_wall_sticks_out() -> None:
    """A square of 6 cm at the foot of a wall: its middle must pass the end of the wall at half its side."""
    goal, wall = np.array([0.2, 0.0, 0.0]), block(-0.01, -0.39, 0.01, 0.1)
    way = way_to(goal, [wall])
    assert way is not None
    extra = way.extra(np.array([[-0.2, 0.0, 0.0], [0.1, 0.0, 0.0], [-0.2, 0.2, 0.0]]))
    # In steps to eight neighbours: 0.13 m up and down again, of which the diagonal steps cost 0.41 each more than straight ones.
    assert extra[0] == pytest.approx(2 * 0.13 * (np.sqrt(2.0) - 1.0), abs=0.03)
    assert extra[1] == 0.0 and extra[2] < 0.05
    assert np.all(np.isinf(way.extra(np.array([[np.nan, 0.0, 0.0]]))))
    # A small turn beyond the first heading of the grid is no long way round.
    assert way.extra(np.array([0.1, 0.0, -0.4])) == pytest.approx(0.0, abs=1e-6)
    # One heading is as good as the same one a turn later.
    turned = way.extra(np.array([[-0.2, 0.0, 0.3], [-0.2, 0.0, 0.3 + 2 * np.pi], [-0.2, 0.0, 0.3 - 2 * np.pi]]))
    np.testing.assert_allclose(turned, turned[0], atol=1e-6)


def test_no_way_leads_out_of_a_ring_or_onto_an_obstacle() -> None:
    ring = [block(-0.1, -0.1, -0.09, 0.1), block(0.09, -0.1, 0.1, 0.1), block(-0.1, -0.1, 0.1, -0.09), block(-0.1, 0.09, 0.1, 0.1)]
    inside = way_to(np.zeros(3), ring)
    assert (
        inside is not None and np.isinf(inside.extra(np.array([0.3, 0.3, 0.0]))) and np.isfinite(inside.extra(np.array([0.02, 0.0, 0.0])))
    )
    outside = way_to(np.array([0.3, 0.0, 0.0]), ring)
    assert outside is not None and np.isinf(outside.extra(np.zeros(3)))
    assert way_to(np.zeros(3), [block(-0.15, -0.15, 0.15, 0.15)]) is None


def test_narrow_gap_is_a_longer_way_where_pushes_need_more_room() -> None:
    """Straight through a gap of 9 cm, 15 mm on either side, or round: it is passed in short pushes where usual ones need more room."""
    walls = [block(-0.02, 0.045, 0.02, 0.2), block(-0.02, -0.2, 0.02, -0.045)]
    goal, start = np.array([0.2, 0.0, 0.0]), np.array([-0.2, 0.0, 0.0])
    free, narrow = way_to(goal, walls), way_to(goal, walls, room=0.03)
    assert free is not None and narrow is not None
    assert free.extra(start) < 0.01 < narrow.extra(start)
