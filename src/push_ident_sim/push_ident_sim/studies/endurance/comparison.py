"""Two posteriors of one object against each other, and their predictions of pushes that neither has learned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.linalg import eigh

from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.mechanics import log_derivatives_at
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import Float64Array, PushRecord
from push_ident_sim.studies.common.base import Json

__all__ = ["compare_maps", "errors_on"]

_PINNED: Final = 0.25
"""A combination of cells whose variance is below this share of the prior's is determined by the pushes."""
_FREE: Final = 1e-6
"""Combinations with a smaller share of the largest variance of the prior cannot vary: there are fewer modes than cells."""


def compare_maps(one: ModelPosterior, other: ModelPosterior) -> Json:
    """Difference of the friction forces of the cells (logarithms of mass times friction), in its own standard deviations.

    The two traced the object separately, so their cells are matched by place. Modes that the maps leave out count for neither.

    Returns:
        `n_cells` matched, `within_2_std` (share of cells), `rms_std` (root mean square of difference over deviation), `median_std`
        (of the difference, a logarithm), `n_pinned`
        combinations that the pushes determine, and `mahalanobis2` over them: its expectation is their number.

    Raises:
        InputError: the objects have fewer than half of their cells in common.
    """
    a, b = _matched(one, other)
    (value_a, rows_a), (value_b, rows_b) = _log_loads(one, a), _log_loads(other, b)
    difference = value_a - value_b
    covariance = rows_a @ one.covariance @ rows_a.T + rows_b @ other.covariance @ rows_b.T
    prior = rows_a @ rows_a.T + rows_b @ rows_b.T
    ratio = np.abs(difference) / np.sqrt(np.diag(covariance))
    # In units of the prior, without the directions in which neither map can vary.
    variance, axes = eigh(prior)
    free = variance > _FREE * variance[-1]
    white = axes[:, free] / np.sqrt(variance[free])
    shares, directions = eigh(white.T @ covariance @ white)
    pinned = shares < _PINNED
    parts = (directions.T @ white.T @ difference) ** 2 / shares
    return {
        "n_cells": len(a),
        "within_2_std": float(np.mean(ratio < 2.0)),
        "rms_std": float(np.sqrt(np.mean(ratio**2))),
        "median_std": float(np.median(np.sqrt(np.diag(covariance)))),
        "n_pinned": int(np.sum(pinned)),
        "mahalanobis2": float(np.sum(parts[pinned])),
    }


def _matched(one: ModelPosterior, other: ModelPosterior) -> tuple[list[int], list[int]]:
    cells, others = one.model.shape.cells, other.model.shape.cells
    distance = np.linalg.norm(cells.centres[:, None] - others.centres[None], axis=2)
    nearest = distance.argmin(axis=1)
    a = [i for i, j in enumerate(nearest) if distance[i, j] < 0.5 * cells.size and distance[:, j].argmin() == i]
    if 2 * len(a) < max(len(cells), len(others)):
        raise InputError(f"Only {len(a)} of {len(cells)} and {len(others)} cells are at the same places; are these one object?")
    return a, [int(nearest[i]) for i in a]


def _log_loads(posterior: ModelPosterior, cells: list[int]) -> tuple[Float64Array, Float64Array]:
    """Logarithm of mass times friction of some cells, and its derivative by the unknowns."""
    model = posterior.model
    d_mass, d_friction = log_derivatives_at(posterior.unknowns, posterior.z)
    return np.log(model.mass * model.friction)[cells], (d_mass + d_friction)[cells]


def errors_on(posterior: ModelPosterior, pushes: Sequence[PushRecord]) -> list[float]:
    """Cell error of the predicted end of each push [m]."""
    errors = []
    for push in pushes:
        track = push.poses
        end = simulate(posterior.model, PushScenario(push.pusher, track.pose[0], track.time[-1:])).pose[-1]
        errors.append(cell_error(posterior.model.shape.cells, end, track.pose[-1]))
    return errors
