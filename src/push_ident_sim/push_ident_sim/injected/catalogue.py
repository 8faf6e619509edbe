"""Every effect that can be injected.

Effects of the core's catalogue come first, each with a law of its own in the engines, which does not share a line with the core and so
checks it. Then those that no diagnosis can name. Effects of the core without an entry here are injected through their own equation
(`equations.py`): a new file in `push_ident/physics/effects/` needs nothing else.

Axes are those of `table` unless said otherwise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from push_ident.physics.effect import Effect, OnContact, OnForces, OnForceTimes, OnPoses, OnPusherFriction, OnPusherPath, OnTable, OnTimes
from push_ident.physics.effects import CAUSES, EFFECTS, FORCE_CAUSES
from push_ident_sim.injected.effect import InjectedEffect, InjectedParameter, Part

__all__ = ["INJECTED"]

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
    ),
    InjectedEffect(
        "rolling_finger",
        "pusher",
        (InjectedParameter("ease", "1", 1.0, 0.0, 1.0, "1: free; below that a bearing holds with (1 - ease) 0.02 N m", smallest=0.5),),
        "The finger turns about its own axis.",
        "the pusher hangs on a turning joint with that friction",
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
    ),
)

INJECTED: dict[str, InjectedEffect] = {effect.name: effect for effect in _ENTRIES}
"""By name. An effect that names no cause has nothing to inject."""
INJECTED |= {name: _through_its_equation(EFFECTS[name]) for name in (*CAUSES, *FORCE_CAUSES) if name not in INJECTED}
