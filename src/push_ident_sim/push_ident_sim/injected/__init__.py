"""Effects that the planar model does not have, injected into the simulated cell one by one; each is off unless it is asked for."""

from __future__ import annotations

from push_ident_sim.injected.catalogue import EFFECTS, Effect, EffectParameter, Effects

__all__ = ["EFFECTS", "Effect", "EffectParameter", "Effects"]
