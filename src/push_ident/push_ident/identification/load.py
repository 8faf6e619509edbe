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

from typing import Final

import numpy as np

from push_ident.types import Float64Array

__all__ = ["balanced_load", "balanced_load_derivative"]

_BALANCED: Final = 1e-12
"""Distance of the centre of the load from that of mass at which they are one, relative to the size of the object [-]."""
_MAX_STEPS: Final = 100
"""Newton's method on a convex function needs some ten."""
_ARMIJO: Final = 1e-4
"""Share of the expected decrease that a step must make (Nocedal & Wright, Numerical Optimization, ch. 3) [-]."""
_REGULAR: Final = 1e-12
"""Added to the spread, which is about 1 unless the load is on one line or cell [-]."""
_LONGEST: Final = 10.0
"""Step of the tilt: it changes ratios of loads by a factor of e^10 over the size of the object [-]."""
_SHORTEST: Final = 1e-9
"""Shortest share of a step: below it the decrease is lost in rounding [-]."""


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
    arms = arms / size
    exponent = np.log(weight) + excess
    tilt = np.zeros(2)
    load, potential = _tilted(exponent, arms, tilt)
    for _ in range(_MAX_STEPS):
        # The potential is convex in the tilt, its gradient the centre of the load, its Hessian the spread of the load.
        centre = load @ arms
        if np.max(np.abs(centre)) < _BALANCED:
            break
        spread = (arms * load[:, None]).T @ arms - np.outer(centre, centre)
        step = -np.linalg.solve(spread + _REGULAR * np.eye(2), centre)
        # Where nearly all of the load is on one cell, the potential is a plane, and Newton's step without end.
        step *= min(1.0, _LONGEST / float(np.linalg.norm(step)))
        share = 1.0
        while share > _SHORTEST:
            load, reached = _tilted(exponent, arms, tilt + share * step)
            if reached <= potential + _ARMIJO * share * float(centre @ step):
                break
            share *= 0.5
        tilt, potential = tilt + share * step, reached
    return load


def _tilted(exponent: Float64Array, arms: Float64Array, tilt: Float64Array) -> tuple[Float64Array, float]:
    """Load and potential (logarithm of its sum before it was normalised)."""
    value = exponent + arms @ tilt
    top = float(value.max())
    load = np.exp(value - top)
    total = float(load.sum())
    return load / total, top + float(np.log(total))


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
