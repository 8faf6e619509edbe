"""Cells cover what an outline encloses, in its principal axes, and are the same wherever they are read."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cell_polygons, cells_in_outline, cut_at_outline, lattice_yaw
from push_ident.geometry.outline import polygon_area, polygon_centroid
from push_ident.geometry.se2 import rotation
from push_ident.identification.unknowns.mechanics import uniform_model
from push_ident.physics.body import body_of_cells
from push_ident.types import CellGrid, Float64Array, ObjectShape

HAMMER = np.array(
    [[-0.1, -0.0125], [0.08, -0.0125], [0.08, -0.05], [0.12, -0.05], [0.12, 0.05], [0.08, 0.05], [0.08, 0.0125], [-0.1, 0.0125]]
)
ANGLE = np.linspace(0.0, 2 * np.pi, 48, endpoint=False)
OUTLINES = {
    "hammer": HAMMER,
    "triangle": np.array([[0.0, 0.0], [0.15, 0.0], [0.02, 0.1]]),
    "corner": np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.04], [0.04, 0.04], [0.04, 0.1], [0.0, 0.1]]),
    "disc": 0.05 * np.column_stack([np.cos(ANGLE), np.sin(ANGLE)]),
    "plate": np.array([[0.0, 0.0], [0.125, 0.0], [0.125, 0.083], [0.0, 0.083]]),
}


def shape_of(outline: Float64Array) -> ObjectShape:
    return ObjectShape(cells_in_outline(outline, float(np.sqrt(polygon_area(outline) / 80))), outline)


@pytest.mark.parametrize("yaw", [0.0, 0.4])
@pytest.mark.parametrize("name", OUTLINES)
def test_cells_cover_the_outline_exactly_and_none_is_a_sliver(name: str, yaw: float) -> None:
    outline = OUTLINES[name] @ rotation(yaw).T
    shape = shape_of(outline)
    cells, area = shape.cells, polygon_area(outline)
    assert 50 <= len(cells) <= 150
    assert cells.areas.sum() == pytest.approx(area, rel=1e-9)
    np.testing.assert_allclose(cells.middle, polygon_centroid(outline), atol=1e-9)
    assert cells.parts.min() >= 0.25
    assert cells.parts.max() < 2.0
    drawn = [sum(polygon_area(line) for line in lines) for lines in cell_polygons(shape)]
    np.testing.assert_allclose(drawn, cells.areas, rtol=1e-4)


def test_cells_lie_in_the_principal_axes_and_are_symmetric_about_them() -> None:
    for yaw in (0.0, 0.3, -0.7):
        cells = cells_in_outline(HAMMER @ rotation(yaw).T, 0.01)
        assert lattice_yaw(cells) == pytest.approx(yaw, abs=1e-6)
        straight = cells.centres @ rotation(yaw)
        mirrored = straight * [1.0, -1.0]
        distance = np.linalg.norm(straight[:, None] - mirrored, axis=2)
        np.testing.assert_allclose(distance.min(axis=1), 0.0, atol=1e-6)
        np.testing.assert_allclose(cells.areas[distance.argmin(axis=1)], cells.areas, rtol=1e-6)


def test_uniform_object_has_the_centre_and_the_inertia_of_its_outline() -> None:
    for outline in OUTLINES.values():
        shape, exact = shape_of(outline), shape_of_many(outline)
        model = uniform_model(shape)
        np.testing.assert_allclose(model.mass / model.total_mass, shape.cells.areas / shape.cells.areas.sum())
        np.testing.assert_allclose(model.friction, model.friction[0])
        body, fine = (body_of_cells(m.shape, m.mass, m.friction) for m in (model, uniform_model(exact)))
        np.testing.assert_allclose(body.centre, polygon_centroid(outline), atol=1e-9)
        assert body.inertia == pytest.approx(fine.inertia, rel=2e-3)


def shape_of_many(outline: Float64Array) -> ObjectShape:
    return ObjectShape(cells_in_outline(outline, 0.003), outline)


def test_squares_and_an_outline_in_single_precision_give_the_same_cells() -> None:
    for outline in OUTLINES.values():
        shape = shape_of(outline)
        squares = CellGrid(shape.cells.squares, shape.cells.size)
        again = cut_at_outline(ObjectShape(squares, outline.astype(np.float32).astype(np.float64))).cells
        np.testing.assert_allclose(again.centres, shape.cells.centres, atol=1e-6)
        np.testing.assert_allclose(again.areas, shape.cells.areas, rtol=1e-4)


def test_squares_that_fill_an_outline_or_lie_outside_it_stay_whole() -> None:
    squares = CellGrid(np.array([[0.005, 0.005], [0.015, 0.005]]), 0.01)
    for width in (0.02, 0.009):
        shape = ObjectShape(squares, np.array([[0.0, 0.0], [width, 0.0], [width, 0.01], [0.0, 0.01]]))
        assert cut_at_outline(shape).cells is squares


def test_outline_smaller_than_a_quarter_of_a_cell_is_refused() -> None:
    with pytest.raises(InputError, match="take smaller cells"):
        cells_in_outline(0.001 * OUTLINES["plate"], 0.01)
