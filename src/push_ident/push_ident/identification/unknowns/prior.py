"""What is assumed of an object before it is pushed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.limits import LIMITS
from push_ident.types import CameraAccuracy, Float64Array, PushRecord

GIVEN_STD: Final = 1e-3
"""Standard deviation of a logarithm that counts as given [-]: a thousandth of the coefficient, far below what any push or scale determines.
It is not 0, so that one parametrisation serves free and given coefficients and the Hessian stays regular."""
_LARGEST: Final = {
    "total_mass": LIMITS.MASS,
    "friction": LIMITS.FRICTION,
    "pusher_friction": LIMITS.FRICTION,
    "camera_position_std": LIMITS.COORDINATE,
    "camera_heading_std": LIMITS.YAW,
    "force_offset_std": LIMITS.FORCE,
    "max_modes": LIMITS.CELLS,
    "feet": LIMITS.CELLS,
}
MAP_STDS: Final = ("mass_map_std", "pressure_map_std", "friction_map_std")


@dataclass(frozen=True, slots=True)
class MapPrior:
    """How uneven maps are expected to be."""

    mass_std: float
    """Standard deviation of the logarithm of the mass of a cell about the mean [-]."""
    pressure_std: float
    """Of the logarithm of the load of a cell over its weight [-]."""
    friction_std: float
    """Of the logarithm of the friction of a cell about the mean [-]."""
    length: float
    """Correlation length, divided by the diagonal of the object [-]."""

    @classmethod
    def of_logs(cls, logs: Float64Array) -> MapPrior:
        """From the logarithms of the four, shape (4,)."""
        return cls(*(float(value) for value in np.exp(logs)))

    @property
    def logs(self) -> Float64Array:
        """Logarithms of the four, shape (4,)."""
        return np.log([self.mass_std, self.pressure_std, self.friction_std, self.length])


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
    pressure_map_std: float = 0.7
    """Standard deviation of the logarithm of the load of a cell over its weight; 0: each cell bears its own weight."""
    friction_map_std: float = 0.7
    """Standard deviation of the logarithm of the friction of a cell about the mean."""
    correlation_length: float = 0.25
    """Correlation length of the maps, divided by the diagonal of the object."""
    max_modes: int = 40
    """Largest number of modes of a map."""
    camera_position_std: float = 0.0
    """Standard deviation of the place at which the camera sees the origin of the table frame, along x and y [m]; 0: it is exact."""
    camera_heading_std: float = 0.0
    """Standard deviation of the rotation of the camera about the normal of the table [rad]; 0: it is exact."""
    force_offset_std: float = 0.0
    """Standard deviation of a constant error of measured forces along x and y [N]; 0: no forces are used. Where they are, the total mass,
    which poses do not show, is an unknown beside the others."""
    feet: int = 0
    """Number of feet of unknown place that bear the load; 0: the whole base does. There is no map of the load then."""

    def __post_init__(self) -> None:
        positive = ("total_mass", "friction", "pusher_friction", "friction_std", "pusher_friction_std", "correlation_length")
        for name in (*positive, "total_mass_std", "camera_position_std", "camera_heading_std", "force_offset_std", *MAP_STDS):
            value = getattr(self, name)
            if not (np.isfinite(value) and (value > 0 or (value == 0 and name not in positive))):
                raise InputError(f"Prior.{name} is {value}, expected a {'positive number' if name in positive else 'number >= 0'}.")
        for name, most in _LARGEST.items():
            most.check(getattr(self, name), f"Prior.{name}", remedy="Give SI units.")
        if self.max_modes < 0:
            raise InputError(f"Prior.max_modes is {self.max_modes}, expected a number >= 0.")
        if self.feet < 0 or self.feet == 1:
            raise InputError(f"Prior.feet is {self.feet}, expected 0 (the whole base bears the load) or at least 2.")

    def with_camera_accuracy(self, cameras: Iterable[CameraAccuracy]) -> Prior:
        """The same prior with the accuracy of the least accurate of the cameras that measured the poses, unless it has one itself."""
        if self.camera_position_std > 0 or self.camera_heading_std > 0:
            return self
        stated = list(cameras)
        return replace(
            self,
            camera_position_std=max((camera.position for camera in stated), default=0.0),
            camera_heading_std=max((camera.heading for camera in stated), default=0.0),
        )

    def with_force_offset(self, records: Iterable[PushRecord], std: float = 0.1) -> Prior:
        """The same prior for pushes of which forces were measured, unless it has an offset itself.

        `std` is that of a sensor that was tared [N]: what drift and cables leave.
        """
        if self.force_offset_std > 0 or all(record.wrench is None for record in records):
            return self
        return replace(self, force_offset_std=std)

    def without_pressure(self) -> Prior:
        """The same prior where each cell bears its own weight: one map fewer, and the same products of mass and friction."""
        return replace(self, pressure_map_std=0.0)

    def on_feet(self, number: int, mass_std: float = 0.1, friction_std: float = 0.05) -> Prior:
        """The same prior of an object that stands on feet, with nearly even maps: where it stands says more; the prior itself for 0.

        `mass_std` moves the centre of mass by a hundredth of the object; all feet slide on one table, hence `friction_std`.
        """
        return replace(self, feet=number, mass_map_std=mass_std, friction_map_std=friction_std) if number else self
