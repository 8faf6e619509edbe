"""The object in the steps of a rollout, as the kernels take it (compiled)."""

from __future__ import annotations

from typing import NamedTuple

from push_ident.types import Float64Array

__all__ = ["StepGeometry"]


class StepGeometry(NamedTuple):
    """The object in a step. It is made once for a rollout; what changes from step to step is written into its arrays."""

    arms: Float64Array
    """Cell centres from the centre of mass [m], shape (2, n_cells), object axes."""
    limit: Float64Array
    """Sliding friction of each cell in this step [N], shape (n_cells,)."""
    inertia: Float64Array
    """(m, m, I) about the centre of mass [kg, kg, kg m^2], shape (3,); zeros for a quasi-static step."""
    reach: float
    """Length that turns a rate of rotation into a speed [m]."""
    centre: Float64Array
    """Of mass [m], shape (2,), object frame."""
    heading: Float64Array
    """cos and sin of the yaw at the start of this step, shape (2,)."""
    dt: float
    """Length of this step [s]."""
    is_struck: bool = False
    """The object was at rest before this step, which resolves the time of the first contact within it (`contact_rows.py`)."""
