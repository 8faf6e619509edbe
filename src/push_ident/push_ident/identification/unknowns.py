"""The unknowns of an object in named blocks, their prior, and how the moving body depends on them.

Mass and friction of a cell are positive, so their logarithms are the unknowns. Neighbouring cells are similar, so each logarithm is a
Gaussian process over the object (Matern 3/2). In the coordinates `z` of its leading modes the prior is a unit normal:

    m_i = M w_i,   w = softmax(a),   a = A z_a                     masses, M the total mass
    P = load(w, c),   c = A z_c                                    share of the load that each cell bears, see `load`; or
    P = feet(w, p, h, g),   p = p_0 + L z_p                        on feet at the places p of width h with preferences g, see `feet`
    mu_i = mu_0 exp(s) e_i P_i / w_i / (P' e),   e = exp(b),   b = A z_b     support friction, map and scale
    mu_p = mu_p0 exp(p)                                            friction of the pusher

The friction of a cell is that of its whole limit, mu_i m_i g, on its own weight: poses see the product of load and friction only.
The scale s belongs to the friction of the whole object, mu_0 exp(s) M g, whatever the maps are. Without this separation a heavy end with
more friction would change the friction of the whole object.

Effects that the base model leaves out (`physics/effects/`) may be unknowns too: each parameter is its nominal value plus z_e times its
prior standard deviation.

The total mass M scales every force and changes no motion. It is an unknown, M = M_0 exp(m), where forces are measured; motions are
simulated at M_0.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.identification.feet import Feet, FeetDerivative, FeetLoad, feet_load, feet_load_derivative
from push_ident.identification.load import balanced_load, balanced_load_derivative
from push_ident.identification.map_modes import leading_modes, map_covariance, relative_distances
from push_ident.identification.nuisances import measured_std
from push_ident.identification.prior import MapPrior, Prior
from push_ident.identification.quadratic import Quadratic
from push_ident.physics.effect_values import EffectValues, effect_values
from push_ident.physics.rollout import N_BODY_PARAMETERS, PARAM_CENTRE, PARAM_INERTIA, PARAM_LIMIT, PARAM_MU
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import BodyParameters, Motion, SimulationSettings, Timeline, body_of_cells, simulate_body
from push_ident.types import BoolArray, Float64Array, ObjectModel, ObjectShape

__all__ = ["Block", "Layout", "Mechanics", "Unknowns"]

_ROUNDING: Final = 1e-12
"""Added to the covariance of the modes, which are independent with a variance of 1 at the own length [-]."""
_PREFERENCE_STD: Final = 0.7
"""Prior standard deviation of the logarithm of the load that a foot prefers [-]; statics alone gives that of three feet."""
_FOOT_WIDTH: Final = (0.3, 0.3)
"""Width of a foot: the least one, at which a foot between cells still has its place, and the median beyond it, in cells [-]."""
_GIVEN_STD: Final = 1e-3
"""Standard deviation of the logarithm of a total mass that counts as given [-]: no scale of a force sensor is better."""
_FROZEN_PRECISION: Final = 1e8
"""Precision about zero of a frozen unknown, in units of its prior: a standard deviation of 1e-4 prior standard deviations, below any
effect on a motion. A finite number keeps one layout of the vector for free and frozen unknowns."""


@dataclass(frozen=True, slots=True)
class Block:
    """A named group of unknowns. Each unknown counts in units of its prior standard deviation, with mean zero."""

    name: str
    std: Float64Array
    """Prior standard deviation of the quantity that each unknown changes, shape (size,)."""
    low: Float64Array
    """Least change of the quantity from its nominal value, shape (size,); -inf where nothing bounds it."""
    high: Float64Array
    """Greatest change, shape (size,)."""
    frozen: BoolArray
    """Unknowns that keep their nominal value, shape (size,)."""

    @classmethod
    def of(cls, name: str, std: ArrayLike, low: ArrayLike = -np.inf, high: ArrayLike = np.inf, frozen: Collection[int] = ()) -> Block:
        """A block; `low` and `high` may be one number for all of it, `frozen` are numbers within the block."""
        deviation = np.atleast_1d(np.array(std, dtype=np.float64))
        mask = np.zeros(len(deviation), dtype=bool)
        mask[list(frozen)] = True
        least, greatest = (np.broadcast_to(np.asarray(v, dtype=np.float64), deviation.shape) for v in (low, high))
        return cls(name, deviation, least, greatest, mask)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.std)


class Layout:
    """Where each block of a vector of unknowns is: the only place that adds up sizes.

    Args:
        blocks: in their order, each name once.
    """

    def __init__(self, blocks: Sequence[Block]) -> None:
        self.blocks = tuple(blocks)
        ends = np.cumsum([0, *(block.size for block in blocks)]).tolist()
        self._slices = {block.name: slice(start, stop) for block, start, stop in zip(blocks, ends, ends[1:], strict=False)}
        self.size: int = ends[-1]

    def slice_of(self, name: str) -> slice:
        """Place of a block. Raises InputError for a name that the layout does not have."""
        if name not in self._slices:
            raise InputError(f"There is no block {name!r} of unknowns, expected one of {', '.join(self._slices)}.")
        return self._slices[name]

    def moved(self, x: Float64Array, target: Layout) -> Float64Array:
        """The vector of another layout with the values of those blocks that both have at one size, zero elsewhere."""
        y = np.zeros(target.size)
        for block in target.blocks:
            own = self._slices.get(block.name)
            if own is not None and own.stop - own.start == block.size:
                y[target.slice_of(block.name)] = x[own]
        return y


@dataclass(frozen=True, slots=True)
class Mechanics:
    """The moving body for given unknowns, with its derivative."""

    shape: ObjectShape
    body: BodyParameters
    pusher_friction: float
    effects: EffectValues
    """Those that poses show."""
    derivative: Float64Array
    """d(body parameters, limits of the cells, values of the effects) / dz, shape (8 + n_cells + n_values, size), rows as the columns of
    `Motion.jacobian`."""

    @property
    def limit_derivative(self) -> Float64Array:
        """The rows of the cells' friction limits, shape (n_cells, size)."""
        return self.derivative[PARAM_LIMIT : PARAM_LIMIT + len(self.shape.cells)]

    def simulate(
        self, scenario: PushScenario, settings: SimulationSettings | None = None, jacobian: bool = False, timeline: Timeline | None = None
    ) -> Motion:
        """As `simulate_body`."""
        return simulate_body(
            self.shape, self.body, self.pusher_friction, scenario, settings=settings, effects=self.effects, jacobian=jacobian,
            timeline=timeline,
        )  # fmt: skip


class Unknowns:
    """The unknowns `z` of one object, in the blocks `mass_map`, `pressure_map`, `friction_map`, `foot_places`, `foot_width`,
    `foot_preferences`, `effects`, `friction_scale`, `pusher_friction` and `total_mass`. There is no
    `pressure_map` where its prior standard deviation is 0 or the object stands on feet; without feet there are no blocks of feet, and
    without measured forces no `total_mass`.

    Args:
        shape: outline and cells of the object.
        prior: nominal values and standard deviations.
        maps: False leaves equal cells, with only the scales free (the `scalar` model).
        modes: of a map, where they are known already (from a file), shape (n_cells, n_modes).
        effects: names of effects whose parameters are unknown too.
        effect_std: prior standard deviations of the parameters of an effect, by its name; by default those of the catalogue, of errors of
            an outline that a camera traced its own. Names of effects that are not among `effects` are ignored.
        frozen_effects: numbers of values of the effects that keep their nominal value.

    Attributes:
        modes: of a map, shape (n_cells, n_modes): a = modes @ z_a.
        effects: the effects at their nominal values.
        layout: where each block is.
    """

    def __init__(
        self,
        shape: ObjectShape,
        prior: Prior,
        *,
        maps: bool = True,
        modes: Float64Array | None = None,
        effects: Sequence[str] = (),
        effect_std: Mapping[str, ArrayLike] | None = None,
        frozen_effects: Collection[int] = (),
    ) -> None:
        self.shape = shape
        self.prior = prior
        if modes is None:
            modes = leading_modes(shape, prior) if maps else np.zeros((len(shape.cells), 0))
        if modes.ndim != 2 or len(modes) != len(shape.cells):
            raise InputError(f"`modes` has shape {modes.shape}, expected ({len(shape.cells)}, n_modes) as the cells.")
        # Always in one memory layout: products over another one differ in the last bit.
        self.modes = np.ascontiguousarray(modes)
        self.effects = effect_values(effects)
        self._given_effect_std = dict(effect_std or {})
        n, feet, parameters = self.modes.shape[1], prior.feet, self.effects.parameters
        self.layout = Layout(
            (
                Block.of("mass_map", np.full(n, prior.mass_map_std)),
                Block.of("pressure_map", np.full(n if prior.pressure_map_std > 0 and not feet else 0, prior.pressure_map_std)),
                Block.of("friction_map", np.full(n, prior.friction_map_std)),
                Block.of("foot_places", np.ones(2 * feet)),
                Block.of("foot_width", np.ones(min(feet, 1))),
                Block.of("foot_preferences", np.full(feet, _PREFERENCE_STD)),
                Block.of(
                    "effects",
                    self._effect_std(),
                    [p.low - p.nominal for p in parameters],
                    [p.high - p.nominal for p in parameters],
                    frozen_effects,
                ),
                Block.of("friction_scale", prior.friction_std),
                Block.of("pusher_friction", prior.pusher_friction_std),
                Block.of("total_mass", np.full(int(prior.force_offset_std > 0), max(prior.total_mass_std, _GIVEN_STD))),
            )
        )

    def _effect_std(self) -> Float64Array:
        std = np.array([parameter.scale for parameter in self.effects.parameters], dtype=np.float64)
        for name in self.effects.names:
            measured, own = measured_std(name, self.shape, self.prior), self.effects.slice_of(name)
            std[own] = np.where(measured > 0, measured, std[own])
        for name, given in self._given_effect_std.items():
            if name in self.effects.names:
                std[self.effects.slice_of(name)] = given
        return std

    def with_effects(self, names: Sequence[str], frozen_effects: Collection[int] = ()) -> Unknowns:
        """The same object under the same prior with other effects."""
        return Unknowns(
            self.shape, self.prior, modes=self.modes, effects=names, effect_std=self._given_effect_std, frozen_effects=frozen_effects
        )

    def at_amplitude(self, amplitude: float) -> Unknowns:
        """The same unknowns with the prior standard deviations of the maps multiplied by `amplitude`."""
        prior = self.prior.at_amplitude(amplitude)
        frozen = np.flatnonzero(self.block("effects").frozen).tolist()
        return Unknowns(
            self.shape, prior, modes=self.modes, effects=self.effects.names, effect_std=self._given_effect_std, frozen_effects=frozen
        )

    def under(self, maps: MapPrior) -> Unknowns:
        """The same unknowns under another prior of the maps, with as many modes; a map that is not there stays away."""
        prior = replace(
            self.prior,
            mass_map_std=maps.mass_std,
            pressure_map_std=maps.pressure_std if self.block("pressure_map").size else self.prior.pressure_map_std,
            friction_map_std=maps.friction_std,
            correlation_length=maps.length,
        )
        frozen = np.flatnonzero(self.block("effects").frozen).tolist()
        return Unknowns(
            self.shape,
            prior,
            modes=self.modes @ self._mode_transform(maps.length),
            effects=self.effects.names,
            effect_std=self._given_effect_std,
            frozen_effects=frozen,
        )

    def map_transform(self, maps: MapPrior) -> Float64Array:
        """Matrix from `z` of `under(maps)` to the own, lower triangular, shape (size, size)."""
        transform = np.eye(self.size)
        modes = self._mode_transform(maps.length)
        for name, std in (("mass_map", maps.mass_std), ("pressure_map", maps.pressure_std), ("friction_map", maps.friction_std)):
            block = self.block(name)
            if block.size:
                transform[self.slice_of(name), self.slice_of(name)] = std / block.std[:, None] * modes
        return transform

    def _mode_transform(self, length: float) -> Float64Array:
        """Root of the covariance of the modes under a unit map of another correlation length, shape (n_modes, n_modes)."""
        if length == self.prior.correlation_length:
            return np.eye(self.n_modes)
        if length not in self._mode_transforms:
            covariance = self._onto_modes @ map_covariance(self._distances, length) @ self._onto_modes.T
            self._mode_transforms[length] = np.asarray(np.linalg.cholesky(covariance + _ROUNDING * np.eye(self.n_modes)), dtype=np.float64)
        return self._mode_transforms[length]

    @cached_property
    def _mode_transforms(self) -> dict[float, Float64Array]:
        """By length: a search for the hyperparameters asks for the same one more than once."""
        return {}

    @cached_property
    def _distances(self) -> Float64Array:
        return relative_distances(self.shape)

    @cached_property
    def _onto_modes(self) -> Float64Array:
        """Least-squares inverse of `modes`, shape (n_modes, n_cells)."""
        return np.asarray(np.linalg.pinv(self.modes), dtype=np.float64)

    @property
    def blocks(self) -> tuple[Block, ...]:
        """In the order of `z`."""
        return self.layout.blocks

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.layout.size

    def block(self, name: str) -> Block:
        """The block of a name."""
        return next(block for block in self.blocks if block.name == name)

    def slice_of(self, name: str) -> slice:
        """Place of a block in `z`."""
        return self.layout.slice_of(name)

    def slice_of_effect(self, name: str) -> slice:
        """Place of the parameters of one effect in `z`. Raises InputError for an effect that is no unknown."""
        start, own = self.slice_of("effects").start, self.effects.slice_of(name)
        return slice(start + own.start, start + own.stop)

    @property
    def n_modes(self) -> int:
        """Number of modes of each map."""
        return int(self.modes.shape[1])

    @property
    def maps(self) -> slice:
        """Place of the unknowns of all maps within `z`."""
        return slice(self.slice_of("mass_map").start, self.slice_of("friction_map").stop)

    @property
    def has_load(self) -> bool:
        """Whether a cell may bear more or less than its own weight."""
        return self.block("pressure_map").size > 0 or self.prior.feet > 0

    @cached_property
    def frozen_cost(self) -> Quadratic | None:
        """Cost that keeps the frozen unknowns at zero, beside the unit normal prior; None where none is frozen."""
        frozen = np.concatenate([block.frozen for block in self.blocks])
        if not np.any(frozen):
            return None
        zero = np.zeros(self.size)
        return Quadratic(zero, zero, np.diag(np.where(frozen, _FROZEN_PRECISION, 0.0)))

    @property
    def effect_std(self) -> Float64Array:
        """Prior standard deviation of each value of the effects, shape (n_values,)."""
        return self.block("effects").std

    def effects_at(self, z: Float64Array) -> EffectValues:
        """The effects with their values at `z`; values beyond a bound are clipped to it."""
        return self.effects.with_values(self.effect_values(z)[0])

    def effect_values(self, z: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Values of the effects and their derivative by their own unknowns, 0 beyond a bound, each shape (n_values,)."""
        low, high = (np.array([getattr(p, name) for p in self.effects.parameters]) for name in ("low", "high"))
        std = self.effect_std
        free = self.effects.values + std * z[self.slice_of("effects")]
        return np.clip(free, low, high), np.where((free >= low) & (free <= high), std, 0.0)

    @property
    def map_remainder(self) -> Float64Array:
        """Prior variance of a unit map that the modes leave out, shape (n_cells,): posteriors add it back."""
        return np.maximum(0.0, 1.0 - np.sum(self.modes**2, axis=1))

    def amplitude_unit(self, amplitude: float) -> Float64Array:
        """Unit of each unknown at an amplitude of the maps, in units of the full prior, shape (size,): `amplitude` for maps, else 1."""
        unit = np.ones(self.size)
        unit[self.maps] = amplitude
        return unit

    def _scalar(self, z: Float64Array, name: str) -> np.float64:
        (value,) = z[self.slice_of(name)]
        return np.float64(value)

    def model(self, z: Float64Array) -> ObjectModel:
        """The object at `z`, shape (size,)."""
        prior = self.prior
        weight = self._weight(z)
        roughness = np.exp(prior.friction_map_std * (self.modes @ z[self.slice_of("friction_map")]))
        if self.has_load:
            roughness *= self._load(z, weight) / weight
        scale = float(np.exp(prior.friction_std * self._scalar(z, "friction_scale")))
        return ObjectModel(
            shape=self.shape,
            mass=prior.total_mass * weight,
            friction=prior.friction * scale * roughness / float(weight @ roughness),
            pusher_friction=float(prior.pusher_friction * np.exp(prior.pusher_friction_std * self._scalar(z, "pusher_friction"))),
        )

    def _weight(self, z: Float64Array) -> Float64Array:
        """Share of the mass of each cell, shape (n_cells,)."""
        a = self.prior.mass_map_std * (self.modes @ z[self.slice_of("mass_map")])
        weight = np.exp(a - a.max())
        return np.asarray(weight / weight.sum())

    def feet(self, z: Float64Array) -> FeetLoad:
        """The feet at `z`. Raises InputError where the object stands on its whole base."""
        if not self.prior.feet:
            raise InputError("This object stands on its whole base, it has no feet.")
        return self._feet(z, self._weight(z))

    def _feet(self, z: Float64Array, weight: Float64Array) -> FeetLoad:
        preference = _PREFERENCE_STD * z[self.slice_of("foot_preferences")]
        return feet_load(weight, self.shape.cells.centres, Feet(self._foot_places(z), self._foot_width(z)[0], preference))

    def _foot_places(self, z: Float64Array) -> Float64Array:
        """[m], shape (n_feet, 2)."""
        return np.asarray(self.shape.cells.centres.mean(axis=0) + z[self.slice_of("foot_places")].reshape(-1, 2) @ self._base_root.T)

    def foot_place_unknowns(self, places: Float64Array) -> Float64Array:
        """The block `foot_places` of given places [m], shape (n_feet, 2)."""
        offset = places - self.shape.cells.centres.mean(axis=0)
        return np.asarray(np.linalg.solve(self._base_root, offset.T).T.ravel())

    @cached_property
    def _base_root(self) -> Float64Array:
        """Root of the covariance of the places on the base [m], shape (2, 2): the prior of the place of a foot."""
        cells = self.shape.cells
        return np.asarray(np.linalg.cholesky(np.cov(cells.centres.T, bias=True) + np.eye(2) * cells.size**2 / 12))

    def _foot_width(self, z: Float64Array) -> tuple[float, float]:
        """Width of the feet [m], and the derivative of its logarithm by its unknown [-]."""
        least, median = _FOOT_WIDTH
        more = median * float(np.exp(self._scalar(z, "foot_width")))
        return self.shape.cells.size * (least + more), more / (least + more)

    def _load(self, z: Float64Array, weight: Float64Array) -> Float64Array:
        """Share of the load of each cell, shape (n_cells,)."""
        if self.prior.feet:
            return self._feet(z, weight).load
        excess = self.prior.pressure_map_std * (self.modes @ z[self.slice_of("pressure_map")])
        return balanced_load(weight, excess, self.shape.cells.centres)

    def log_derivatives(self, z: Float64Array) -> tuple[Float64Array, Float64Array]:
        """d log(mass of each cell) / dz and d log(friction of each cell) / dz at `z`, each shape (n_cells, size)."""
        return self._log_derivatives(z, self.model(z))

    def _log_derivatives(self, z: Float64Array, model: ObjectModel) -> tuple[Float64Array, Float64Array]:
        prior = self.prior
        d_mass = np.zeros((len(model.mass), self.size))
        d_friction = np.zeros_like(d_mass)
        # Of the weights w_i = softmax(a): only differences count.
        d_mass[:, self.slice_of("mass_map")] = prior.mass_map_std * (self.modes - model.mass @ self.modes / model.total_mass)
        d_friction[:, self.slice_of("friction_map")] = prior.friction_map_std * self.modes
        if self.has_load:
            d_friction += self._load_derivative(z, d_mass) - d_mass
        load = model.mass * model.friction
        d_friction -= load @ (d_mass + d_friction) / load.sum()
        d_friction[:, self.slice_of("friction_scale")] += prior.friction_std
        return d_mass, d_friction

    def _load_derivative(self, z: Float64Array, d_mass: Float64Array) -> Float64Array:
        """d log(load of each cell) / dz, shape (n_cells, size)."""
        weight = self._weight(z)
        if self.prior.feet:
            return self._feet_derivative(z, weight, d_mass)
        d_excess = np.zeros_like(d_mass)
        d_excess[:, self.slice_of("pressure_map")] = self.prior.pressure_map_std * self.modes
        return balanced_load_derivative(weight, self._load(z, weight), self.shape.cells.centres, d_mass, d_excess)

    def _feet_derivative(self, z: Float64Array, weight: Float64Array, d_mass: Float64Array) -> Float64Array:
        own = np.eye(self.size)
        d_feet = FeetDerivative(
            place=np.einsum("ab,kbz->kaz", self._base_root, own[self.slice_of("foot_places")].reshape(self.prior.feet, 2, -1)),
            log_width=self._foot_width(z)[1] * own[self.slice_of("foot_width")][0],
            preference=_PREFERENCE_STD * own[self.slice_of("foot_preferences")],
        )
        return feet_load_derivative(self._feet(z, weight), d_mass, d_feet)

    def of_maps(self, mass: Float64Array, friction: Float64Array, pusher_friction: float) -> Float64Array:
        """Unknowns of given maps, shape (size,): exact where every cell has a mode of its own, else the nearest smooth maps.

        Masses may have any common scale. Raises InputError for values that are not positive, which have no logarithm.
        """
        if np.any(mass <= 0) or np.any(friction <= 0) or pusher_friction <= 0:
            raise InputError("Masses and friction coefficients must be positive to have a logarithm; raise those at zero a little.")
        prior = self.prior
        z = np.zeros(self.size)
        log_mass, log_friction = np.log(mass), np.log(friction / prior.friction)
        scale = np.log(mass @ friction / mass.sum() / prior.friction)
        z[self.slice_of("mass_map")] = np.linalg.lstsq(prior.mass_map_std * self.modes, log_mass - log_mass.mean())[0]
        z[self.slice_of("friction_map")] = np.linalg.lstsq(prior.friction_map_std * self.modes, log_friction - scale)[0]
        z[self.slice_of("friction_scale")] = scale / prior.friction_std
        z[self.slice_of("pusher_friction")] = np.log(pusher_friction / prior.pusher_friction) / prior.pusher_friction_std
        return z

    def mass_factor(self, z: Float64Array) -> float:
        """Total mass over the nominal one, 1 where no forces are measured."""
        own = self.block("total_mass")
        return float(np.exp(own.std @ z[self.slice_of("total_mass")]))

    def mechanics(self, z: Float64Array) -> Mechanics:
        """The moving body at `z`, shape (size,), and its derivative by `z`."""
        model = self.model(z)
        body = body_of_cells(self.shape, model.mass, model.friction)
        weight = model.mass / body.mass
        arms = self.shape.cells.centres - body.centre
        moment = np.sum(arms**2, axis=1) + self.shape.cells.size**2 / 6
        d_mass, d_friction = self._log_derivatives(z, model)
        values, d_values = self.effect_values(z)
        shown = np.array([not effect.needs_forces for effect in self.effects.effects for _ in effect.parameters], dtype=bool)
        n_cells, n_values = len(weight), int(np.sum(shown))
        derivative = np.zeros((N_BODY_PARAMETERS + n_cells + n_values, self.size))
        derivative[PARAM_CENTRE : PARAM_CENTRE + 2] = (weight[:, None] * arms).T @ d_mass
        derivative[PARAM_INERTIA] = body.mass * ((weight * moment) @ d_mass)
        derivative[PARAM_LIMIT : PARAM_LIMIT + n_cells] = body.limit[:, None] * (d_mass + d_friction)
        derivative[PARAM_MU, self.slice_of("pusher_friction")] = model.pusher_friction * self.prior.pusher_friction_std
        derivative[PARAM_LIMIT + n_cells :, self.slice_of("effects")] = np.diag(d_values)[shown]
        return Mechanics(self.shape, body, model.pusher_friction, self.effects.with_values(values).of_poses, derivative)
