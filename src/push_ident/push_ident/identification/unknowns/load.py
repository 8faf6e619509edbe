"""How the weight of a rigid object rests on its cells: on its whole base, or on a few feet of unknown position.

**Whole base.** A cell need not bear its own weight: a base is never quite flat. Which cells bear more is an unknown map c, but not every
load is possible: that of an object at rest balances about its centre of mass. Among the loads P that balance, this is the one of least
relative entropy to w exp(c), with the weights w of the cells (Csiszar, "I-divergence geometry of probability distributions and
minimization problems", Annals of Probability 1975):

    P_i = w_i exp(c_i + t' x_i) / sum_j w_j exp(c_j + t' x_j),     sum_i P_i x_i = sum_i w_i x_i

with the positions x of the cells and one tilt t, which is unique. P is positive, smooth in w and c, and w itself where c is 0. To the first
order in t it is the planar pressure under a rigid base on a bed of equal springs (Winkler).

**Feet.** Three screws under a plate, the two jaws of a wrench: most cells bear nothing, which no smooth map of 40 modes expresses. Here K
feet bear the load. Foot k at the position p_k spreads its share s_k over the cells around it,

    load_i = (1 - f) sum_k T_ik s_k + f w_i,     T_ik ~ exp(-|x_i - p_k|^2 / 2 h^2),  sum_i T_ik = 1

with the width h of a foot, so that its effective position q_k = sum_i T_ik x_i lies between cells too. The small share f keeps every
friction positive. The shares balance about the centre of mass c; where K > 3 they are not unique and the one of least relative entropy to
exp(g) counts:

    s_k ~ exp(g_k + t' a_k),   a_k = (q_k - c) / r,     t = argmin log sum_k exp(g_k + t' a_k) + `_SOFTNESS` |t|^2

with the radius r of the object. The second term gives an answer where no share balances (c outside the feet) and moves the centre of the
load by some thousandths of r where one does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.types import Float64Array

_FLOATING: Final = 1e-3
"""Share f of the load that the rest of the base bears [-]."""
_SOFTNESS: Final = 1e-3
"""Of the balance [-]: the centre of the load misses that of mass by 2e-3 r per unit of tilt, which is about 1 where a load balances."""


def balanced_load(weight: Float64Array, excess: Float64Array, positions: Float64Array) -> Float64Array:
    """Share of the load that each cell bears, shape (n_cells,), sum 1.

    Args:
        weight: share of the mass of each cell, shape (n_cells,), all > 0, sum 1.
        excess: map c, logarithm of the load beyond the weight, shape (n_cells,).
        positions: of the cells [m], shape (n_cells, 2).
    """
    arms = positions - weight @ positions
    size = float(np.sqrt(np.mean(arms**2)))
    if size == 0.0:  # a single cell
        return weight
    return _balance(np.log(weight) + excess, arms / size)[0]


def balanced_load_derivative(
    weight: Float64Array, load: Float64Array, positions: Float64Array, d_weight: Float64Array, d_excess: Float64Array
) -> Float64Array:
    """Derivative of the logarithm of a balanced load by unknowns, from those of the logarithm of the weights and of the excess, each of
    shape (n_cells, n_unknowns); the others as in `balanced_load`, of which `load` is the result."""
    arms = positions - weight @ positions
    untilted = d_weight + d_excess
    # The centre of the load moves as that of mass: this determines the derivative of the tilt.
    missing = (arms * weight[:, None]).T @ d_weight - (arms * load[:, None]).T @ untilted
    tilt = np.linalg.lstsq((arms * load[:, None]).T @ arms, missing)[0]
    derivative = untilted + arms @ tilt
    return np.asarray(derivative - load @ derivative)


@dataclass(frozen=True, slots=True)
class FeetLoad:
    """A load on feet."""

    feet: Float64Array
    """Their positions p [m], shape (n_feet, 2)."""
    width: float
    """h [m]."""
    weight: Float64Array
    """Share of the mass of each cell, shape (n_cells,), sum 1."""
    cells: Float64Array
    """Their positions [m], shape (n_cells, 2)."""
    load: Float64Array
    """Share of the load that each cell bears, shape (n_cells,), sum 1."""
    share: Float64Array
    """That each foot bears, shape (n_feet,), sum 1."""
    position: Float64Array
    """Effective position of each foot [m], shape (n_feet, 2)."""
    spread: Float64Array
    """T, shape (n_cells, n_feet)."""
    arms: Float64Array
    """a, shape (n_feet, 2)."""
    radius: float
    """r [m]."""
    tilt: Float64Array
    """t, shape (2,)."""


def feet_load(weight: Float64Array, cells: Float64Array, feet: Float64Array, width: float, preference: Float64Array) -> FeetLoad:
    """Load of an object on feet, with the preferences g of shape (n_feet,); the others as in `FeetLoad`."""
    exponent = -np.sum((cells[:, None] - feet[None]) ** 2, axis=2) / (2.0 * width**2)
    spread = np.exp(exponent - exponent.max(axis=0))
    spread /= spread.sum(axis=0)
    effective = spread.T @ cells
    radius = float(np.sqrt(np.mean((cells - cells.mean(axis=0)) ** 2)))
    arms = (effective - weight @ cells) / radius
    share, tilt = _balance(preference, arms, _SOFTNESS)
    load = (1.0 - _FLOATING) * (spread @ share) + _FLOATING * weight
    return FeetLoad(feet, width, weight, cells, load, share, effective, spread, arms, radius, tilt)


def feet_load_derivative(
    at: FeetLoad, d_weight: Float64Array, d_feet: Float64Array, d_width: Float64Array, d_preference: Float64Array
) -> Float64Array:
    """Derivative of the logarithm of the load of each cell by unknowns, shape (n_cells, n_unknowns).

    From those of the logarithm of the weights, shape (n_cells, n_unknowns), of the positions of the feet, shape (n_feet, 2, n_unknowns),
    of the logarithm of the width, shape (n_unknowns,), and of the preferences, shape (n_feet, n_unknowns).
    """
    cells, weight, width = at.cells, at.weight, at.width
    share, spread, arms = at.share, at.spread, at.arms
    offset = cells[:, None] - at.feet[None]
    # d log T_ik = (x_i - p_k)' dp_k / h^2 + |x_i - p_k|^2 / h^2 dlog h, less its mean over the cells.
    by_position = offset / width**2
    by_position = spread[:, :, None] * (by_position - np.einsum("ik,ikd->kd", spread, by_position)[None])
    by_width = np.sum(offset**2, axis=2) / width**2
    by_width = spread * (by_width - np.sum(spread * by_width, axis=0)[None])
    d_spread = np.einsum("ikd,kdz->ikz", by_position, d_feet) + by_width[:, :, None] * d_width
    d_centre = (cells * weight[:, None]).T @ d_weight
    d_arms = (np.einsum("ia,ikz->kaz", cells, d_spread) - d_centre[None]) / at.radius
    # The slope of the potential stays zero: this determines the derivative of the tilt.
    direct = d_preference + np.einsum("kaz,a->kz", d_arms, at.tilt)
    centre = share @ arms
    curvature = (arms * share[:, None]).T @ arms - np.outer(centre, centre) + 2.0 * _SOFTNESS * np.eye(2)
    drift = (arms * share[:, None]).T @ (direct - share @ direct) + np.einsum("k,kaz->az", share, d_arms)
    exponent = direct - arms @ np.linalg.solve(curvature, drift)
    d_share = share[:, None] * (exponent - share @ exponent)
    d_load = (1.0 - _FLOATING) * (spread @ d_share + np.einsum("ikz,k->iz", d_spread, share)) + _FLOATING * weight[:, None] * d_weight
    return np.asarray(d_load / at.load[:, None])


def _balance(exponent: Float64Array, arms: Float64Array, softness: float = 0.0) -> tuple[Float64Array, Float64Array]:
    """Shares of a load that balance, shape (n,), sum 1, and their tilt, shape (2,).

    Shares s_k ~ exp(e_k + t' a_k) at the arms a_k from the centre of mass balance where the tilt t minimises

        log sum_k exp(e_k + t' a_k) + f |t|^2

    a convex function, whose slope is the centre of the load plus 2 f t. With f = 0 the balance is exact; with f > 0 there is an answer
    where none balances. Shapes: `exponent` e (n,), `arms` a, relative to the size of the object [-], (n, 2); `softness` is f [-].
    """
    tilt = np.zeros(2)
    share, potential = _shares(exponent)
    for _ in range(100):  # Newton's method on a convex function needs some ten
        centre = share @ arms
        slope = centre + 2.0 * softness * tilt
        if np.max(np.abs(slope)) < 1e-12:  # it balances
            break
        spread = (arms * share[:, None]).T @ arms - np.outer(centre, centre)
        # The spread is about 1 unless the load is on one line or point.
        step = -np.linalg.solve(spread + (2.0 * softness + 1e-12) * np.eye(2), slope)
        # Where nearly all of the load is in one place, the potential is a plane, and Newton's step without end. This one changes ratios of
        # loads by a factor of e^10.
        step *= min(1.0, 10.0 / float(np.linalg.norm(step)))
        part = 1.0
        while part > 1e-9:  # below it the decrease is lost in rounding
            trial = tilt + part * step
            share, raw = _shares(exponent + arms @ trial)
            reached = raw + softness * float(trial @ trial)
            # A share of the expected decrease (Armijo's rule: Nocedal & Wright, Numerical Optimization, ch. 3), but for rounding.
            if reached <= potential + 1e-4 * part * float(slope @ step) + 1e-14 * (1.0 + abs(potential)):
                break
            part *= 0.5
        tilt, potential = tilt + part * step, reached
    return share, tilt


def _shares(exponent: Float64Array) -> tuple[Float64Array, float]:
    """Softmax, and the logarithm of its sum."""
    top = float(exponent.max())
    share = np.exp(exponent - top)
    total = float(share.sum())
    return share / total, top + float(np.log(total))
