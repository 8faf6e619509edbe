"""What an injected effect is: an effect that a simulated world has.

An effect of the core's catalogue (`push_ident.physics.effects`) keeps its name there, and its parameters keep their names, units and
meaning. What is added here are the sizes that a simulation can bring about, and how it does so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["InjectedEffect", "InjectedParameter", "Part"]

Part = Literal["table", "object", "pusher", "camera", "poses", "forces"]
"""Part of the cell that an effect acts on. `poses`, `forces`: on what is reported; a rendered camera cannot have the first."""


@dataclass(frozen=True, slots=True)
class InjectedParameter:
    """One number of an injected effect, with its range in simulations."""

    name: str
    unit: str
    """"1" where it has none."""
    typical: float
    """Of a cell that was set up with ordinary care."""
    lowest: float
    highest: float
    what: str = ""
    default: float | None = 0.0
    """Value where none is given. None: the world chooses it, see `how` of the effect."""
    is_shape: bool = False
    """It only shapes the effect that other parameters switch on."""
    smallest: float = 0.0
    """The simulation cannot bring about sizes between 0 and this."""
    times_friction: bool = False
    """`typical`, `lowest` and `highest` are for a friction coefficient of 1; sizes drawn for an object are scaled by its mean one."""

    @property
    def described(self) -> str:
        """One line for people."""
        sizes = f"{self.lowest:g} to {self.highest:g}"
        if self.default is None:
            return f"{self.name} [{self.unit}]: {self.what}; {sizes}, optional"
        typical = f"{self.default:g} by default" if self.is_shape else f"typical {self.typical:g}"
        return f"{self.name} [{self.unit}]: {self.what}; {sizes}, {typical}" + (
            " times the friction coefficient" if self.times_friction else ""
        )


@dataclass(frozen=True, slots=True)
class InjectedEffect:
    """An effect that a simulated world can have."""

    name: str
    acts_on: Part
    parameters: tuple[InjectedParameter, ...]
    what: str
    how: str
    """How the simulation brings it about."""
    has_own_law: bool = True
    """Whether the engines have a law of their own for it; else they evaluate the equation of the core's catalogue."""

    @property
    def acting(self) -> tuple[InjectedParameter, ...]:
        """The parameters that switch the effect on where they are not at their default."""
        return tuple(p for p in self.parameters if not p.is_shape and p.default is not None)

    @property
    def defaults(self) -> tuple[float, ...]:
        """Values at which it does nothing, without those that the world chooses."""
        return tuple(p.default for p in self.parameters if p.default is not None)

    def typical(self, mean_friction: float = 1.0) -> dict[str, tuple[float, ...]]:
        """The effect in its typical size, for `InjectedEffects`; along the first axis where it has a direction."""
        first = self.parameters[0]
        return {self.name: (first.typical * (mean_friction if first.times_friction else 1.0), *self.defaults[1:])}
