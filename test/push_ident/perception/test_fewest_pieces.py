"""Outlines with as few edges as the noise of a camera allows."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.geometry.outline import dense, edge_normals, signed_distance
from push_ident.perception.outline.fewest_pieces import with_fewest_pieces
from push_ident.types import Float64Array

NOISE, WINDOW = 1e-3, 0.012
BOX = np.array([(-0.06, -0.04), (0.06, -0.04), (0.06, 0.04), (-0.06, 0.04)])
STEPPED = np.array([(-0.06, -0.04), (0.06, -0.04), (0.06, 0.04), (0.0, 0.04), (0.0, 0.03), (-0.06, 0.03)])
ANGLES = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
DISC = 0.05 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])


def ragged(outline: Float64Array, seed: int) -> Float64Array:
    """The outline as a matcher of windows shows it: one displacement for every window, and a corner wherever it changes."""
    points = dense(outline, WINDOW)
    normal = edge_normals(points)
    offset = NOISE * np.random.default_rng(seed).standard_normal(len(points))
    return points + offset[:, None] * normal


def fewest(contour: Float64Array, noise: float = NOISE) -> Float64Array:
    """All edges with the same noise."""
    length = np.linalg.norm(np.roll(contour, -1, axis=0) - contour, axis=1)
    return with_fewest_pieces(contour, np.full(len(contour), noise), length / WINDOW)


def tilt(outline: Float64Array, truth: Float64Array) -> float:
    """Root mean square of the angle between the edges of an outline and the true ones where they touch, by length [rad]."""
    middle = 0.5 * (outline + np.roll(outline, -1, axis=0))
    true_middle = 0.5 * (truth + np.roll(truth, -1, axis=0))
    true_edge = np.roll(truth, -1, axis=0) - truth
    along = np.einsum("ijk,jk->ij", middle[:, None] - true_middle, true_edge) / np.sum(true_edge**2, axis=1)
    feet = true_middle + np.clip(along, -0.5, 0.5)[:, :, None] * true_edge
    nearest = np.argmin(np.linalg.norm(middle[:, None] - feet, axis=2), axis=1)
    cosine = np.sum(edge_normals(outline) * edge_normals(truth)[nearest], axis=1)
    length = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)
    return float(np.sqrt(np.average(np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2, weights=length)))


@pytest.mark.parametrize("truth", [BOX, STEPPED], ids=["box", "step of 10 mm"])
def test_teeth_go_and_corners_stay(truth: Float64Array) -> None:
    contours = [ragged(truth, seed) for seed in range(20)]
    outlines = [fewest(contour) for contour in contours]
    # One side in ten or fewer is taken for an arc: its noise looks like one.
    assert sum(len(outline) == len(truth) for outline in outlines) >= 18
    for contour, outline in zip(contours, outlines, strict=True):
        assert np.sqrt(np.mean(signed_distance(dense(outline, 1e-3), truth) ** 2)) < NOISE
        assert tilt(outline, truth) < tilt(contour, truth)
    assert np.median([tilt(outline, truth) for outline in outlines]) < 0.25 * np.median([tilt(contour, truth) for contour in contours])


def test_a_disc_stays_round_to_the_noise() -> None:
    for seed in range(20):
        outline = fewest(ragged(DISC, seed))
        radius = np.linalg.norm(dense(outline, 1e-3), axis=1)
        assert np.abs(radius - 0.05).max() < NOISE and tilt(outline, DISC) < 0.04


def test_an_exact_contour_stays_as_it_is() -> None:
    np.testing.assert_array_equal(fewest(DISC, 0.0), DISC)
    assert len(fewest(DISC, 1e-5)) == len(DISC)
    np.testing.assert_allclose(fewest(BOX), BOX, atol=1e-4)
