"""Distance from a path of straight lines."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.pushing.arm_motion import nearest_on_path

CORNER = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0]])


@pytest.mark.parametrize(
    ("point", "distance", "index"),
    [
        ((0.25, 0.0, 0.5), 0.5, 0.25),
        ((1.5, 1.0, 0.0), 0.5, 1.5),
        ((-3.0, 0.0, 4.0), 5.0, 0.0),
        ((1.0, 3.0, 0.0), 1.0, 2.0),
    ],
)
def test_nearest_point_of_a_path(point: tuple[float, float, float], distance: float, index: float) -> None:
    assert nearest_on_path(CORNER, np.array(point)) == pytest.approx((distance, index))


def test_a_single_point_is_a_path() -> None:
    assert nearest_on_path(CORNER[1:2], np.array([1.0, 0.0, 2.0])) == (2.0, 0.0)
