"""Every effect that can be injected: its parameters, what it does, and how the simulation brings it about.

Signs and units are those in which a diagnosis states an effect. `table` axes unless said otherwise; lengths in metres, angles in radians,
forces in newtons.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from push_ident.errors import InputError

__all__ = ["EFFECTS", "Effect", "EffectParameter", "Effects"]


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One number of an effect."""

    name: str
    unit: str
    typical: float
    """Of a cell that was set up with ordinary care."""
    lowest: float
    highest: float
    default: float = 0.0
    """Value when it is not given. A parameter whose default is not 0 only shapes the effect and does not switch it on."""
    smallest: float = 0.0
    """Between 0 and this the simulation cannot bring it about."""


@dataclass(frozen=True, slots=True)
class Effect:
    """One entry of the catalogue."""

    name: str
    acts_on: Literal["table", "object", "pusher", "camera", "poses"]
    """`poses`: it works on poses that are reported, not on a rendered camera."""
    parameters: tuple[EffectParameter, ...]
    what: str
    how: str
    """How it is brought about in the simulation."""
    named: bool = True
    """Whether the diagnosis has a name for it; the others are there to see whether it says so."""

    def typical(self) -> dict[str, tuple[float, ...]]:
        """The effect in its typical size, for `Effects`; along the first axis where it has a direction."""
        values = [p.default for p in self.parameters]
        values[0] = self.parameters[0].typical
        return {self.name: tuple(values)}


def _two(names: Sequence[str], unit: str, typical: float, most: float) -> tuple[EffectParameter, ...]:
    return tuple(EffectParameter(name, unit, typical, -most, most) for name in names)


_TRACELESS = "-mu N (I + E) v/|v| with E = [[e1, e2], [e2, -e1]]"
_CELL_FRICTION = "the friction coefficient of each cell is set anew at each time step"

_ENTRIES = (
    Effect(
        "table_tilt",
        "table",
        _two(("x", "y"), "rad", 0.02, 0.1),
        "the table falls towards +x, +y by this angle: a force m g (x, y)",
        "gravity has these components along the table",
    ),
    Effect(
        "table_anisotropy",
        "table",
        _two(("e1", "e2"), "1", 0.15, 0.5),
        f"grain of the table: friction {_TRACELESS} in table axes",
        "a force on each sliding cell makes up the difference to even friction",
    ),
    Effect(
        "base_anisotropy",
        "object",
        _two(("e1", "e2"), "1", 0.15, 0.5),
        f"grain of the object's base: friction {_TRACELESS} in object axes",
        "a force on each sliding cell makes up the difference to even friction",
    ),
    Effect(
        "position_dependent_friction",
        "table",
        _two(("x", "y"), "1/m", 1.0, 3.0),
        "friction grows across the table: mu (1 + x X + y Y) for a cell at (X, Y)",
        _CELL_FRICTION,
    ),
    Effect(
        "speed_dependent_friction",
        "table",
        (EffectParameter("b", "1", 0.1, -0.3, 0.3),),
        "mu (1 + b ln((v + 0.01 m/s) / (0.1 m/s + 0.01 m/s))) at the speed v of the cell",
        _CELL_FRICTION,
    ),
    Effect(
        "stribeck_friction",
        "table",
        (EffectParameter("s", "1", 0.3, -0.9, 2.0), EffectParameter("speed", "m/s", 0.02, 1e-3, 0.2, default=0.02)),
        "mu (1 + s exp(-(v / speed)^2)): more friction when slow",
        _CELL_FRICTION,
    ),
    Effect(
        "wear",
        "table",
        (EffectParameter("w", "1/push", 0.01, -0.05, 0.1),),
        "mu (1 + w n) after n pushes",
        _CELL_FRICTION,
    ),
    Effect(
        "pusher_friction",
        "pusher",
        (EffectParameter("change", "1", 0.1, -2.0, 2.0),),
        "the friction coefficient of pusher on object is higher by this",
        "friction coefficient of the outline",
    ),
    Effect(
        "push_height",
        "pusher",
        (EffectParameter("height", "m", 0.02, 0.0, 0.1),),
        "the object is pushed at this height above the table: it leans on its far side",
        "the moment of the measured contact force shifts the load of the cells, in proportion to their weight and place",
    ),
    Effect(
        "tether",
        "object",
        (EffectParameter("stiffness", "N/m", 5.0, 0.0, 100.0),),
        "a spring between the object's centre of mass and the place where that was put down",
        "a force on the object",
    ),
    Effect(
        "moving_contents",
        "object",
        (EffectParameter("distance", "m", 0.01, 0.0, 0.05), EffectParameter("time", "s", 0.1, 0.01, 5.0, default=0.1)),
        "what is loose inside slides back: the centre of mass lags by distance (1 - exp(-t / time)) and stays when the object stops",
        "mass moves from cell to cell",
    ),
    Effect(
        "restitution",
        "pusher",
        (EffectParameter("e", "1", 0.3, 0.0, 1.0),),
        "the object bounces off the pusher with this share of the speed of approach",
        "restitution of both bodies",
    ),
    Effect(
        "outline_error",
        "object",
        (EffectParameter("offset", "m", 1e-3, -4e-3, 5e-3),),
        "the object is larger than its outline by this, along the normal",
        "the collision shape is made larger; what is reported is not",
    ),
    Effect(
        "pusher_lag",
        "pusher",
        (EffectParameter("time", "s", 0.02, 0.0, 0.5),),
        "the tool follows the reported one as a first-order system",
        "the arm is led along the delayed path; joint states tell the other",
    ),
    Effect(
        "pusher_speed_scale",
        "pusher",
        (EffectParameter("s", "1", 0.02, -0.2, 0.2),),
        "the tool moves (1 + s) times as far as reported, from where it came down",
        "the arm is led along the longer path; joint states tell the other",
    ),
    Effect(
        "tool_offset",
        "pusher",
        _two(("x", "y"), "m", 2e-3, 0.01),
        "the tool is beside its reported place",
        "the arm is led along the shifted path; joint states tell the other",
    ),
    Effect(
        "camera_rotation",
        "camera",
        (EffectParameter("angle", "rad", 0.01, -0.2, 0.2),),
        "everything is seen turned about the middle of the table",
        "the camera is turned about it the other way; its reported pose is not",
    ),
    Effect(
        "camera_translation",
        "camera",
        _two(("x", "y"), "m", 2e-3, 0.05),
        "everything is seen shifted",
        "the camera is shifted the other way; its reported pose is not",
    ),
    Effect(
        "camera_scale",
        "camera",
        (EffectParameter("scale", "1", 0.01, -0.1, 0.1),),
        "everything is seen (1 + scale) times as far from the middle of the table",
        "poses are scaled; a rendered camera has a focal length (1 + scale) times the reported one, and on a slant sees the table tilted",
    ),
    Effect(
        "pose_latency",
        "camera",
        (EffectParameter("delay", "s", 0.01, 0.0, 0.5),),
        "what is stamped t was seen at t - delay",
        "frames are stamped late",
    ),
    Effect(
        "dropped_frames",
        "camera",
        (EffectParameter("share", "1", 0.3, 0.0, 0.95),),
        "frames are lost at random",
        "frames are left out",
    ),
    Effect(
        "noise_correlation",
        "poses",
        (EffectParameter("rho", "1", 0.6, 0.0, 0.99),),
        "pose noise of consecutive frames is correlated, with the same deviation",
        "first-order autoregressive noise",
        named=False,
    ),
    Effect(
        "pose_flips",
        "poses",
        (EffectParameter("share", "1", 0.05, 0.0, 0.5),),
        "single poses are turned by 180 degrees",
        "half a turn is added to the yaw of frames drawn at random",
        named=False,
    ),
    Effect(
        "compliant_table",
        "table",
        (EffectParameter("travel", "m", 2e-3, 0.0, 0.02, smallest=2e-4),),
        "the table's skin shears by this before a cell slides, and springs back",
        "cells hang on springs that let go at their friction force; Bullet's own friction is off",
        named=False,
    ),
    Effect(
        "viscous_film",
        "table",
        (EffectParameter("damping", "N s/m", 3.0, 0.0, 30.0),),
        "a film of oil: a force against the velocity, spread over all cells, beside dry friction",
        "a force on each cell",
        named=False,
    ),
    Effect(
        "rolling_finger",
        "pusher",
        (EffectParameter("ease", "1", 1.0, 0.0, 1.0, smallest=0.5),),
        "the finger turns about its own axis: 1 freely, below that held by a bearing of (1 - ease) 0.02 N m",
        "the pusher hangs on a turning joint with that friction",
        named=False,
    ),
    Effect(
        "pusher_wobble",
        "pusher",
        (EffectParameter("radius", "m", 1e-3, 0.0, 0.01), EffectParameter("frequency", "Hz", 4.0, 0.1, 30.0, default=4.0)),
        "the tool goes round its reported place in a circle",
        "the arm is led along the wobbling path; joint states tell the other",
        named=False,
    ),
)

EFFECTS: dict[str, Effect] = {effect.name: effect for effect in _ENTRIES}
"""By name."""


@dataclass(frozen=True, slots=True)
class Effects:
    """The effects injected into one simulation; none by default."""

    values: tuple[tuple[str, tuple[float, ...]], ...] = ()
    """Names and parameters, sorted by name; effects of size zero are left out, so that they are off to the last bit."""

    def __post_init__(self) -> None:
        chosen = {}
        for name, given in self.values:
            if name not in EFFECTS:
                raise InputError(f"Effect {name!r} is not known, expected some of {', '.join(EFFECTS)}.")
            if name in chosen:
                raise InputError(f"Effect {name} is given twice; give it once with all its parameters.")
            chosen[name] = _checked(EFFECTS[name], given)
        switched_on = {
            name: values
            for name, values in chosen.items()
            if any(value != 0.0 for value, p in zip(values, EFFECTS[name].parameters, strict=True) if p.default == 0.0)
        }
        object.__setattr__(self, "values", tuple(sorted(switched_on.items())))

    @classmethod
    def of(cls, values: Mapping[str, float | Sequence[float]]) -> Effects:
        """From names and parameters: a number, or as many of them as the effect has; those left out at the end take their default."""
        return cls(tuple((name, tuple(v) if isinstance(v, Sequence) else (float(v),)) for name, v in values.items()))

    @classmethod
    def parse(cls, texts: Iterable[str]) -> Effects:
        """From texts such as `table_tilt=0.02` or `table_tilt=0.02,-0.01`. Raises InputError for what is not of that form."""
        found = []
        for text in texts:
            name, equals, numbers = text.partition("=")
            try:
                values = tuple(float(number) for number in numbers.split(","))
            except ValueError:
                values = ()
            if not (equals and values):
                raise InputError(f"Effect {text!r} has no size, expected NAME=VALUE or NAME=VALUE,VALUE such as table_tilt=0.02.")
            found.append((name.strip(), values))
        return cls(tuple(found))

    def __bool__(self) -> bool:
        return bool(self.values)

    def __contains__(self, name: str) -> bool:
        return any(own == name for own, _ in self.values)

    def __getitem__(self, name: str) -> tuple[float, ...]:
        """Parameters of an effect; their defaults, at which it does nothing, when it is not injected."""
        return self.as_dict().get(name) or tuple(p.default for p in EFFECTS[name].parameters)

    def as_dict(self) -> dict[str, tuple[float, ...]]:
        """Parameters of the injected effects by name."""
        return dict(self.values)

    def acting_on(self, *parts: str) -> tuple[str, ...]:
        """Names of the injected effects that act on one of `parts`."""
        return tuple(name for name, _ in self.values if EFFECTS[name].acts_on in parts)


def _checked(effect: Effect, given: Sequence[float]) -> tuple[float, ...]:
    named = ", ".join(f"{p.name} [{p.unit}]" for p in effect.parameters)
    if not 0 < len(given) <= len(effect.parameters):
        raise InputError(f"Effect {effect.name} has {len(given)} values, expected 1 to {len(effect.parameters)}: {named}.")
    values = (*map(float, given), *(p.default for p in effect.parameters[len(given) :]))
    for value, p in zip(values, effect.parameters, strict=True):
        if not (math.isfinite(value) and p.lowest <= value <= p.highest):
            raise InputError(f"{p.name} of effect {effect.name} is {value:g} {p.unit}, expected {p.lowest:g} to {p.highest:g}.")
        if 0.0 < abs(value) < p.smallest:
            raise InputError(f"{p.name} of effect {effect.name} is {value:g} {p.unit}, expected 0 or at least {p.smallest:g}.")
    return values
