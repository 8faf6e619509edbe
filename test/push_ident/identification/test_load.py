"""Loads balance about the centre of mass, are positive, and have the derivative that differences show."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from push_ident.identification.unknowns.load import balanced_load, balanced_load_derivative

GRID = np.array([[x, y] for x in np.arange(-0.05, 0.06, 0.01) for y in np.arange(-0.03, 0.04, 0.01)])


def softmax(a):
    weight = np.exp(a - a.max())
    return weight / weight.sum()


def test_even_excess_changes_nothing():
    weight = softmax(np.random.default_rng(0).normal(size=len(GRID)))
    assert balanced_load(weight, np.full(len(GRID), 3.0), GRID) == pytest.approx(weight, rel=1e-9)


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), amplitude=st.sampled_from([0.1, 1.0, 5.0, 20.0]), metres=st.sampled_from([1e-3, 1.0, 1e3]))
def test_load_balances_about_the_centre_of_mass_whatever_the_map_and_the_unit(seed, amplitude, metres):
    rng = np.random.default_rng(seed)
    weight, excess = softmax(rng.normal(size=len(GRID))), amplitude * rng.normal(size=len(GRID))
    load = balanced_load(weight, excess, metres * GRID)
    assert np.all(load >= 0) and load.sum() == pytest.approx(1.0)
    assert load @ GRID == pytest.approx(weight @ GRID, abs=1e-9)


def test_three_feet_bear_what_statics_gives_them():
    feet = np.array([3, 40, 70])
    weight = softmax(np.random.default_rng(1).normal(size=len(GRID)))
    excess = np.full(len(GRID), -60.0)
    excess[feet] = [0.3, -0.2, 1.0]
    centre = weight @ GRID
    shares = np.linalg.solve(np.vstack([GRID[feet].T, np.ones(3)]), np.append(centre, 1.0))
    if np.all(shares > 0):
        assert balanced_load(weight, excess, GRID)[feet] == pytest.approx(shares, abs=1e-9)


def test_small_excess_is_undone_by_a_plane_as_on_a_bed_of_springs():
    weight = np.full(len(GRID), 1 / len(GRID))
    excess = 1e-4 * GRID[:, 0] / 0.05  # a slope alone cannot be borne: the centre of mass is in the middle
    assert balanced_load(weight, excess, GRID) == pytest.approx(weight, rel=1e-9)


def test_derivative_is_that_of_differences():
    rng = np.random.default_rng(2)
    a, c = rng.normal(size=len(GRID)), 2.0 * rng.normal(size=len(GRID))
    da, dc = rng.normal(size=(2, len(GRID), 3))
    weight = softmax(a)
    load = balanced_load(weight, c, GRID)
    exact = balanced_load_derivative(weight, load, GRID, da - weight @ da, dc)
    h = 1e-6
    for k in range(3):
        high, low = (balanced_load(softmax(a + s * da[:, k]), c + s * dc[:, k], GRID) for s in (h, -h))
        assert exact[:, k] == pytest.approx((np.log(high) - np.log(low)) / (2 * h), abs=1e-6)


def test_one_cell_bears_all():
    assert balanced_load(np.array([1.0]), np.array([4.0]), np.array([[0.1, 0.2]])) == pytest.approx([1.0])
