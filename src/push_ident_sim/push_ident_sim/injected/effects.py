"""Effects that a simulated world can have: what they are, the catalogue, and those of one world with their values.

An effect of the core's catalogue (`push_ident.physics.effects`) keeps its name there, and its parameters keep their names, units and
meaning; the sizes that a simulation can bring about are added here. It has a law of its own in the engines, which shares no line with the
core and so checks it. Then come those that no diagnosis can name. Effects of the core without an entry here are injected through their own
equation (`equations.py`): a new file in `push_ident/physics/effects/` needs nothing else.

Axes are those of `table` unless said otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from push_ident.errors import InputError
from push_ident.physics.effect import (
    Effect,
    Mechanism,
    OnContact,
    OnForces,
    OnForceTimes,
    OnPoses,
    OnPusherFriction,
    OnPusherPath,
    OnTable,
    OnTimes,
)
from push_ident.physics.effects import CAUSES, EFFECTS, FORCE_CAUSES

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
    mechanism: str = ""
    """The mechanism of the core's catalogue of which it is a law that the catalogue does not hold; "" where it is none."""
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


_PARTS: dict[type, Part] = {
    OnTable: "table",
    OnContact: "pusher",
    OnPusherPath: "pusher",
    OnPusherFriction: "pusher",
    OnTimes: "camera",
    OnPoses: "poses",
    OnForces: "forces",
    OnForceTimes: "forces",
}
"""What an effect acts on that is injected through its equation."""


class _Size(NamedTuple):
    """Sizes of one parameter of an effect of the core's catalogue, in the unit that it has there."""

    typical: float
    lowest: float
    highest: float
    times_friction: bool = False
    chosen_by_world: bool = False


def _catalogued(name: str, acts_on: Part, how: str, *sizes: _Size) -> InjectedEffect:
    """An effect of the core's catalogue that the engines have a law of their own for."""
    effect = EFFECTS[name]
    parameters = tuple(
        InjectedParameter(
            p.name,
            p.unit or "1",
            size.typical,
            size.lowest,
            size.highest,
            p.what,
            None if size.chosen_by_world else p.nominal,
            p.shape,
            times_friction=size.times_friction,
        )
        for p, size in zip(effect.parameters, sizes, strict=True)
    )
    return InjectedEffect(name, acts_on, parameters, effect.what, how)


def _through_its_equation(effect: Effect) -> InjectedEffect:
    """An effect of the core's catalogue for which the engines have no law of their own."""

    def bounded(limit: float, sign: float, typical: float) -> float:
        # Where the core's catalogue has no limit: ten typical sizes.
        return limit if np.isfinite(limit) else sign * 10.0 * typical

    parameters = tuple(
        InjectedParameter(
            p.name,
            p.unit or "1",
            p.typical,
            bounded(p.low, -1.0, p.typical),
            bounded(p.high, 1.0, p.typical),
            p.what,
            p.nominal,
            p.shape,
        )
        for p in effect.parameters
    )
    how = f"the engines evaluate its equation: {effect.equation}"
    return InjectedEffect(effect.name, _PARTS[type(effect.acts)], parameters, effect.what, how, has_own_law=False)


_GRAIN = "a force on each sliding cell makes up the difference to friction without direction"
_CELL_FRICTION = "the friction coefficient of each cell is set at each time step"
_TOOL_PATH = "the tool is led along the changed path; joint states report the other one"

_ENTRIES = (
    _catalogued("table_tilt", "table", "gravity has these components along the table", _Size(0.02, -0.1, 0.1), _Size(0.02, -0.1, 0.1)),
    _catalogued("table_anisotropy", "table", _GRAIN, _Size(0.15, -0.5, 0.5), _Size(0.15, -0.5, 0.5)),
    _catalogued("base_anisotropy", "object", _GRAIN, _Size(0.15, -0.5, 0.5), _Size(0.15, -0.5, 0.5)),
    _catalogued("position_dependent_friction", "table", _CELL_FRICTION, _Size(1.0, -3.0, 3.0), _Size(1.0, -3.0, 3.0)),
    _catalogued("speed_dependent_friction", "table", _CELL_FRICTION, _Size(0.1, -0.3, 0.3)),
    _catalogued("stribeck_friction", "table", _CELL_FRICTION, _Size(0.3, -0.9, 2.0), _Size(0.02, 1e-3, 0.2)),
    _catalogued("wear", "table", _CELL_FRICTION, _Size(0.01, -0.05, 0.1)),
    _catalogued("pusher_friction", "pusher", "friction coefficient of the outline", _Size(0.1, -2.0, 2.0)),
    _catalogued(
        "push_height",
        "pusher",
        "the moment of the measured contact force, at the height lever / friction coefficient, shifts the load of the cells",
        _Size(0.02, 0.0, 0.1, times_friction=True),
    ),
    _catalogued(
        "tether",
        "object",
        "a force on the object; without pull_x and pull_y the spring is relaxed where the object was put down",
        _Size(5.0, 0.0, 100.0),
        _Size(0.0, -50.0, 50.0, chosen_by_world=True),
        _Size(0.0, -50.0, 50.0, chosen_by_world=True),
    ),
    _catalogued(
        "moving_contents",
        "object",
        "mass moves from cell to cell; it stays where it is when the object stops",
        _Size(0.01, 0.0, 0.05),
        _Size(0.1, 0.01, 5.0),
    ),
    _catalogued("restitution", "pusher", "restitution of both bodies", _Size(0.3, 0.0, 1.0)),
    _catalogued("outline_error", "object", "the collision shape grows; the reported outline does not", _Size(1e-3, -4e-3, 5e-3)),
    _catalogued("pusher_lag", "pusher", _TOOL_PATH, _Size(0.02, 0.0, 0.5)),
    _catalogued("pusher_speed_scale", "pusher", f"{_TOOL_PATH}; it starts where the tool came down", _Size(0.02, -0.2, 0.2)),
    _catalogued("tool_offset", "pusher", _TOOL_PATH, _Size(2e-3, -0.01, 0.01), _Size(2e-3, -0.01, 0.01)),
    _catalogued("tool_drift", "pusher", _TOOL_PATH, _Size(3e-4, -2e-3, 2e-3), _Size(3e-4, -2e-3, 2e-3)),
    _catalogued(
        "camera_rotation", "camera", "the camera turns about the origin of the table; its reported pose does not", _Size(0.01, -0.2, 0.2)
    ),
    _catalogued(
        "camera_translation",
        "camera",
        "the camera is shifted; its reported pose is not",
        _Size(2e-3, -0.05, 0.05),
        _Size(2e-3, -0.05, 0.05),
    ),
    _catalogued(
        "camera_scale",
        "camera",
        "poses are scaled; a rendered camera has a focal length (1 + kappa) times the reported one, and on a slant the table looks tilted",
        _Size(0.01, -0.1, 0.1),
    ),
    _catalogued("pose_latency", "camera", "frames are stamped late", _Size(0.01, 0.0, 0.5)),
    InjectedEffect(
        "dropped_frames",
        "camera",
        (InjectedParameter("share", "1", 0.3, 0.0, 0.95, "of all frames"),),
        "Frames are lost at random.",
        "frames are dropped",
    ),
    InjectedEffect(
        "noise_correlation",
        "poses",
        (InjectedParameter("rho", "1", 0.6, 0.0, 0.99, "correlation of neighbouring frames"),),
        "Pose noise of consecutive frames is correlated, with the same standard deviation.",
        "first-order autoregressive noise",
    ),
    InjectedEffect(
        "pose_flips",
        "poses",
        (InjectedParameter("share", "1", 0.05, 0.0, 0.5, "of all frames"),),
        "Single poses are turned by 180 degrees.",
        "half a turn is added to the yaw of frames drawn at random",
    ),
    InjectedEffect(
        "compliant_table",
        "table",
        (InjectedParameter("travel", "m", 2e-3, 0.0, 0.02, "shear at which a cell starts to slide", smallest=2e-4),),
        "The surface of the table shears before a cell slides, and springs back.",
        "cells hang on springs that give way at their friction force; Bullet's own friction is switched off",
    ),
    InjectedEffect(
        "viscous_film",
        "table",
        (InjectedParameter("damping", "N s/m", 3.0, 0.0, 30.0, "of the whole object, spread over its cells"),),
        "A film of oil: a force against the velocity, beside dry friction.",
        "a force on each cell",
        Mechanism.FRICTION_BY_SPEED.value,
    ),
    InjectedEffect(
        "rolling_finger",
        "pusher",
        (InjectedParameter("ease", "1", 1.0, 0.0, 1.0, "1: free; below that a bearing holds with (1 - ease) 0.02 N m", smallest=0.5),),
        "The finger turns about its own axis.",
        "the pusher hangs on a turning joint with that friction",
        "pusher_friction",
    ),
    InjectedEffect(
        "pusher_wobble",
        "pusher",
        (
            InjectedParameter("radius", "m", 1e-3, 0.0, 0.01, "of the circle"),
            InjectedParameter("frequency", "Hz", 4.0, 0.1, 30.0, "of the motion", default=4.0, is_shape=True),
        ),
        "The tool moves in a circle about its reported place.",
        _TOOL_PATH,
        Mechanism.TOOL_WOBBLES.value,
    ),
)

INJECTED: dict[str, InjectedEffect] = {effect.name: effect for effect in _ENTRIES}
"""By name. An effect that names no cause has nothing to inject."""
INJECTED |= {name: _through_its_equation(EFFECTS[name]) for name in (*CAUSES, *FORCE_CAUSES) if name not in INJECTED}


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
