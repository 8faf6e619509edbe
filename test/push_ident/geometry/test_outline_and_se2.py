"""Outlines of cells, distances to them, and planar motions."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.bags import L_OUTLINE
from push_ident.errors import InputError
from push_ident.geometry.outline import edge_normals, outline_of_cells, points_in_polygon, polygon_area, polygon_centroid, signed_distance
from push_ident.geometry.se2 import compose, inverse, quaternion_of_yaw, rotation, transform_points, wrap_angle, yaw_of_quaternion


def test_centroid_and_normals_of_a_triangle_in_both_orientations() -> None:
    triangle = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.4]])
    assert polygon_centroid(triangle) == pytest.approx((0.1, 0.4 / 3))
    assert polygon_centroid(triangle[::-1]) == pytest.approx((0.1, 0.4 / 3))
    np.testing.assert_allclose(edge_normals(triangle), [[0.0, -1.0], [0.8, 0.6], [-1.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(edge_normals(triangle[::-1]), [[0.8, 0.6], [0.0, -1.0], [-1.0, 0.0]], atol=1e-12)


def test_outline_of_cells_of_an_l_is_its_six_corners_whatever_the_yaw() -> None:
    centres = np.stack(np.meshgrid(*2 * [np.arange(-0.095, 0.1, 0.01)]), axis=-1).reshape(-1, 2)
    centres = centres[points_in_polygon(centres, L_OUTLINE)]
    traced = outline_of_cells(centres, 0.01)
    assert {tuple(p) for p in traced.round(9)} == {tuple(p) for p in L_OUTLINE}
    turned = outline_of_cells(centres @ rotation(0.3).T, 0.01, yaw=0.3)
    np.testing.assert_allclose(turned, traced @ rotation(0.3).T, atol=1e-12)


@pytest.mark.parametrize(("rows", "area"), [(["#.", ".#"], 1), (["####.#", "#..#.#", "##.#.."], 9), (["###.", "#.##", "##.#", ".###"], 14)])
def test_outline_is_the_largest_outer_loop_without_holes(rows: list[str], area: int) -> None:
    centres = np.array([(x, -y) for y, row in enumerate(rows) for x, mark in enumerate(row) if mark == "#"], dtype=float)
    outline = outline_of_cells(centres, 1.0)
    assert len({tuple(p) for p in outline}) == len(outline)
    assert polygon_area(outline) == pytest.approx(area)


def test_outline_of_cells_that_are_on_no_lattice_is_refused() -> None:
    with pytest.raises(InputError, match="lattice"):
        outline_of_cells([[0.0, 0.0], [0.013, 0.0]], 0.01)
    with pytest.raises(InputError, match="at least one cell"):
        outline_of_cells(np.empty((0, 2)), 0.01)


def test_distance_to_a_triangle_is_negative_inside() -> None:
    triangle = [[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]
    points = [[1.0, 1.0], [4.0, 0.0], [3.0, 4.0], [1.0, -2.0]]
    np.testing.assert_allclose(signed_distance(points, triangle), [-1.0, 1.0, 12 / 5, 2.0])  # incircle of 3-4-5 has radius 1
    np.testing.assert_array_equal(points_in_polygon(points, triangle), [True, False, False, False])


def test_planar_motions_compose_and_invert() -> None:
    a, b = np.array([[0.3, -0.2, 2.9], [1.0, 0.0, -1.0]]), np.array([0.1, 0.7, 0.6])
    points = np.array([[0.2, 0.1], [-0.4, 0.3]])
    np.testing.assert_allclose(transform_points(compose(a, b), points), transform_points(a, transform_points(b, points)), atol=1e-15)
    np.testing.assert_allclose(compose(a, inverse(a)), 0.0, atol=1e-15)
    np.testing.assert_allclose(transform_points([0.0, 0.0, np.pi / 2], [[1.0, 0.0]]), [[0.0, 1.0]], atol=1e-15)
    np.testing.assert_allclose(yaw_of_quaternion(quaternion_of_yaw([3.0, -1.2])), [3.0, -1.2])
    np.testing.assert_allclose(wrap_angle([4.0, -4.0, 0.5]), [4.0 - 2 * np.pi, 2 * np.pi - 4.0, 0.5])
