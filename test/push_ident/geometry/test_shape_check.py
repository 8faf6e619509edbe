"""What cannot be the shape of an object is refused, with the reason."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import hammer_shape, square
from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.shape_check import check_pusher_radius, check_shape, crossing_edges
from push_ident.types import CellGrid, Float64Array, ObjectShape

TRIANGLE = np.array([[0.0, 0.0], [0.15, 0.0], [0.0, 0.15]])
WEDGE = np.array([[0.0, 0.0], [0.15, 0.0], [0.15, 0.053]])  # a tip of 20 degrees
ASYMMETRIC = np.array([[-0.1, -0.02], [0.1, -0.02], [0.1, 0.08], [0.06, 0.08], [0.06, 0.02], [-0.1, 0.02]])


def shape_in(outline: Float64Array, size: float = 0.01) -> ObjectShape:
    return ObjectShape(cells_in_outline(outline, size), outline)


def outlined(outline: Float64Array) -> ObjectShape:
    return ObjectShape(shape_in(ASYMMETRIC).cells, outline)


def sized(size: float) -> ObjectShape:
    return ObjectShape(CellGrid(shape_in(TRIANGLE).cells.centres, size), TRIANGLE)


@pytest.mark.parametrize("shape", [hammer_shape(), square(), shape_in(TRIANGLE), shape_in(WEDGE), shape_in(ASYMMETRIC)])
def test_shapes_of_objects_are_accepted(shape: ObjectShape) -> None:
    assert check_shape(shape) is shape


@pytest.mark.parametrize(
    ("shape", "text"),
    [
        (outlined(2.0 * ASYMMETRIC), "Cells lie up to 0.0365 m outside the outline"),
        (outlined(ASYMMETRIC * [-1.0, 1.0]), "cells"),
        (outlined(1e3 * ASYMMETRIC), "extent of an object is"),
        (outlined(1e-3 * ASYMMETRIC), "wide, expected at least"),
        (outlined(ASYMMETRIC[[0, 1, 3, 2, 4, 5]]), "crosses itself: its edges"),
        (ObjectShape(square().cells, 2.0 * square().outline), "0.0707 m away from the cells"),
        (ObjectShape(CellGrid(1e3 * shape_in(ASYMMETRIC).cells.centres, 10.0), 1e3 * ASYMMETRIC), "extent of an object is 200"),
        (sized(1.05 * 0.01), "apart, expected at least their size"),
        (sized(0.006), "expected about the"),
    ],
)
def test_outline_and_cells_that_do_not_agree_are_refused(shape: ObjectShape, text: str) -> None:
    with pytest.raises(InputError, match=text):
        check_shape(shape)


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
