"""A rigid body that stands on given loads, pushed by the laws of the planar engine without any effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import InputError
from push_ident.types import PusherPath
from push_ident_sim.engines.planar.integrator import Body, Clock, Path, StepChange, advance, new_state
from push_ident_sim.engines.planar.laws import plain_laws
from push_ident_sim.engines.true_motion import TrueMotion

__all__ = ["LoadedBody"]

FloatArray = NDArray[np.float64]

_GRAVITY = 9.81
_TIME_STEP = 1.0 / 240.0
"""Between two rows of a motion [s]."""
_INNER_STEPS = 96
"""Steps of the integrator in a row."""
_LONGEST_REST = 1.0
"""Time for which the engine waits after the path until the object rests [s]."""


@dataclass(frozen=True, slots=True)
class LoadedBody:
    """A rigid body on points with given shares of its weight. The object frame has its origin in the centre of mass."""

    outline: FloatArray
    """[m], shape (n_vertices, 2), counter-clockwise, not closed."""
    place: FloatArray
    """Points that touch the table [m], shape (n_points, 2)."""
    share: FloatArray
    """Share of the weight on each point [-], shape (n_points,), sum 1."""
    mass: float
    """[kg]"""
    inertia: float
    """About the centre of mass [kg m^2]."""
    friction: float
    """Of the points on the table [-]."""
    pusher_friction: float
    """Of the pusher on the outline [-]."""

    def __post_init__(self) -> None:
        if self.share.shape != self.place.shape[:1] or self.share.min() < 0.0 or not np.isclose(self.share.sum(), 1.0):
            raise InputError(
                f"`share` has shape {self.share.shape} and sum {self.share.sum():g}, expected one share >= 0 for each of {len(self.place)} "
                "points, with sum 1."
            )

    def push(self, pose_object_in_table: ArrayLike, path: PusherPath) -> TrueMotion:
        """Put the body down at (x, y, yaw), shape (3,), clear of the pusher, lead the pusher along `path`, wait until the body rests."""
        clock = np.ascontiguousarray(path.time - path.time[0])
        driven = Path(clock, np.ascontiguousarray(path.position))
        n_points = len(self.place)
        body = Body(
            place=np.ascontiguousarray(self.place),
            friction=np.full(n_points, self.friction),
            outline=np.ascontiguousarray(self.outline),
            mass=self.mass,
            inertia=self.inertia,
        )
        laws = plain_laws(pusher_radius=path.radius, pusher_friction=self.pusher_friction, gravity=_GRAVITY)
        weight = self.mass * _GRAVITY
        first = np.array(pose_object_in_table, dtype=np.float64)
        state, _ = new_state(body, driven, first, np.zeros(3), weight)
        # In place of the loads of the bed of springs. They stay as they are, since nothing in the plain laws shifts them.
        state.load[:] = weight * self.share
        change = StepChange(np.ones(n_points), np.zeros(2), np.zeros(3))
        n_rows = int(np.ceil((clock[-1] + _LONGEST_REST) / _TIME_STEP))
        times = Clock(_TIME_STEP, _INNER_STEPS, 1e-4)
        pose, pusher, force, _, _ = advance(laws, body, driven, state, change, times, 1, n_rows)
        pusher = np.concatenate([driven.position[:1], pusher])
        return TrueMotion(
            np.arange(len(pose) + 1) * np.float64(_TIME_STEP),
            np.concatenate([first[None], pose]),
            pusher,
            pusher,
            np.concatenate([np.zeros((1, 2)), force]),
        )
