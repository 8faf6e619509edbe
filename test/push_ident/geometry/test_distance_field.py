"""Distances from outlines on a grid, against the exact ones."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.geometry.distance_field import RESOLUTION, DistanceField, contours, grown, pieces
from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.geometry.se2 import transform_points

ANGLE = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.03], [0.03, 0.03], [0.03, 0.08], [0.0, 0.08]])
TURNED = [transform_points([0.01, 0.02, 0.5], ANGLE), transform_points([0.2, -0.1, -1.0], ANGLE)]


def test_distance_of_the_nearer_outline_is_that_of_the_polygons_to_a_cell_and_a_bit() -> None:
    around = DistanceField.of(TURNED, np.full(2, -0.3), np.full(2, 0.4))
    points = np.random.default_rng(0).uniform(-0.3, 0.4, (100, 50, 2))
    exact = np.min([signed_distance(points.reshape(-1, 2), one) for one in TURNED], axis=0).reshape(100, 50)
    error = around.at(points) - exact
    assert np.min(exact) < -0.01 < 0.1 < np.max(exact)
    assert np.max(np.abs(error)) < 1.3 * RESOLUTION and abs(np.mean(error)) < 0.2 * RESOLUTION


def test_points_beyond_the_rectangle_have_the_distance_of_its_border_and_no_point_has_none() -> None:
    around = DistanceField.of(TURNED[:1], np.full(2, -0.3), np.full(2, 0.3))
    at_border = around.at(np.array([[0.3, 0.0], [0.0, -0.3]]))
    np.testing.assert_allclose(around.at(np.array([[0.9, 0.0], [0.0, -5.0]])), at_border, atol=2 * RESOLUTION)
    assert np.all(around.at(np.array([[np.nan, 0.0], [0.0, np.inf]])) == -np.inf)
    outside = DistanceField.of(TURNED[:1], np.full(2, 0.5), np.full(2, 0.6))
    assert outside.at(np.full(2, 0.55)) > 0.1, "outlines beyond the rectangle do not count"


def test_no_outline_takes_more_memory_than_there_is() -> None:
    wide = DistanceField.of([100.0 * ANGLE], np.full(2, -100.0), np.full(2, 100.0))
    assert wide.distance.size < 1e7 and wide.at(np.array([50.0, 0.0])) == pytest.approx(40.0, abs=0.1)
    assert grown(ANGLE, 200.0)[:, 0].max() == pytest.approx(200.1, abs=0.3)


@pytest.mark.parametrize("by", [0.002, 0.01])
def test_grown_outline_lies_outside_by_the_distance(by: float) -> None:
    wide = grown(TURNED[0], by)
    gap = signed_distance(wide, TURNED[0])
    assert polygon_area(wide) > 0.0, "counter-clockwise"
    assert by - 0.5 * RESOLUTION < np.min(gap) and np.max(gap) < by + 2.0 * RESOLUTION
    # Steiner's formula bounds the area from both sides, up to the cells of the border.
    length = float(np.sum(np.linalg.norm(TURNED[0] - np.roll(TURNED[0], 1, axis=0), axis=1)))
    area = polygon_area(TURNED[0]) + by * length
    assert area - 2 * by**2 <= polygon_area(wide) < area + np.pi * by**2 + 2.0 * RESOLUTION * length
    assert grown(TURNED[0], 0.0) is TURNED[0]


def test_pieces_of_a_mask_have_their_place_and_their_border() -> None:
    mask = np.zeros((20, 30), dtype=np.bool_)
    mask[3:6, 4:14], mask[10:18, 20:22], mask[15, 3:5] = True, True, True
    found = pieces(mask, 5)
    assert [first.tolist() for first, _ in found] == [[4.0, 3.0], [20.0, 10.0]]
    (border,) = contours(found[0][1])
    assert np.ptp(border, axis=0).tolist() == [9.0, 2.0] and polygon_area(border) == pytest.approx(18.0)
