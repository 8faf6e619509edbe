"""The load of an object that stands on a few feet of unknown place.

Three screws under a plate, the two jaws of a wrench: most cells bear nothing, which no smooth map of 40 modes expresses. Here K feet bear
the load. Foot k at the place p_k spreads its share s_k over the cells around it,

    load_i = (1 - f) sum_k T_ik s_k + f w_i,     T_ik ~ exp(-|x_i - p_k|^2 / 2 h^2),  sum_i T_ik = 1

with the places x and the weights w of the cells, and the width h of a foot, so that its effective place q_k = sum_i T_ik x_i lies between
cells too. The small share f keeps every friction positive. The shares balance about the centre of mass c; where K > 3 they are not unique
and the one of least relative entropy to exp(g) counts, as in `load`:

    s_k ~ exp(g_k + t' a_k),   a_k = (q_k - c) / r,     t = argmin log sum_k exp(g_k + t' a_k) + `_SOFTNESS` |t|^2

with the radius r of the object. The second term gives an answer where no share balances (c outside the feet) and moves the centre of the
load by some thousandths of r where one does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.identification.balance import balance
from push_ident.types import Float64Array

__all__ = ["Feet", "FeetDerivative", "FeetLoad", "feet_load", "feet_load_derivative"]

_FLOATING: Final = 1e-3
"""Share f of the load that the rest of the base bears [-]."""
_SOFTNESS: Final = 1e-3
"""Of the balance [-]: the centre of the load misses that of mass by 2e-3 r per unit of tilt, which is about 1 where a load balances."""


@dataclass(frozen=True, slots=True)
class Feet:
    """Where an object stands."""

    place: Float64Array
    """p [m], shape (n_feet, 2)."""
    width: float
    """h [m] > 0."""
    preference: Float64Array
    """g, shape (n_feet,)."""


@dataclass(frozen=True, slots=True)
class FeetDerivative:
    """Derivative of `Feet` by unknowns."""

    place: Float64Array
    """Shape (n_feet, 2, n_unknowns)."""
    log_width: Float64Array
    """Shape (n_unknowns,)."""
    preference: Float64Array
    """Shape (n_feet, n_unknowns)."""


@dataclass(frozen=True, slots=True)
class FeetLoad:
    """A load on feet."""

    feet: Feet
    weight: Float64Array
    """Share of the mass of each cell, shape (n_cells,), sum 1."""
    cells: Float64Array
    """Their places [m], shape (n_cells, 2)."""
    load: Float64Array
    """Share of the load that each cell bears, shape (n_cells,), sum 1."""
    share: Float64Array
    """That each foot bears, shape (n_feet,), sum 1."""
    place: Float64Array
    """Effective place of each foot [m], shape (n_feet, 2)."""
    spread: Float64Array
    """T, shape (n_cells, n_feet)."""
    arms: Float64Array
    """a, shape (n_feet, 2)."""
    radius: float
    """r [m]."""
    tilt: Float64Array
    """t, shape (2,)."""


def feet_load(weight: Float64Array, cells: Float64Array, feet: Feet) -> FeetLoad:
    """Load of an object on feet.

    Args:
        weight: share of the mass of each cell, shape (n_cells,), sum 1.
        cells: their places [m], shape (n_cells, 2).
        feet: where it stands.
    """
    exponent = -np.sum((cells[:, None] - feet.place[None]) ** 2, axis=2) / (2.0 * feet.width**2)
    spread = np.exp(exponent - exponent.max(axis=0))
    spread /= spread.sum(axis=0)
    effective = spread.T @ cells
    radius = float(np.sqrt(np.mean((cells - cells.mean(axis=0)) ** 2)))
    arms = (effective - weight @ cells) / radius
    share, tilt = balance(feet.preference, arms, _SOFTNESS)
    load = (1.0 - _FLOATING) * (spread @ share) + _FLOATING * weight
    return FeetLoad(feet, weight, cells, load, share, effective, spread, arms, radius, tilt)


def feet_load_derivative(at: FeetLoad, d_weight: Float64Array, d_feet: FeetDerivative) -> Float64Array:
    """Derivative of the logarithm of the load of each cell by unknowns, shape (n_cells, n_unknowns).

    Args:
        at: the load.
        d_weight: derivative of the logarithm of the weights, shape (n_cells, n_unknowns).
        d_feet: of the feet.
    """
    cells, weight, width = at.cells, at.weight, at.feet.width
    share, spread, arms = at.share, at.spread, at.arms
    offset = cells[:, None] - at.feet.place[None]
    # d log T_ik = (x_i - p_k)' dp_k / h^2 + |x_i - p_k|^2 / h^2 dlog h, less its mean over the cells.
    by_place = offset / width**2
    by_place = spread[:, :, None] * (by_place - np.einsum("ik,ikd->kd", spread, by_place)[None])
    by_width = np.sum(offset**2, axis=2) / width**2
    by_width = spread * (by_width - np.sum(spread * by_width, axis=0)[None])
    d_spread = np.einsum("ikd,kdz->ikz", by_place, d_feet.place) + by_width[:, :, None] * d_feet.log_width
    d_centre = (cells * weight[:, None]).T @ d_weight
    d_arms = (np.einsum("ia,ikz->kaz", cells, d_spread) - d_centre[None]) / at.radius
    # The slope of the potential stays zero: this determines the derivative of the tilt.
    direct = d_feet.preference + np.einsum("kaz,a->kz", d_arms, at.tilt)
    centre = share @ arms
    curvature = (arms * share[:, None]).T @ arms - np.outer(centre, centre) + 2.0 * _SOFTNESS * np.eye(2)
    drift = (arms * share[:, None]).T @ (direct - share @ direct) + np.einsum("k,kaz->az", share, d_arms)
    exponent = direct - arms @ np.linalg.solve(curvature, drift)
    d_share = share[:, None] * (exponent - share @ exponent)
    d_load = (1.0 - _FLOATING) * (spread @ d_share + np.einsum("ikz,k->iz", d_spread, share)) + _FLOATING * weight[:, None] * d_weight
    return np.asarray(d_load / at.load[:, None])
