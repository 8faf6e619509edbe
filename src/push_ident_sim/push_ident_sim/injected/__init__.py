"""Effects that a simulated world has and that the model does not know of, in the names and parameters of the core's catalogue."""

from __future__ import annotations

from push_ident_sim.injected.effects import INJECTED, InjectedEffect, InjectedEffects, InjectedParameter

__all__ = ["INJECTED", "InjectedEffect", "InjectedEffects", "InjectedParameter"]
