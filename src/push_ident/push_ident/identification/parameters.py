"""The unknowns of an object, their prior, and how the body that moves depends on them.

Mass and friction of a cell are positive, so their logarithms are the unknowns; neighbouring cells are alike, so each logarithm is a
Gaussian process over the object (Matern 3/2). In the coordinates `z` of its leading modes the prior is a unit normal:

    m_i = M w_i,   w = softmax(a),   a = A z_a          masses, M the total mass
    mu_i = mu_0 exp(s) e_i / (w' e),   e = exp(b),   b = A z_b     support friction, map and scale
    mu_p = mu_p0 exp(p)                                 friction of the pusher

The scale s is that of the friction of the whole object, mu_0 exp(s) M g, whatever the maps: a heavy end that also rubs more must not
look like more friction on the whole.

Effects that the base model leaves out (`physics/effects/`) may be unknowns too: each parameter is its nominal value plus z_e times the
scale of its prior.

Scaling M scales every force and leaves every motion as it is, so M is no unknown here: see `posterior`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.physics.effect_values import EffectValues, effect_values
from push_ident.physics.rollout import N_BODY_PARAMETERS, PARAM_CENTRE, PARAM_INERTIA, PARAM_LIMIT, PARAM_MU
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import BodyParameters, Motion, SimulationSettings, body_of_cells, simulate_body
from push_ident.types import Float64Array, ObjectModel, ObjectShape

__all__ = ["MapParameters", "Mechanics", "Prior"]


@dataclass(frozen=True, slots=True)
class Prior:
    """What is believed of an object before it is pushed."""

    total_mass: float = 0.5
    """Nominal, or known, total mass [kg]."""
    total_mass_std: float = 0.7
    """Of its logarithm; 0 where the weight is known."""
    friction: float = 0.3
    """Nominal support friction coefficient."""
    friction_std: float = 0.4
    """Of the logarithm of its common scale."""
    pusher_friction: float = 0.3
    """Nominal friction coefficient between pusher and object."""
    pusher_friction_std: float = 0.6
    """Of its logarithm."""
    mass_map_std: float = 0.7
    """Of the logarithm of a cell's mass about the mean."""
    friction_map_std: float = 0.7
    """Of the logarithm of a cell's friction about the mean."""
    correlation_length: float = 0.25
    """Distance over which the maps change, as a share of the object's diagonal."""
    max_modes: int = 40
    """Modes a map is made of at most."""
    outline_std: float = 2e-3
    """Of the distance between surface and outline, where that is fitted (effect `outline_error`) [m]."""
    camera_share: float = 1.0
    """Of the errors of the camera's pose and scale, where they are fitted (effects `camera_...`), as a share of the catalogue's."""

    def __post_init__(self) -> None:
        for name in (
            "total_mass",
            "friction",
            "pusher_friction",
            "friction_std",
            "pusher_friction_std",
            "correlation_length",
            "outline_std",
            "camera_share",
        ):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"Prior.{name} is {value}, expected a positive number.")
        for name in ("total_mass_std", "mass_map_std", "friction_map_std"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"Prior.{name} is {value}, expected a number >= 0.")


@dataclass(frozen=True, slots=True)
class Mechanics:
    """What moves, and how, for given unknowns."""

    shape: ObjectShape
    body: BodyParameters
    pusher_friction: float
    effects: EffectValues
    derivative: Float64Array
    """d(body parameters, limits of the cells, values of the effects) / dz, shape (8 + n_cells + n_values, size), rows as the columns of
    `Motion.jacobian`."""

    @property
    def limit_derivative(self) -> Float64Array:
        """The rows of the cells' friction limits, shape (n_cells, size)."""
        return self.derivative[PARAM_LIMIT : PARAM_LIMIT + len(self.shape.cells)]

    def simulate(self, scenario: PushScenario, *, settings: SimulationSettings | None = None, jacobian: bool = False) -> Motion:
        """As `simulate_body`."""
        return simulate_body(
            self.shape, self.body, self.pusher_friction, scenario, settings=settings, effects=self.effects, jacobian=jacobian
        )


class MapParameters:
    """The unknowns `z` of one object: those of the mass map, of the friction map, of the effects, friction scale, pusher friction.

    Args:
        shape: its cells.
        prior: beliefs.
        maps: False leaves equal cells and only the scales free (the `scalar` model).
        modes: of a map, where they are known already (from a file), shape (n_cells, n_modes).
        effects: names of effects whose parameters are unknown too.

    Attributes:
        size: number of unknowns; the last two are the friction scale and the pusher friction.
        modes: of a map, shape (n_cells, n_modes): a = modes @ z_a.
        effects: the effects, at their nominal values.
    """

    def __init__(
        self,
        shape: ObjectShape,
        prior: Prior,
        *,
        maps: bool = True,
        modes: Float64Array | None = None,
        effects: Sequence[str] = (),
    ) -> None:
        self.shape = shape
        self.prior = prior
        if modes is None:
            modes = _leading_modes(shape, prior) if maps else np.zeros((len(shape.cells), 0))
        if modes.ndim != 2 or len(modes) != len(shape.cells):
            raise InputError(f"`modes` has shape {modes.shape}, expected ({len(shape.cells)}, n_modes) as the cells.")
        # In one layout whatever it came from: products over another one differ in the last bit.
        self.modes = np.ascontiguousarray(modes)
        self.n_modes = self.modes.shape[1]
        self.effects = effect_values(effects)
        self.size = 2 * self.n_modes + len(self.effects) + 2

    @property
    def effect_slice(self) -> slice:
        """Where the unknowns of the effects stand."""
        return slice(2 * self.n_modes, 2 * self.n_modes + len(self.effects))

    @property
    def effect_scale(self) -> Float64Array:
        """Deviation of each value of the effects by the prior, shape (n_values,)."""
        scale = np.array([parameter.scale for parameter in self.effects.parameters])
        for effect in (effect for effect in self.effects.effects if effect.is_camera_error):
            own = self.effects.slice_of(effect.name)
            scale[own] = self.prior.outline_std if effect.moves_outline else scale[own] * self.prior.camera_share
        return scale

    def effects_at(self, z: Float64Array) -> EffectValues:
        """The effects with the values that `z` stands for; values out of their range are taken at its end."""
        return self.effects.with_values(self._effect_values(z)[0])

    def _effect_values(self, z: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Values of the effects and their derivative by their own unknowns, each shape (n_values,)."""
        low, high = (np.array([getattr(p, name) for p in self.effects.parameters]) for name in ("low", "high"))
        scale = self.effect_scale
        free = self.effects.values + scale * z[self.effect_slice]
        return np.clip(free, low, high), np.where((free >= low) & (free <= high), scale, 0.0)

    @property
    def map_remainder(self) -> Float64Array:
        """Prior variance of a unit map that the modes leave out, shape (n_cells,): posteriors add it back."""
        return np.maximum(0.0, 1.0 - np.sum(self.modes**2, axis=1))

    def unit(self, amplitude: float) -> Float64Array:
        """Size of the unknowns when the maps' deviations are `amplitude` times those of the prior, in units of the prior, shape (size,)."""
        return np.r_[np.full(2 * self.n_modes, amplitude), np.ones(len(self.effects) + 2)]

    def model(self, z: Float64Array) -> ObjectModel:
        """The object that `z`, shape (size,), stands for."""
        n, prior = self.n_modes, self.prior
        a = prior.mass_map_std * (self.modes @ z[:n])
        weight = np.exp(a - a.max())
        weight /= weight.sum()
        roughness = np.exp(prior.friction_map_std * (self.modes @ z[n : 2 * n]))
        return ObjectModel(
            shape=self.shape,
            mass=prior.total_mass * weight,
            friction=prior.friction * float(np.exp(prior.friction_std * z[-2])) * roughness / float(weight @ roughness),
            pusher_friction=float(prior.pusher_friction * np.exp(prior.pusher_friction_std * z[-1])),
        )

    def log_derivatives(self, model: ObjectModel) -> tuple[Float64Array, Float64Array]:
        """d log(mass of each cell) / dz and d log(friction of each cell) / dz at the unknowns of `model`, each shape (n_cells, size)."""
        n, prior = self.n_modes, self.prior
        d_mass = np.zeros((len(model.mass), self.size))
        d_friction = np.zeros_like(d_mass)
        # Of the weights w_i = softmax(a): only differences count.
        d_mass[:, :n] = prior.mass_map_std * (self.modes - model.mass @ self.modes / model.total_mass)
        d_friction[:, n : 2 * n] = prior.friction_map_std * self.modes
        load = model.mass * model.friction
        d_friction -= load @ (d_mass + d_friction) / load.sum()
        d_friction[:, -2] += prior.friction_std
        return d_mass, d_friction

    def unknowns(self, mass: Float64Array, friction: Float64Array, pusher_friction: float) -> Float64Array:
        """Unknowns of given maps, shape (size,): exact where every cell has a mode of its own, else the nearest smooth maps.

        Masses may have any common scale. Raises InputError for values that are not positive, which have no logarithm.
        """
        if np.any(mass <= 0) or np.any(friction <= 0) or pusher_friction <= 0:
            raise InputError("Masses and friction coefficients must be positive to have a logarithm; raise those at zero a little.")
        prior, n = self.prior, self.n_modes
        z = np.zeros(self.size)
        log_mass, log_friction = np.log(mass), np.log(friction / prior.friction)
        scale = np.log(mass @ friction / mass.sum() / prior.friction)
        z[:n] = np.linalg.lstsq(prior.mass_map_std * self.modes, log_mass - log_mass.mean())[0]
        z[n : 2 * n] = np.linalg.lstsq(prior.friction_map_std * self.modes, log_friction - scale)[0]
        z[-2] = scale / prior.friction_std
        z[-1] = np.log(pusher_friction / prior.pusher_friction) / prior.pusher_friction_std
        return z

    def mechanics(self, z: Float64Array) -> Mechanics:
        """What moves, and how it depends on `z`, shape (size,)."""
        model = self.model(z)
        body = body_of_cells(self.shape, model.mass, model.friction)
        weight = model.mass / body.mass
        arms = self.shape.cells.centres - body.centre
        moment = np.sum(arms**2, axis=1) + self.shape.cells.size**2 / 6
        d_mass, d_friction = self.log_derivatives(model)
        values, d_values = self._effect_values(z)
        n_cells, n_values = len(weight), len(values)
        derivative = np.zeros((N_BODY_PARAMETERS + n_cells + n_values, self.size))
        derivative[PARAM_CENTRE : PARAM_CENTRE + 2] = (weight[:, None] * arms).T @ d_mass
        derivative[PARAM_INERTIA] = body.mass * ((weight * moment) @ d_mass)
        derivative[PARAM_LIMIT : PARAM_LIMIT + n_cells] = body.limit[:, None] * (d_mass + d_friction)
        derivative[PARAM_MU, -1] = model.pusher_friction * self.prior.pusher_friction_std
        derivative[PARAM_LIMIT + n_cells :, self.effect_slice] = np.diag(d_values)
        return Mechanics(self.shape, body, model.pusher_friction, self.effects.with_values(values), derivative)


def _leading_modes(shape: ObjectShape, prior: Prior) -> Float64Array:
    """Modes of a unit Gaussian process over the cells, scaled so that modes @ unit normal has its covariance."""
    centres = shape.cells.centres
    diagonal = float(np.linalg.norm(np.ptp(centres, axis=0))) + shape.cells.size
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=2) / (prior.correlation_length * diagonal)
    covariance = (1 + np.sqrt(3) * distance) * np.exp(-np.sqrt(3) * distance)
    value, vector = np.linalg.eigh(covariance)
    keep = np.argsort(value)[::-1][: prior.max_modes]
    return np.asarray(vector[:, keep] * np.sqrt(np.maximum(value[keep], 0.0)))
