"""What every import reports."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from push_ident.checking.overlap import Overlap
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What was imported, and published properties of the object that a bag cannot hold."""

    bag: Path
    n_pushes: int
    contact_distance: Float64Array
    """Distance of the pusher's surface to the outline at first contact of each push [m], negative inside; NaN where nothing shows a
    contact; shape (n_pushes,)."""
    tolerance: float
    """Distance that noise explains [m]; see `contact_tolerance`."""
    supports: Float64Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Known support points [m], shape (n_supports, 2), object frame; none where they are unknown or the object rests on its whole base."""
    mass: float | None = None
    """[kg]; None where it was not published."""
    centre_of_mass: Float64Array | None = None
    """[m], shape (2,), object frame; None where it was not published."""
    surface: str = ""
    """Table surface by its published name; empty where it is unknown."""
    notes: tuple[str, ...] = ()
    """What a user of the bag should know."""
    warnings: tuple[str, ...] = ()
    """What may be wrong with the recording or with the options of the import."""
    overlap: Overlap | None = None
    """Pusher and object while the object moves; None where the importer does not compare them."""
