"""A smooth force and torque of unknown cause: what no named effect explains."""

from __future__ import annotations

from itertools import product
from typing import Any, Final

from push_ident.physics.effect import Body, Effect, EffectParameter, Law, OnTable, analytic_log, analytic_sqrt, equation

__all__ = ["COMPONENTS", "EFFECT", "FEATURES"]

COMPONENTS: Final = {
    "along": "force along the motion",
    "across": "force across the motion",
    "torque": "torque while it moves along",
    "turning": "torque against turning",
}
"""Parts of the wrench, each smooth in all features."""
FEATURES: Final = {
    "even": ("even",),
    "place": ("x", "y"),
    "heading in the table": ("cos", "sin", "cos2", "sin2"),
    "heading in the object": ("body_cos", "body_sin", "body_cos2", "body_sin2"),
    "speed": ("speed",),
    "order of the pushes": ("order",),
}
"""What it may vary with, and the functions that say how."""

_GRAVITY = 9.81  # [m/s^2]
_SLOW = 2e-3  # below it the wrench fades: an object at rest needs none [m/s]
_REFERENCE = 0.1  # speed at which the function of the speed is zero [m/s]
_SLOWEST = 0.01  # below it that function hardly changes [m/s]
_FAR = 0.1  # [m] at which the functions of the place are 1
_MANY = 10.0  # pushes after which the function of their order is 1
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
    "(d, w): direction of the motion, turning counted as rho omega; rho: radius of gyration of the area",
    parameters=_parameters(),
    acts=OnTable(pull=_pull),
    law=Law.APPROXIMATE,
    signature="Systematic residuals that no effect of the catalogue explains; one that explains as much is preferred.",
    rivals=(),
    source="An additive Gaussian process in the features: each weight is a normal variable of the prior.",
    is_unknown_cause=True,
)
