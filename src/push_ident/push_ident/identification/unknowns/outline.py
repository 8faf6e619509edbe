"""Where the surface of an object may lie beside the outline that a camera traced: the block `outline` of the unknowns.

Each vertex may be displaced along both axes, by the deviation that the camera states for its two edges; vertices near each other along the
outline alike, as errors within the window of a matcher are. So an edge may lie elsewhere, and it may be inclined, which matters more: the
direction in which a pusher pushes decides how far the object turns. Pushes show both, by where the pusher touches and how the object moves
on. An error that all edges share is the effect `outline_error`.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from push_ident.physics.active_effects import NO_MODES
from push_ident.types import Float64Array, ObjectShape

_ALIKE: Final = 0.015
"""Distance along the outline over which errors of vertices stay alike [m]: a matcher's window of 8 px of 2 mm."""
_LEFT_OUT: Final = 0.05
"""Part of the variance of the vertices that their modes may leave out [1]."""


def outline_modes(shape: ObjectShape) -> Float64Array:
    """Displacements of the vertices by unknowns of unit variance [m], object frame, shape (n_modes, n_vertices, 2); none for an exact
    outline."""
    if shape.outline_std is None:
        return NO_MODES
    std = np.sqrt(0.5 * (shape.outline_std**2 + np.roll(shape.outline_std, 1) ** 2))
    length = np.linalg.norm(np.roll(shape.outline, -1, axis=0) - shape.outline, axis=1)
    arc_length = np.cumsum(length) - length
    apart = np.abs(arc_length[:, None] - arc_length)
    apart = np.minimum(apart, length.sum() - apart)
    value, vector = np.linalg.eigh(np.exp(-apart / _ALIKE) * np.outer(std, std))
    value, vector = value[::-1], vector[:, ::-1]
    kept = 1 + int(np.searchsorted(np.cumsum(value), (1.0 - _LEFT_OUT) * value.sum()))
    modes = (vector[:, :kept] * np.sqrt(np.maximum(value[:kept], 0.0))).T
    return np.concatenate([modes[:, :, None] * axis for axis in np.eye(2)])
