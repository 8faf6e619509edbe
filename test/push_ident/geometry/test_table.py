"""The table top, where its border is known."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.table import Table

SQUARE = np.array([[-0.3, -0.2], [0.3, -0.2], [0.3, 0.2], [-0.3, 0.2]])
STAR = np.array([[np.cos(4 * np.pi * k / 5), np.sin(4 * np.pi * k / 5)] for k in range(5)])


def test_what_reaches_over_the_table_is_told_from_its_outermost_point() -> None:
    for corners in (SQUARE, SQUARE[::-1]):
        table = Table(corners)
        assert table.beyond(np.array([[0.0, 0.0], [0.27, 0.1]])) == pytest.approx(-0.03)
        assert table.beyond(np.array([[0.0, 0.0], [0.1, -0.24]])) == pytest.approx(0.04)
    np.testing.assert_array_equal(Table.rectangle(np.array([-0.3, 0.3, -0.2, 0.2])).corners, SQUARE)


@pytest.mark.parametrize(
    ("corners", "word"),
    [
        (SQUARE[:2], "three or more"),
        (SQUARE * np.nan, "finite"),
        (SQUARE * 0.01, "shorter than"),
        (SQUARE[[0, 1, 3, 2]], "not convex"),
        (STAR, "not convex"),
        (np.vstack([SQUARE, [[0.0, 0.0]]]), "not convex"),
    ],
)
def test_corners_that_are_no_table_are_refused(corners: np.ndarray, word: str) -> None:
    with pytest.raises(InputError, match=word):
        Table(corners)
    with pytest.raises(InputError, match="x_min < x_max"):
        Table.rectangle(np.array([0.3, -0.3, -0.2, 0.2]))
