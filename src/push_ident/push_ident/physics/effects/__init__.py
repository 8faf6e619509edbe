"""The catalogue of effects: every module of this folder holds one as `EFFECT`. To add an effect, add a file."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from push_ident.physics.effect import Effect

__all__ = ["EFFECTS"]


def _discover() -> dict[str, Effect]:
    found: dict[str, Effect] = {}
    for name in sorted(module.name for module in iter_modules(__path__)):
        effect: Effect = import_module(f"{__name__}.{name}").EFFECT
        if effect.name != name:
            raise ImportError(f"The effect in {name}.py is called {effect.name!r}; give file and effect the same name.")
        found[name] = effect
    return found


EFFECTS = _discover()
"""All effects by their name."""
