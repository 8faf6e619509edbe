"""From unknowns to the object and its moving body, with the derivative: the one mapping that fits, predictions and plans use.

Mass and friction of a cell are positive, so their logarithms are the unknowns. Neighbouring cells are similar, so each logarithm is a
Gaussian process over the object (Matern 3/2). In the coordinates `z` of its leading modes the prior is a unit normal:

    m_i = M w_i,   w_i ~ A_i exp(a_i),   a = A z_a                 masses, M the total mass, A_i the area of a cell
    P = load(w, c),   c = A z_c                                    share of the load that each cell bears, see `load`; or
    P = feet(w, p, h, g),   p = p_0 + L z_p                        on feet at the positions p of width h with preferences g, see `load`
    mu_i = mu_0 exp(s) e_i P_i / w_i / (P' e),   e = exp(b),   b = A z_b     support friction, map and scale
    mu_p = mu_p0 exp(p)                                            friction of the pusher

The friction of a cell is that of its whole limit, mu_i m_i g, on its own weight: poses see the product of load and friction only.
The scale s belongs to the friction of the whole object, mu_0 exp(s) M g, whatever the maps are. Without this separation a heavy end with
more friction would change the friction of the whole object.

Where a camera traced the outline, the displacements of its vertices are sum_k o_k d_k, with the modes d_k of `outline`.

Effects that the base model leaves out (`physics/effects/`) may be unknowns too: each parameter is its nominal value plus z_e times its
prior standard deviation.

The total mass M scales every force and changes no motion. It is an unknown, M = M_0 exp(m), where forces are measured; motions are
simulated at M_0.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.unknowns.load import FeetLoad, balanced_load, balanced_load_derivative, feet_load, feet_load_derivative
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.effect_values import EffectValues, effect_values
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import BodyParameters, Motion, SimulationSettings, Timeline, body_of_cells, simulate_body
from push_ident.physics.tape import N_BODY_PARAMETERS, Param
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape

_FOOT_WIDTH: Final = (0.3, 0.3)
"""Width of a foot: the least one, at which a foot between cells still has its position, and the median beyond it, in cells [-]."""


@dataclass(frozen=True, slots=True)
class Mechanics:
    """The moving body for given unknowns, with its derivative."""

    shape: ObjectShape
    body: BodyParameters
    pusher_friction: float
    effects: EffectValues
    """Those that poses show."""
    derivative: Float64Array
    """d(body parameters, limits of the cells, values of the effects, modes of the outline) / dz, shape (8 + n_cells + n_values + n_modes,
    size), rows as the columns of `Motion.jacobian`."""
    all_effects: EffectValues = field(default_factory=lambda: effect_values(()))
    """With those that only measured forces show."""
    mass_factor: float = 1.0
    """Total mass over that of `body`, 1 where no forces are measured."""

    @property
    def limit_derivative(self) -> Float64Array:
        """The rows of the cells' friction limits, shape (n_cells, size)."""
        return self.derivative[Param.LIMIT : Param.LIMIT + len(self.shape.cells)]

    def simulate(
        self, scenario: PushScenario, settings: SimulationSettings | None = None, jacobian: bool = False, timeline: Timeline | None = None
    ) -> Motion:
        """As `simulate_body`."""
        return simulate_body(
            self.shape, self.body, self.pusher_friction, scenario, settings=settings, effects=self.effects, jacobian=jacobian,
            timeline=timeline,
        )  # fmt: skip


def mechanics_at(spec: UnknownsSpec, z: Float64Array, *, of_reference: bool = False) -> Mechanics:
    """The moving body at `z`, shape (size,), and its derivative by `z`; `of_reference`: as pushes of a reference moved it."""
    model = model_at(spec, z)
    body = replace(body_of_cells(spec.shape, model.mass, model.friction), outline_modes=spec.outline_modes)
    weight = model.mass / body.mass
    arms = spec.shape.cells.centres - body.centre
    moment = np.sum(arms**2, axis=1) + spec.shape.cells.areas / 6
    effects, d_values = spec.acting_effects(z, of_reference=of_reference)
    mass_factor = float(np.exp(spec.blocks["total_mass"].std @ z[spec.slices["total_mass"]]))
    d_mass, d_friction = log_derivatives_at(spec, z, model)
    shown = np.array([not effect.needs_forces for effect in effects.effects for _ in effect.parameters], dtype=bool)
    n_cells, n_values, n_modes = len(weight), int(np.sum(shown)), len(spec.outline_modes)
    derivative = np.zeros((N_BODY_PARAMETERS + n_cells + n_values + n_modes, spec.size))
    derivative[Param.CENTRE : Param.CENTRE + 2] = (weight[:, None] * arms).T @ d_mass
    derivative[Param.INERTIA] = body.mass * ((weight * moment) @ d_mass)
    derivative[Param.LIMIT : Param.LIMIT + n_cells] = body.limit[:, None] * (d_mass + d_friction)
    derivative[Param.MU, spec.slices["pusher_friction"]] = model.pusher_friction * spec.prior.pusher_friction_std
    derivative[Param.LIMIT + n_cells : Param.LIMIT + n_cells + n_values] = d_values[shown]
    derivative[Param.LIMIT + n_cells + n_values :, spec.slices["outline"]] = np.eye(n_modes)
    return Mechanics(model.shape, body, model.pusher_friction, effects.of_poses, derivative, effects, mass_factor)


def model_at(spec: UnknownsSpec, z: Float64Array) -> ObjectModel:
    """The object at `z`, shape (size,)."""
    prior = spec.prior
    weight = _weight(spec, z)
    roughness = np.exp(prior.friction_map_std * (spec.modes @ z[spec.slices["friction_map"]]))
    if _has_load(spec):
        roughness *= _load(spec, z, weight) / weight
    scale = float(np.exp(prior.friction_std * _scalar(spec, z, "friction_scale")))
    return ObjectModel(
        shape=spec.shape_at(z),
        mass=prior.total_mass * weight,
        friction=prior.friction * scale * roughness / float(weight @ roughness),
        pusher_friction=float(prior.pusher_friction * np.exp(prior.pusher_friction_std * _scalar(spec, z, "pusher_friction"))),
    )


def uniform_model(shape: ObjectShape, prior: Prior | None = None) -> ObjectModel:
    """A uniform object with nominal values."""
    spec = UnknownsSpec.of(shape, prior or Prior(), maps=False)
    return model_at(spec, np.zeros(spec.size))


def log_derivatives_at(spec: UnknownsSpec, z: Float64Array, model: ObjectModel | None = None) -> tuple[Float64Array, Float64Array]:
    """d log(mass of each cell) / dz and d log(friction of each cell) / dz at `z`, each shape (n_cells, size); `model` is that of `z`."""
    prior, at, model = spec.prior, spec.slices, model or model_at(spec, z)
    d_mass = np.zeros((len(model.mass), spec.size))
    d_friction = np.zeros_like(d_mass)
    # Of the weights, sum 1: only differences count.
    d_mass[:, at["mass_map"]] = prior.mass_map_std * (spec.modes - model.mass @ spec.modes / model.total_mass)
    d_friction[:, at["friction_map"]] = prior.friction_map_std * spec.modes
    if _has_load(spec):
        d_friction += _load_derivative(spec, z, d_mass) - d_mass
    load = model.mass * model.friction
    d_friction -= load @ (d_mass + d_friction) / load.sum()
    d_friction[:, at["friction_scale"]] += prior.friction_std
    return d_mass, d_friction


def _scalar(spec: UnknownsSpec, z: Float64Array, name: str) -> np.float64:
    (value,) = z[spec.slices[name]]
    return np.float64(value)


def _weight(spec: UnknownsSpec, z: Float64Array) -> Float64Array:
    """Share of the mass of each cell, shape (n_cells,)."""
    a = spec.prior.mass_map_std * (spec.modes @ z[spec.slices["mass_map"]])
    weight = spec.shape.cells.parts * np.exp(a - a.max())
    return np.asarray(weight / weight.sum())


def _has_load(spec: UnknownsSpec) -> bool:
    """Whether a cell may bear more or less than its own weight."""
    return spec.blocks["pressure_map"].size > 0 or spec.prior.feet > 0


def _load(spec: UnknownsSpec, z: Float64Array, weight: Float64Array) -> Float64Array:
    """Share of the load of each cell, shape (n_cells,)."""
    if spec.prior.feet:
        return _feet(spec, z, weight).load
    excess = spec.prior.pressure_map_std * (spec.modes @ z[spec.slices["pressure_map"]])
    return balanced_load(weight, excess, spec.shape.cells.centres)


def _load_derivative(spec: UnknownsSpec, z: Float64Array, d_mass: Float64Array) -> Float64Array:
    """d log(load of each cell) / dz, shape (n_cells, size)."""
    weight = _weight(spec, z)
    if spec.prior.feet:
        return _feet_derivative(spec, z, weight, d_mass)
    d_excess = np.zeros_like(d_mass)
    d_excess[:, spec.slices["pressure_map"]] = spec.prior.pressure_map_std * spec.modes
    return balanced_load_derivative(weight, _load(spec, z, weight), spec.shape.cells.centres, d_mass, d_excess)


# --- feet


def feet_at(spec: UnknownsSpec, z: Float64Array) -> FeetLoad:
    """The feet at `z`. Raises InputError where the object stands on its whole base."""
    if not spec.prior.feet:
        raise InputError("This object stands on its whole base, it has no feet.")
    return _feet(spec, z, _weight(spec, z))


def _feet(spec: UnknownsSpec, z: Float64Array, weight: Float64Array) -> FeetLoad:
    cells = spec.shape.cells
    offset = z[spec.slices["foot_positions"]].reshape(-1, 2) @ _base_root(cells).T
    preference = spec.blocks["foot_preferences"].std * z[spec.slices["foot_preferences"]]
    return feet_load(weight, cells.centres, cells.middle + offset, _foot_width(spec, z)[0], preference)


def _feet_derivative(spec: UnknownsSpec, z: Float64Array, weight: Float64Array, d_mass: Float64Array) -> Float64Array:
    unit, at = np.eye(spec.size), spec.slices
    d_place = np.einsum("ab,kbz->kaz", _base_root(spec.shape.cells), unit[at["foot_positions"]].reshape(spec.prior.feet, 2, -1))
    d_width = _foot_width(spec, z)[1] * unit[at["foot_width"]][0]
    d_preference = spec.blocks["foot_preferences"].std[:, None] * unit[at["foot_preferences"]]
    return feet_load_derivative(_feet(spec, z, weight), d_mass, d_place, d_width, d_preference)


def _foot_width(spec: UnknownsSpec, z: Float64Array) -> tuple[float, float]:
    """Width of the feet [m], and the derivative of its logarithm by its unknown [-]."""
    least, median = _FOOT_WIDTH
    more = median * float(np.exp(_scalar(spec, z, "foot_width")))
    return spec.shape.cells.size * (least + more), more / (least + more)


def _base_root(cells: CellGrid) -> Float64Array:
    """Root of the covariance of the points of the base [m], shape (2, 2): the prior of the position of a foot."""
    return np.asarray(np.linalg.cholesky(np.cov(cells.centres.T, bias=True, aweights=cells.parts) + np.eye(2) * cells.size**2 / 12))


def foot_position_unknowns(spec: UnknownsSpec, positions: Float64Array) -> Float64Array:
    """The block `foot_positions` of given positions [m], shape (n_feet, 2)."""
    cells = spec.shape.cells
    offset = positions - cells.middle
    return np.asarray(np.linalg.solve(_base_root(cells), offset.T).T.ravel())


# --- effects


def effects_at(spec: UnknownsSpec, z: Float64Array) -> EffectValues:
    """The effects with their values at `z`; values beyond a bound are clipped to it."""
    return spec.acting_effects(z)[0]


# --- unknowns of given maps


def unknowns_of_maps(spec: UnknownsSpec, mass: Float64Array, friction: Float64Array, pusher_friction: float) -> Float64Array:
    """Unknowns of given maps, shape (size,): exact where every cell has a mode of its own, else the nearest smooth maps.

    Masses may have any common scale. Raises InputError for values that are not positive, which have no logarithm.
    """
    if np.any(mass <= 0) or np.any(friction <= 0) or pusher_friction <= 0:
        raise InputError("Masses and friction coefficients must be positive to have a logarithm; raise those at zero a little.")
    prior, at = spec.prior, spec.slices
    z = np.zeros(spec.size)
    log_mass, log_friction = np.log(mass / spec.shape.cells.parts), np.log(friction / prior.friction)
    scale = np.log(mass @ friction / mass.sum() / prior.friction)
    z[at["mass_map"]] = np.linalg.lstsq(prior.mass_map_std * spec.modes, log_mass - log_mass.mean())[0]
    z[at["friction_map"]] = np.linalg.lstsq(prior.friction_map_std * spec.modes, log_friction - scale)[0]
    z[at["friction_scale"]] = scale / prior.friction_std
    z[at["pusher_friction"]] = np.log(pusher_friction / prior.pusher_friction) / prior.pusher_friction_std
    return z
