"""Errors of a measurement that are unknowns beside the object: of the outline that a camera traced, of where the camera stands, and of a
force sensor."""

from __future__ import annotations

from typing import Final

import numpy as np

from push_ident.identification.prior import Prior
from push_ident.physics.effects import CAMERA_ERRORS, EFFECTS
from push_ident.types import Float64Array, ObjectShape

__all__ = ["measured_std", "nuisances_of"]


_OF_FORCES: Final = ("force_offset", "force_delay")
"""Errors that every force sensor has."""


def nuisances_of(shape: ObjectShape, prior: Prior) -> tuple[str, ...]:
    """Effects that are unknown by how shape and poses were measured, whatever the object is.

    Pushes show where an outline that a camera traced really is, and where the camera stands with respect to the pusher.
    """
    return tuple(name for name in (*CAMERA_ERRORS, *_OF_FORCES) if np.any(measured_std(name, shape, prior) > 0))


def measured_std(name: str, shape: ObjectShape, prior: Prior) -> Float64Array:
    """Standard deviations of the parameters of an effect, as far as those who measured state them, shape (n_parameters,); else 0."""
    effect = EFFECTS[name]
    if effect.moves_outline:
        return np.full(len(effect.parameters), shape.outline_error or 0.0)
    if name in _OF_FORCES and prior.force_offset_std > 0:
        return np.array([prior.force_offset_std if parameter.unit == "N" else parameter.scale for parameter in effect.parameters])
    stated = {"m": prior.camera_position_std, "rad": prior.camera_heading_std} if effect.is_camera_error else {}
    return np.array([stated.get(parameter.unit, 0.0) for parameter in effect.parameters])
