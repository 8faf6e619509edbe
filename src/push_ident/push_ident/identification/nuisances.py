"""Errors of a measurement that are unknowns beside the object: of the outline that a camera traced, of where the camera stands, and of a
force sensor."""

from __future__ import annotations

import numpy as np

from push_ident.identification.prior import Prior
from push_ident.physics.effects import CAMERA_ERRORS, EFFECTS, SENSOR_ERRORS
from push_ident.types import Float64Array, ObjectShape

__all__ = ["measured_std", "nuisances_of"]


def nuisances_of(shape: ObjectShape, prior: Prior) -> tuple[str, ...]:
    """Effects that are unknown by how shape and poses were measured, whatever the object is.

    Pushes show where an outline that a camera traced really is, and where the camera stands with respect to the pusher.
    """
    return tuple(name for name in (*CAMERA_ERRORS, *SENSOR_ERRORS) if np.any(measured_std(name, shape, prior) > 0))


def measured_std(name: str, shape: ObjectShape, prior: Prior) -> Float64Array:
    """Standard deviations of the parameters of an effect, as far as those who measured state them, shape (n_parameters,); else 0."""
    effect = EFFECTS[name]
    if effect.moves_outline:
        return np.full(len(effect.parameters), shape.outline_error or 0.0)
    if effect.is_sensor_error:
        uses = prior.force_offset_std > 0
        return np.array([prior.force_offset_std if p.unit == "N" else (p.sensor_std or 0.0) * uses for p in effect.parameters])
    stated = {"m": prior.camera_position_std, "rad": prior.camera_heading_std} if effect.is_camera_error else {}
    return np.array([stated.get(parameter.unit, 0.0) for parameter in effect.parameters])
