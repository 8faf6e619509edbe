"""Shares of a load that balance: the tilt of least potential.

Shares s_k ~ exp(e_k + t' a_k) of a load at the arms a_k from the centre of mass balance where the tilt t minimises

    log sum_k exp(e_k + t' a_k) + f |t|^2

a convex function, whose slope is the centre of the load plus 2 f t. With f = 0 the balance is exact; with f > 0 there is an answer
where none balances.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from push_ident.types import Float64Array

__all__ = ["balance"]

_BALANCED: Final = 1e-12
"""Slope at which the load balances, relative to the size of the object [-]."""
_MAX_STEPS: Final = 100
"""Newton's method on a convex function needs some ten."""
_ARMIJO: Final = 1e-4
"""Share of the expected decrease that a step must make (Nocedal & Wright, Numerical Optimization, ch. 3) [-]."""
_REGULAR: Final = 1e-12
"""Added to the spread, which is about 1 unless the load is on one line or point [-]."""
_LONGEST: Final = 10.0
"""Step of the tilt: it changes ratios of loads by a factor of e^10 over the size of the object [-]."""
_SHORTEST: Final = 1e-9
"""Shortest share of a step: below it the decrease is lost in rounding [-]."""
_ROUNDING: Final = 1e-14
"""Relative error of the potential: near its minimum a step is not refused for less [-]."""


def balance(exponent: Float64Array, arms: Float64Array, softness: float = 0.0) -> tuple[Float64Array, Float64Array]:
    """Shares that balance, shape (n,), sum 1, and their tilt, shape (2,).

    Args:
        exponent: e, shape (n,).
        arms: a, relative to the size of the object [-], shape (n, 2).
        softness: f [-].
    """
    tilt = np.zeros(2)
    share, potential = _shares(exponent)
    for _ in range(_MAX_STEPS):
        centre = share @ arms
        slope = centre + 2.0 * softness * tilt
        if np.max(np.abs(slope)) < _BALANCED:
            break
        spread = (arms * share[:, None]).T @ arms - np.outer(centre, centre)
        step = -np.linalg.solve(spread + (2.0 * softness + _REGULAR) * np.eye(2), slope)
        # Where nearly all of the load is in one place, the potential is a plane, and Newton's step without end.
        step *= min(1.0, _LONGEST / float(np.linalg.norm(step)))
        part = 1.0
        while part > _SHORTEST:
            trial = tilt + part * step
            share, raw = _shares(exponent + arms @ trial)
            reached = raw + softness * float(trial @ trial)
            if reached <= potential + _ARMIJO * part * float(slope @ step) + _ROUNDING * (1.0 + abs(potential)):
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
