"""A second engine: an object in the plane on bristles and springs. It shares no law and no code with the model that identifies."""

from __future__ import annotations

from push_ident_sim.engines.planar.laws import OUTSIDE
from push_ident_sim.engines.planar.world import PlanarWorld

__all__ = ["OUTSIDE", "PlanarWorld"]
