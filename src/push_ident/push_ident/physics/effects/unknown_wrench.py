"""A smooth force and torque of unknown cause, for motion that no named effect explains."""

from __future__ import annotations

from itertools import product
from typing import Any, Final

from push_ident.physics.effect import Body, Effect, EffectParameter, Law, OnTable, analytic_log, analytic_sqrt, equation

__all__ = ["COMPONENTS", "EFFECT", "FEATURES"]

COMPONENTS: Final = {
    "along": "force along the motion",
    "across": "force across the motion",
    "torque": "torque during translation",
    "turning": "torque against rotation",
}
"""Components of the wrench, each smooth in all features."""
FEATURES: Final = {
    "even": ("even",),
    "place": ("x", "y"),
    "heading in the table": ("cos", "sin", "cos2", "sin2"),
    "heading in the object": ("body_cos", "body_sin", "body_cos2", "body_sin2"),
    "speed": ("speed",),
    "order of the pushes": ("order",),
}
"""Features that the wrench may depend on, each with its basis functions."""

_GRAVITY = 9.81  # [m/s^2]
_SLOW = 2e-3  # speed below which the wrench fades; it is zero at rest [m/s]
_REFERENCE = 0.1  # speed at which the function of the speed is zero [m/s]
_SLOWEST = 0.01  # speed below which that function hardly changes [m/s]
_FAR = 0.1  # coordinate at which the functions of the place are 1 [m]
_MANY = 10.0  # number of pushes after which the function of their order is 1
_PER_COMPONENT = sum(len(functions) for functions in FEATURES.values())


@equation
def _weighted(p: Any, first: int, f: Any) -> Any:
    total = p[first] * f[0]
    for i in range(1, _PER_COMPONENT):
        total = total + p[first + i] * f[i]
    return total


@equation
def _pull(p: Any, body: Body) -> Any:
    radius = analytic_sqrt(body.spread)
    turn = radius * body.omega
    straight = analytic_sqrt(body.vx * body.vx + body.vy * body.vy + _SLOW * _SLOW)
    speed = analytic_sqrt(straight * straight + turn * turn)
    cos, sin = body.vx / straight, body.vy / straight
    own_cos, own_sin = body.cos * cos + body.sin * sin, body.cos * sin - body.sin * cos
    one = 1.0 + 0.0 * speed
    f = (
        one, body.x * (1.0 / _FAR), body.y * (1.0 / _FAR),
        cos, sin, cos * cos - sin * sin, 2.0 * cos * sin,
        own_cos, own_sin, own_cos * own_cos - own_sin * own_sin, 2.0 * own_cos * own_sin,
        analytic_log((speed + _SLOWEST) * (1.0 / (_REFERENCE + _SLOWEST))), one * (body.order / _MANY),
    )  # fmt: skip
    weight = body.mass * _GRAVITY
    x, y, share = body.vx / speed, body.vy / speed, turn / speed
    along, across = -weight * _weighted(p, 0, f), weight * _weighted(p, _PER_COMPONENT, f)
    torque = _weighted(p, 2 * _PER_COMPONENT, f) * (x * x + y * y) - _weighted(p, 3 * _PER_COMPONENT, f) * share
    return along * x - across * y, along * y + across * x, weight * radius * torque


def _parameters() -> tuple[EffectParameter, ...]:
    functions = [function for group in FEATURES.values() for function in group]
    return tuple(
        EffectParameter(f"{component}_{function}", "", f"{COMPONENTS[component]}, share of the weight, by `{function}`", 0.03, 0.03)
        for component, function in product(COMPONENTS, functions)
    )


EFFECT = Effect(
    name="unknown_wrench",
    what="A smooth force and torque of unknown cause.",
    equation="(-a d + c d_perp) m g, (t |d|^2 - s w) m g rho; a, c, t, s linear in smooth functions of place, headings, speed and order; "
    "(d, w): direction of the motion, rotation counted as rho omega; rho: radius of gyration of the area",
    parameters=_parameters(),
    acts=OnTable(pull=_pull),
    law=Law.APPROXIMATE,
    signature="Systematic residuals that no effect of the catalogue explains. A named effect that explains them equally well is preferred.",
    rivals=(),
    source="An additive Gaussian process in the features: the prior of each weight is normal.",
    is_unknown_cause=True,
)
