"""What cannot be the shape of an object is refused, with the reason."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import hammer_shape, square
from push_ident.errors import InputError
from push_ident.geometry.outline import cells_in_outline
from push_ident.geometry.shape_check import check_pusher_radius, check_shape, crossing_edges
from push_ident.types import CellGrid, Float64Array, ObjectShape

TRIANGLE = np.array([[0.0, 0.0], [0.15, 0.0], [0.0, 0.15]])
WEDGE = np.array([[0.0, 0.0], [0.15, 0.0], [0.15, 0.053]])  # a tip of 20 degrees
ASYMMETRIC = np.array([[-0.1, -0.02], [0.1, -0.02], [0.1, 0.08], [0.06, 0.08], [0.06, 0.02], [-0.1, 0.02]])


def shape_in(outline: Float64Array, size: float = 0.01) -> ObjectShape:
    return ObjectShape(cells_in_outline(outline, size), outline)


@pytest.mark.parametrize("shape", [hammer_shape(), square(), shape_in(TRIANGLE), shape_in(WEDGE), shape_in(ASYMMETRIC)])
def test_shapes_of_objects_are_accepted(shape: ObjectShape) -> None:
    assert check_shape(shape) is shape


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda outline: 2.0 * outline, "Cells lie up to 0.035 m outside the outline"),
        (lambda outline: 0.5 * outline, "outside the outline"),
        (lambda outline: outline * [-1.0, 1.0], "cells"),
        (lambda outline: outline + np.array([0.05, 0.0]), "cells"),
        (lambda outline: 1e3 * outline, "extent of an object is"),
        (lambda outline: 1e-3 * outline, "wide, expected at least"),
        (lambda outline: outline[[0, 1, 3, 2, 4, 5]], "crosses itself: its edges"),
    ],
    ids=["twice", "half", "mirrored", "shifted", "millimetres", "kilometres", "crossed"],
)
def test_outline_that_cannot_be_that_of_the_cells_is_refused(change: object, text: str) -> None:
    with pytest.raises(InputError, match=text):
        check_shape(ObjectShape(shape_in(ASYMMETRIC).cells, change(ASYMMETRIC)))  # type: ignore[operator]


def test_outline_that_reaches_far_beyond_the_cells_is_refused() -> None:
    with pytest.raises(InputError, match="The outline lies 0.0707 m away from the cells"):
        check_shape(ObjectShape(square().cells, 2.0 * square().outline))


def test_cells_and_outline_in_another_unit_together_are_refused() -> None:
    with pytest.raises(InputError, match="extent of an object is 200"):
        check_shape(ObjectShape(CellGrid(1e3 * shape_in(ASYMMETRIC).cells.centres, 10.0), 1e3 * ASYMMETRIC))


def test_crossing_is_found_between_any_two_edges() -> None:
    rng = np.random.default_rng(0)
    angle = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(0.06, 0.1, (40, 1))
    assert crossing_edges(circle) is None  # a star around its centre is simple, however rough
    for _ in range(20):
        i, j = sorted(rng.choice(40, 2, replace=False))
        if 1 < j - i < 39:
            swapped = circle.copy()
            swapped[[i, j]] = circle[[j, i]]
            assert crossing_edges(swapped) is not None


def test_vertices_rounded_to_single_precision_do_not_cross() -> None:
    slit = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.05], [0.05, 0.05], [0.05, 0.01], [0.05, 0.05], [0.0, 0.05]])
    assert crossing_edges(slit.astype(np.float32).astype(np.float64)) is None


@pytest.mark.parametrize("radius", [-0.01, float("nan"), 8.5, float("inf")])
def test_radius_that_no_pusher_has_is_refused(radius: float) -> None:
    with pytest.raises(InputError):
        check_pusher_radius(radius)


@pytest.mark.parametrize("grown", [1.05, 2.0])
def test_cells_that_overlap_are_refused(grown: float) -> None:
    cells = shape_in(TRIANGLE).cells
    with pytest.raises(InputError, match="apart, expected at least their size"):
        check_shape(ObjectShape(CellGrid(cells.centres, grown * cells.size), TRIANGLE))


def test_cells_that_cover_another_area_than_the_outline_are_refused() -> None:
    with pytest.raises(InputError, match="expected about the"):
        check_shape(ObjectShape(CellGrid(shape_in(TRIANGLE).cells.centres, 0.006), TRIANGLE))
