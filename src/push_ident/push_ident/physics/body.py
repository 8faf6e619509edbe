"""The rigid body that cells make together, and the derivative of its parameters by those of the cells.

M = sum m_i,   c = sum m_i r_i / M,   I = sum m_i (|r_i - c|^2 + a_i / 6),   f_i = mu_i m_i g        a_i: area of a cell
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.physics.active_effects import NO_MODES
from push_ident.physics.contact import count_inside
from push_ident.physics.support import GRAVITY
from push_ident.physics.tape import Param
from push_ident.types import Float64Array, ObjectShape


@dataclass(frozen=True, slots=True)
class BodyParameters:
    """Parameters of a rigid object that slides on a table."""

    mass: float
    """[kg]"""
    centre: Float64Array
    """Centre of mass [m], shape (2,), object frame."""
    inertia: float
    """About the centre of mass [kg m^2]."""
    limit: Float64Array
    """Friction force of each cell when it slides [N], shape (n_cells,)."""
    outline_modes: Float64Array = field(default_factory=lambda: NO_MODES)
    """Displacements of the vertices of the outline by which derivatives are wanted, too, object frame, shape (n_modes, n_vertices, 2)."""


def body_of_cells(shape: ObjectShape, mass: Float64Array, friction: Float64Array) -> BodyParameters:
    """Rigid body made of the cells: plates, square or nearly so, that each rest on their own weight.

    Args:
        shape: cells of the object.
        mass: of each cell [kg], shape (n_cells,), >= 0 and not all zero.
        friction: support friction coefficient of each cell, shape (n_cells,), >= 0.

    Raises:
        InputError: values of another shape, not finite, negative, or without any mass.
    """
    mass, friction = np.asarray(mass, dtype=np.float64), np.asarray(friction, dtype=np.float64)
    n_cells = len(shape.cells)
    for name, value in (("mass", mass), ("friction", friction)):
        if value.shape != (n_cells,):
            raise InputError(f"`{name}` has shape {value.shape}, expected ({n_cells},), a value for each cell of the object.")
        if not np.all(np.isfinite(value) & (value >= 0)):
            raise InputError(f"`{name}` has {int(np.sum(~(np.isfinite(value) & (value >= 0))))} cells that are not numbers >= 0.")
    centres = shape.cells.centres
    total = float(np.sum(mass))
    if total <= 0:
        raise InputError(f"The {n_cells} cells weigh {total} kg together; a body that moves needs mass > 0 in one cell at least.")
    centre = mass @ centres / total
    inertia = float(mass @ _moments(shape, centre))
    return BodyParameters(mass=total, centre=centre, inertia=inertia, limit=friction * mass * GRAVITY)


def _moments(shape: ObjectShape, centre: Float64Array) -> Float64Array:
    """Moment of inertia about `centre` of each cell per mass [m^2], shape (n_cells,)."""
    return np.sum((shape.cells.centres - centre) ** 2, axis=1) + shape.cells.areas / 6


def cell_gradient(
    shape: ObjectShape, mass: Float64Array, friction: Float64Array, gradient: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Chain a gradient by the body's parameters to the cells: the transposed derivative of `body_of_cells`.

    Args:
        shape, mass, friction: as for `body_of_cells`.
        gradient: by the columns of `Motion.jacobian`, shape (..., 8 + n_cells + n_values).

    Returns:
        Gradients by the mass [1/kg] and by the friction coefficient of each cell, each of shape (..., n_cells).
    """
    total = float(np.sum(mass))
    centre = mass @ shape.cells.centres / total
    by_limit = gradient[..., Param.LIMIT : Param.LIMIT + len(mass)]
    by_mass = (
        gradient[..., Param.MASS, None]
        + gradient[..., Param.CENTRE : Param.CENTRE + 2] @ ((shape.cells.centres - centre) / total).T
        # The centre moves too, but about the centre of mass the inertia does not change with that.
        + gradient[..., Param.INERTIA, None] * _moments(shape, centre)
        + by_limit * (friction * GRAVITY)
    )
    return by_mass, by_limit * (mass * GRAVITY)


def check_body(shape: ObjectShape, body: BodyParameters, pusher_friction: float) -> None:
    """Refuse a body that cannot be simulated.

    Raises:
        InputError: values that are not finite, negative or of another shape, or an outline that holds less than half of the cells.
    """
    if not (np.isfinite(body.mass) and body.mass > 0 and np.isfinite(body.inertia) and body.inertia > 0):
        raise InputError(f"The body has mass {body.mass} kg and inertia {body.inertia} kg m^2, expected positive numbers.")
    if np.shape(body.centre) != (2,) or not np.isfinite(body.centre).all():
        raise InputError(f"The body's centre of mass is {body.centre}, expected two finite numbers in metres.")
    n_inside = count_inside(owned(shape.cells.centres), owned(shape.outline))
    # Outlines are traced and straightened: a few centres at the rim may lie outside.
    if 2 * n_inside < len(shape.cells):
        raise InputError(
            f"{n_inside} of {len(shape.cells)} cell centres lie inside the outline, expected at least half; "
            "give cells and outline in the same frame, in metres."
        )
    limit = np.asarray(body.limit)
    if limit.shape != (len(shape.cells),):
        raise InputError(f"The body's friction limits have shape {limit.shape}, expected ({len(shape.cells)},) as the cells.")
    if not (np.isfinite(limit) & (limit >= 0)).all():
        raise InputError(f"{int(np.sum(~(np.isfinite(limit) & (limit >= 0))))} friction limits of cells are not forces >= 0 N.")
    if not (np.isfinite(pusher_friction) and pusher_friction >= 0):
        raise InputError(f"The pusher's friction coefficient is {pusher_friction}, expected a number >= 0.")


def owned(values: ArrayLike) -> Float64Array:
    """A writable copy in C order: numba would compile every kernel again for arrays that are read-only or of another memory layout."""
    return np.array(values, dtype=np.float64, order="C")
