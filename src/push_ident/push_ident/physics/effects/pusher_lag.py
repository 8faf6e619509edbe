"""The pusher follows its reported path with a first-order lag."""

from __future__ import annotations

from typing import Any

import numpy as np

from push_ident.physics.effect import ComplexArray, Effect, EffectParameter, Law, OnPusherPath, Rival
from push_ident.physics.kernel import kernel


@kernel
def _follow(path: ComplexArray, behind: ComplexArray, decay: ComplexArray, driven: ComplexArray) -> None:
    """Exact response to a path that is linear between samples; `behind` is the steady lag per travel in a step, shape (n_steps,)."""
    for axis in range(path.shape[1]):
        lag = 0.0j
        driven[0, axis] = path[0, axis]
        for n in range(path.shape[0] - 1):
            steady = -behind[n] * (path[n + 1, axis] - path[n, axis])
            lag = steady + (lag - steady) * decay[n]
            driven[n + 1, axis] = path[n + 1, axis] + lag


def _move(values: ComplexArray, dt: Any, path: ComplexArray, order: float) -> ComplexArray:
    tau, steps = values[0], np.ones(len(path) - 1, dtype=np.complex128)
    driven = np.empty_like(path)
    _follow(path, tau / dt * steps, np.exp(-dt / tau) * steps if tau.real > 0 else 0.0 * steps, driven)
    return driven


EFFECT = Effect(
    name="pusher_lag",
    what="The pusher follows its reported path with a first-order lag.",
    equation="tau dp/dt = p_reported - p, initially at rest",
    parameters=(EffectParameter("tau", "s", "time constant", scale=0.1, typical=0.03, low=0.0, high=0.5),),
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
    fades_at_rest=True,
)
