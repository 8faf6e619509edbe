"""How the weight of a rigid object rests on its cells.

A cell need not bear its own weight: a base is never quite flat, and some objects stand on feet. Which cells bear more is an unknown map
c, but not every load is possible: that of an object at rest balances about its centre of mass. Among the loads P that balance, this is
the one of least relative entropy to w exp(c), with the weights w of the cells (Csiszar, "I-divergence geometry of probability
distributions and minimization problems", Annals of Probability 1975):

    P_i = w_i exp(c_i + t' x_i) / sum_j w_j exp(c_j + t' x_j),     sum_i P_i x_i = sum_i w_i x_i

with the places x of the cells and one tilt t, which is unique. P is positive, smooth in w and c, and w itself where c is 0. To the first
order in t it is the planar pressure under a rigid base on a bed of equal springs (Winkler).
"""

from __future__ import annotations

import numpy as np

from push_ident.identification.balance import balance
from push_ident.types import Float64Array

__all__ = ["balanced_load", "balanced_load_derivative"]


def balanced_load(weight: Float64Array, excess: Float64Array, places: Float64Array) -> Float64Array:
    """Share of the load that each cell bears, shape (n_cells,), sum 1.

    Args:
        weight: share of the mass of each cell, shape (n_cells,), all > 0, sum 1.
        excess: map c, logarithm of the load beyond the weight, shape (n_cells,).
        places: of the cells [m], shape (n_cells, 2).
    """
    arms = places - weight @ places
    size = float(np.sqrt(np.mean(arms**2)))
    if size == 0.0:  # a single cell
        return weight
    return balance(np.log(weight) + excess, arms / size)[0]


def balanced_load_derivative(
    weight: Float64Array, load: Float64Array, places: Float64Array, d_weight: Float64Array, d_excess: Float64Array
) -> Float64Array:
    """Derivative of the logarithm of a balanced load by unknowns, shape (n_cells, n_unknowns).

    Args:
        weight, places: as in `balanced_load`.
        load: its result.
        d_weight: derivative of the logarithm of the weights, shape (n_cells, n_unknowns).
        d_excess: derivative of the excess, shape (n_cells, n_unknowns).
    """
    arms = places - weight @ places
    untilted = d_weight + d_excess
    # The centre of the load moves as that of mass: this determines the derivative of the tilt.
    missing = (arms * weight[:, None]).T @ d_weight - (arms * load[:, None]).T @ untilted
    tilt = np.linalg.lstsq((arms * load[:, None]).T @ arms, missing)[0]
    derivative = untilted + arms @ tilt
    return np.asarray(derivative - load @ derivative)
