"""Where an object stands, as a fit with feet sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.identification.results.covariance import lower_root
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.mechanics import feet_at
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class Support:
    """One foot."""

    position: Float64Array
    """Object frame [m], shape (2,)."""
    position_std: Float64Array
    """[m], shape (2,)."""
    share: float
    """Of the weight [-]."""
    share_std: float


def supports(posterior: ModelPosterior, n_draws: int = 200) -> tuple[Support, ...]:
    """The feet of an object, the one with the largest share first; none where it stands on its whole base.

    The standard deviations are those about this arrangement; another one may explain the same pushes as well. They are known to 5 % with
    200 drawn models.
    """
    unknowns = posterior.unknowns
    if not unknowns.prior.feet:
        return ()
    mean = feet_at(unknowns, posterior.z)
    root = lower_root(posterior.covariance)
    draws = np.random.default_rng(0).normal(size=(n_draws, unknowns.size)) @ root.T
    drawn = [feet_at(unknowns, posterior.z + step) for step in draws]
    position_std = np.std([feet.position for feet in drawn], axis=0)
    share_std = np.std([feet.share for feet in drawn], axis=0)
    order = np.argsort(-mean.share)
    return tuple(Support(mean.position[k], position_std[k], float(mean.share[k]), float(share_std[k])) for k in order)
