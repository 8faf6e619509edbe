"""Where an object stands, as a fit with feet sees it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.identification.covariance import lower_root
from push_ident.identification.result import ModelPosterior
from push_ident.types import Float64Array

__all__ = ["Support", "supports"]

_DRAWS: Final = 200
"""Models drawn for the standard deviations: these are known to 5 % then."""


@dataclass(frozen=True, slots=True)
class Support:
    """One foot."""

    place: Float64Array
    """Object frame [m], shape (2,)."""
    place_std: Float64Array
    """[m], shape (2,)."""
    share: float
    """Of the weight [-]."""
    share_std: float


def supports(posterior: ModelPosterior) -> tuple[Support, ...]:
    """The feet of an object, the one with the largest share first; none where it stands on its whole base.

    The standard deviations are those about this arrangement; another one may explain the same pushes as well.
    """
    unknowns = posterior.unknowns
    if not unknowns.prior.feet:
        return ()
    mean = unknowns.feet(posterior.z)
    root = lower_root(posterior.covariance)
    draws = np.random.default_rng(0).normal(size=(_DRAWS, unknowns.size)) @ root.T
    drawn = [unknowns.feet(posterior.z + step) for step in draws]
    place_std = np.std([feet.place for feet in drawn], axis=0)
    share_std = np.std([feet.share for feet in drawn], axis=0)
    order = np.argsort(-mean.share)
    return tuple(Support(mean.place[k], place_std[k], float(mean.share[k]), float(share_std[k])) for k in order)
