"""What is assumed of an object before it is pushed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from push_ident.errors import InputError

__all__ = ["Prior"]

_FROZEN_STD = 1e-3
"""Standard deviation of a logarithm that counts as given [-]: a thousandth of the coefficient, far below what any push determines. It is
not 0, so that one parametrisation serves free and given coefficients and the Hessian stays regular."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Nominal values of an object and the standard deviations about them."""

    total_mass: float = 0.5
    """Nominal, or known, total mass [kg]."""
    total_mass_std: float = 0.7
    """Standard deviation of its logarithm; 0 where the weight is known."""
    friction: float = 0.3
    """Nominal support friction coefficient."""
    friction_std: float = 0.4
    """Standard deviation of the logarithm of the friction of the whole object."""
    pusher_friction: float = 0.3
    """Nominal friction coefficient between pusher and object."""
    pusher_friction_std: float = 0.6
    """Standard deviation of its logarithm."""
    mass_map_std: float = 0.7
    """Standard deviation of the logarithm of the mass of a cell about the mean."""
    friction_map_std: float = 0.7
    """Standard deviation of the logarithm of the friction of a cell about the mean."""
    correlation_length: float = 0.25
    """Correlation length of the maps, divided by the diagonal of the object."""
    max_modes: int = 40
    """Largest number of modes of a map."""

    def __post_init__(self) -> None:
        for name in ("total_mass", "friction", "pusher_friction", "friction_std", "pusher_friction_std", "correlation_length"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"Prior.{name} is {value}, expected a positive number.")
        for name in ("total_mass_std", "mass_map_std", "friction_map_std"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"Prior.{name} is {value}, expected a number >= 0.")

    def at_amplitude(self, amplitude: float) -> Prior:
        """The same prior with the standard deviations of both maps multiplied by `amplitude`."""
        return replace(self, mass_map_std=amplitude * self.mass_map_std, friction_map_std=amplitude * self.friction_map_std)

    def with_pusher_friction_frozen(self) -> Prior:
        """The same prior with the friction coefficient of the pusher given."""
        return replace(self, pusher_friction_std=_FROZEN_STD)
