"""Total mass from measured forces: poses carry no information about it.

A force determines the product of total mass and friction scale. Poses (through inertia) and the prior bound both factors weakly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from push_ident.identification.result import Estimate, ModelPosterior

__all__ = ["with_total_mass"]

_IDENTIFIABLE = 0.5
"""The total mass is identified when its posterior standard deviation is below this share of the prior's."""


def with_total_mass(posterior: ModelPosterior) -> ModelPosterior:
    """State the total mass of a posterior that has it among its unknowns; any other stays as it is."""
    block, own = posterior.unknowns.block("total_mass"), posterior.unknowns.slice_of("total_mass")
    if block.size == 0:
        return posterior
    (std,), prior = block.std, posterior.prior
    value = prior.total_mass * float(np.exp(std * posterior.z[own][0]))
    log_std = float(std * np.sqrt(posterior.covariance[own, own][0, 0]))
    identified = bool(prior.total_mass_std == 0 or log_std < _IDENTIFIABLE * prior.total_mass_std)
    return replace(posterior, total_mass=Estimate(value, value * log_std), total_mass_identifiable=identified)
