"""The pusher follows its reported path with a first-order lag."""

from __future__ import annotations

import numpy as np

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnPusherPath, Rival
from push_ident.physics.kernel import kernel

__all__ = ["EFFECT"]


@kernel
def _follow(path: ComplexArray, behind: complex, decay: complex, driven: ComplexArray) -> None:
    """Exact response to a path that is linear between samples; `behind` is the steady lag per step of travel."""
    for axis in range(path.shape[1]):
        lag = 0.0j
        driven[0, axis] = path[0, axis]
        for n in range(path.shape[0] - 1):
            steady = -behind * (path[n + 1, axis] - path[n, axis])
            lag = steady + (lag - steady) * decay
            driven[n + 1, axis] = path[n + 1, axis] + lag


def _move(values: ComplexArray, dt: float, path: ComplexArray) -> ComplexArray:
    tau = values[0]
    driven = np.empty_like(path)
    _follow(path, complex(tau / dt), complex(np.exp(-dt / tau)) if tau.real > 0 else 0j, driven)
    return driven


EFFECT = Effect(
    name="pusher_lag",
    what="The pusher follows its reported path with a first-order lag.",
    equation="tau dp/dt = p_reported - p, initially at rest",
    parameters=(EffectParameter("tau", "s", "time constant", scale=0.03, typical=0.03, low=0.0, high=0.5),),
    acts=OnPusherPath(_move),
    law=Law.EXACT,
    signature="Speed times tau while the pusher moves; fades after it stops.",
    rivals=(
        Rival("pose_latency", "the frames after the stop: it ends with the motion"),
        Rival("outline_error", "pushes of several speeds: it does not depend on speed"),
        Rival("pusher_speed_scale", "pushes with steps of speed: it grows with travel"),
    ),
    check="Compare the commanded with the measured path of the tool in a fast move in free air.",
    source="First-order model of a servo loop.",
    refit_with=("pose_latency", "pusher_speed_scale"),
)
