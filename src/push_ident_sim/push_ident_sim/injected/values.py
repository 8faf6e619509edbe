"""The effects of one simulated world, with the values of their parameters."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from push_ident.errors import InputError
from push_ident_sim.injected.catalogue import INJECTED
from push_ident_sim.injected.effect import InjectedEffect

__all__ = ["InjectedEffects"]


@dataclass(frozen=True, slots=True)
class InjectedEffects:
    """The effects injected into one simulation; none by default."""

    values: tuple[tuple[str, tuple[float, ...]], ...] = ()
    """Names and parameters, sorted by name. Effects of size zero are dropped, so that they change no bit of a simulation."""

    def __post_init__(self) -> None:
        chosen: dict[str, tuple[float, ...]] = {}
        for name, given in self.values:
            if name not in INJECTED:
                raise InputError(f"Effect {name!r} is not known, expected some of {', '.join(INJECTED)}.")
            if name in chosen:
                raise InputError(f"Effect {name} is given twice; give it once with all its parameters.")
            chosen[name] = _checked(INJECTED[name], given)
        switched_on = {
            name: values
            for name, values in chosen.items()
            if any(value != p.default for value, p in zip(values, INJECTED[name].parameters, strict=False) if not p.is_shape)
        }
        object.__setattr__(self, "values", tuple(sorted(switched_on.items())))

    @classmethod
    def of(cls, values: Mapping[str, float | Sequence[float]]) -> InjectedEffects:
        """From names and parameters: one number, or several; missing ones at the end take their default."""
        return cls(tuple((name, tuple(v) if isinstance(v, Sequence) else (float(v),)) for name, v in values.items()))

    @classmethod
    def parse(cls, texts: Iterable[str]) -> InjectedEffects:
        """From texts such as `table_tilt=0.02` or `table_tilt=0.02,-0.01`. Raises InputError for what is not of that form."""
        effects = []
        for text in texts:
            name, equals, numbers = text.partition("=")
            try:
                values = tuple(float(number) for number in numbers.split(","))
            except ValueError:
                values = ()
            if not (equals and values):
                raise InputError(f"Effect {text!r} has no size, expected NAME=VALUE or NAME=VALUE,VALUE such as table_tilt=0.02.")
            effects.append((name.strip(), values))
        return cls(tuple(effects))

    def __bool__(self) -> bool:
        return bool(self.values)

    def __contains__(self, name: str) -> bool:
        return any(effect == name for effect, _ in self.values)

    def __getitem__(self, name: str) -> tuple[float, ...]:
        """Parameters of an effect; its defaults, at which it does nothing, where it is not injected."""
        return self.as_dict().get(name) or INJECTED[name].defaults

    def as_dict(self) -> dict[str, tuple[float, ...]]:
        """Parameters of the injected effects by name."""
        return dict(self.values)

    def acting_on(self, *parts: str) -> tuple[str, ...]:
        """Names of the injected effects that act on one of `parts`."""
        return tuple(name for name, _ in self.values if INJECTED[name].acts_on in parts)


def _checked(effect: InjectedEffect, given: Sequence[float]) -> tuple[float, ...]:
    """The values with defaults added. Those that the world chooses are given all or not at all."""
    named = ", ".join(f"{p.name} [{p.unit}]" for p in effect.parameters)
    n_defaults, n_all = len(effect.defaults), len(effect.parameters)
    if not (0 < len(given) <= n_defaults or len(given) == n_all):
        expected = f"1 to {n_defaults}" + (f" or {n_all}" if n_all > n_defaults else "")
        raise InputError(f"Effect {effect.name} has {len(given)} values, expected {expected}: {named}.")
    values = (*map(float, given), *effect.defaults[len(given) :])
    for value, p in zip(values, effect.parameters, strict=False):
        if not (math.isfinite(value) and p.lowest <= value <= p.highest):
            raise InputError(f"{p.name} of effect {effect.name} is {value:g} {p.unit}, expected {p.lowest:g} to {p.highest:g}.")
        if 0.0 < abs(value) < p.smallest:
            raise InputError(f"{p.name} of effect {effect.name} is {value:g} {p.unit}, expected 0 or at least {p.smallest:g}.")
    return values
