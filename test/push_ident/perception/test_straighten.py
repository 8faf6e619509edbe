"""Outlines with straight edges and sharp corners, and round ones that stay round."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.perception.outline.tracing import straighten


def traced(polygon: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A polygon as tracing gives it: a point each quarter of a millimetre, corners rounded, wavering by 0.3 mm."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    points = np.concatenate(
        [
            p + np.linspace(0, 1, max(int(np.linalg.norm(e) / 2.5e-4), 1), endpoint=False)[:, None] * e
            for p, e in zip(polygon, edge, strict=True)
        ]
    )
    rounded = gaussian_filter1d(points, 5, axis=0, mode="wrap")
    waver = gaussian_filter1d(rng.normal(size=rounded.shape), 12, axis=0, mode="wrap")
    return np.asarray(rounded + 3e-4 * waver / waver.std())


def test_hammer_gets_its_eight_edges_back() -> None:
    x0, x1, x2, h, w = -0.14, 0.02, 0.06, 0.011, 0.055
    hammer = np.array([[x1, -h], [x1, -w], [x2, -w], [x2, w], [x1, w], [x1, h], [x0, h], [x0, -h]])
    for seed in range(5):
        outline = straighten(traced(hammer, np.random.default_rng(seed)))
        assert np.max(np.abs(signed_distance(outline, hammer))) < 1e-3
        edge = np.roll(outline, -1, axis=0) - outline
        length = np.linalg.norm(edge, axis=1)
        heading = np.degrees(np.arctan2(edge[:, 1], edge[:, 0]))
        off_axis = np.abs((heading + 45) % 90 - 45)
        # Nearly all of the outline points where it should.
        assert length[off_axis < 2].sum() > 0.85 * length.sum()


def test_disc_stays_round() -> None:
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    disc = 0.05 * np.column_stack([np.cos(angle), np.sin(angle)])
    outline = straighten(traced(disc, np.random.default_rng(0)))
    dense = np.concatenate([np.linspace(a, b, 10) for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True)])
    assert np.max(np.abs(np.linalg.norm(dense, axis=1) - 0.05)) < 1.6e-3


def test_small_contour_comes_back_as_a_polygon() -> None:
    square = 0.004 * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    for seed in range(5):
        outline = straighten(traced(square, np.random.default_rng(seed)))
        # Tracing rounds its corners by a seventh of its side.
        assert 4 <= len(outline) <= 8
        assert np.max(np.abs(signed_distance(outline, square))) < 1e-3
        assert polygon_area(outline) == pytest.approx(polygon_area(square), rel=0.3)


def test_edge_traced_in_two_parts_at_an_angle_has_no_dent() -> None:
    # As a camera saw a side of the crimp.
    side = [[0.0, -6e-4], [0.038, 1e-3], [0.0437, -7e-4], [0.056, -4e-4]]
    plate = np.array([*side, [0.056, 0.03], [0.0, 0.03]])
    for orientation in (1, -1):
        outline = straighten(traced(plate[::orientation], np.random.default_rng(3)))
        assert len(outline) == 4
        assert np.max(np.abs(signed_distance(outline, np.array([[0.0, 0.0], [0.056, 0.0], [0.056, 0.03], [0.0, 0.03]])))) < 1.2e-3


def test_side_that_bulges_does_not_become_straight() -> None:
    x = np.linspace(0.0, 0.06, 40)
    bulging = np.vstack([np.column_stack([x, -0.0016 * (1.0 - (2.0 * x / 0.06 - 1.0) ** 2)]), [[0.06, 0.03], [0.0, 0.03]]])
    outline = straighten(traced(bulging, np.random.default_rng(4)))
    assert np.min(outline[:, 1]) < -1e-3


def test_no_edge_of_a_ragged_contour_has_no_length() -> None:
    for seed in range(12):
        rough = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((200, 200)), (0, 0), 1.5)
        contours, _ = cv2.findContours((rough > -0.02).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        # Turned, so that ends of stretches that are one point differ by rounding.
        contour = transform_points([0.0, 0.0, 0.3], max(contours, key=cv2.contourArea)[:, 0] * 2.5e-4)
        outline = straighten(contour)
        assert len(outline) >= 3
        assert np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1).min() > 1e-6
