"""What the unknowns of one object are: named blocks of a vector `z`, each unknown in units of its prior standard deviation, with mean zero.

A specification is made once for an identification and handed on; fits under another prior, with other effects or without maps have a
variant of it. `mechanics` maps its vectors to the moving body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.identification.unknowns.outline import outline_modes
from push_ident.identification.unknowns.prior import GIVEN_STD, MAP_STDS, Prior
from push_ident.physics.active_effects import NO_MODES
from push_ident.physics.effect_values import EffectValues, effect_values
from push_ident.physics.effects import CAMERA_ERRORS, EFFECTS, SENSOR_ERRORS
from push_ident.types import Float64Array, ObjectShape


@dataclass(frozen=True, slots=True)
class Block:
    """A named group of unknowns."""

    name: str
    std: Float64Array
    """Prior standard deviation of the quantity that each unknown changes, shape (size,)."""

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.std)


@dataclass(frozen=True, slots=True)
class Layout:
    """Where each block of a vector of unknowns is: the only place that adds up sizes."""

    blocks: Mapping[str, Block]
    """By name, in their order."""
    slices: Mapping[str, slice]
    """Position of each block in the vector."""
    size: int
    """Number of unknowns."""

    @classmethod
    def of(cls, blocks: Sequence[Block]) -> Layout:
        """Blocks in their order, each name once."""
        ends = np.cumsum([0, *(block.size for block in blocks)]).tolist()
        slices = {block.name: slice(start, stop) for block, start, stop in zip(blocks, ends, ends[1:], strict=False)}
        return cls({block.name: block for block in blocks}, slices, ends[-1])

    def moved(self, x: Float64Array, target: Layout) -> Float64Array:
        """The vector of another layout with the values of those blocks that both have at one size, zero elsewhere."""
        y = np.zeros(target.size)
        for name, block in target.blocks.items():
            if name in self.blocks and self.blocks[name].size == block.size:
                y[target.slices[name]] = x[self.slices[name]]
        return y


_SHARED = "shared_effects"
"""Block of the effects that pushes of a reference have, too."""


@dataclass(frozen=True, slots=True, eq=False)
class UnknownsSpec:
    """The unknowns of one object, in the blocks `mass_map`, `pressure_map`, `friction_map`, `foot_positions`, `foot_width`,
    `foot_preferences`, `effects`, `outline`, `friction_scale`, `pusher_friction` and `total_mass`. The `pressure_map` is empty where its
    prior standard deviation is 0 or the object stands on feet; the blocks of feet where it does not; the `outline` where that is exact or
    taken as it was traced; `total_mass` without measured forces.

    Made by `UnknownsSpec.of`.
    """

    shape: ObjectShape
    """Outline and cells of the object."""
    prior: Prior
    """Nominal values and standard deviations."""
    modes: Float64Array
    """Of a map, shape (n_cells, n_modes): log map = modes @ unknowns of unit variance. Equal cells have none."""
    effects: EffectValues
    """Effects whose parameters are unknown too, at their nominal values."""
    given_effect_std: Mapping[str, ArrayLike]
    """Prior standard deviations of the parameters of an effect, by its name, where they are not those of `measured_std` or of the
    catalogue. Names of other effects are ignored."""
    shared: EffectValues | None = None
    """Effects that pushes of a reference have, too, at their nominal values: unknowns in the block `shared_effects`. `effects` add to them
    and are changes since, which pushes of the reference do not have. None where there is no reference."""
    outline_modes: Float64Array = field(default_factory=lambda: NO_MODES)
    """Displacements of the vertices of the outline by its unknowns [m], shape (n_modes, n_vertices, 2)."""
    layout: Layout = field(init=False)
    """Position of each block."""
    blocks: Mapping[str, Block] = field(init=False)
    slices: Mapping[str, slice] = field(init=False)
    size: int = field(init=False)
    """Number of unknowns. All three are those of `layout`."""
    maps: slice = field(init=False)
    """Position of the unknowns of all maps."""

    def __post_init__(self) -> None:
        if self.modes.ndim != 2 or len(self.modes) != len(self.shape.cells):
            raise InputError(f"`modes` has shape {self.modes.shape}, expected ({len(self.shape.cells)}, n_modes) as the cells.")
        n, feet, prior = self.modes.shape[1], self.prior.feet, self.prior
        preference_std = 0.7  # of the logarithm of the load that a foot prefers; statics alone gives that of three feet
        layout = Layout.of(
            (
                Block("mass_map", np.full(n, prior.mass_map_std)),
                Block("pressure_map", np.full(n if prior.pressure_map_std > 0 and not feet else 0, prior.pressure_map_std)),
                Block("friction_map", np.full(n, prior.friction_map_std)),
                Block("foot_positions", np.ones(2 * feet)),
                Block("foot_width", np.ones(min(feet, 1))),
                Block("foot_preferences", np.full(feet, preference_std)),
                *([] if self.shared is None else [Block(_SHARED, self._effect_std(self.shared))]),
                Block("effects", self._effect_std(self.effects)),
                Block("outline", np.ones(len(self.outline_modes))),
                Block("friction_scale", np.array([prior.friction_std])),
                Block("pusher_friction", np.array([prior.pusher_friction_std])),
                Block("total_mass", np.full(int(prior.force_offset_std > 0), max(prior.total_mass_std, GIVEN_STD))),
            )
        )
        derived = {
            # Always in one memory layout: products over another one differ in the last bit.
            "modes": np.ascontiguousarray(self.modes),
            "layout": layout,
            "blocks": layout.blocks,
            "slices": layout.slices,
            "size": layout.size,
            "maps": slice(layout.slices["mass_map"].start, layout.slices["friction_map"].stop),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @classmethod
    def of(
        cls,
        shape: ObjectShape,
        prior: Prior,
        *,
        maps: bool = True,
        modes: Float64Array | None = None,
        effects: Sequence[str] = (),
        effect_std: Mapping[str, ArrayLike] | None = None,
        outline: bool = False,
    ) -> UnknownsSpec:
        """The unknowns of an object, with the parameters of effects among them.

        Without `maps` cells are equal, with only the scales free; `modes`: of a map, where they are known already (from a file), shape
        (n_cells, n_modes); `effect_std`: see `given_effect_std`; `outline`: whether that is unknown where a camera traced it.
        """
        if modes is None:
            modes = leading_modes(shape, prior) if maps else np.zeros((len(shape.cells), 0))
        return cls(
            shape, prior, modes, effect_values(effects), dict(effect_std or {}), outline_modes=outline_modes(shape) if outline else NO_MODES
        )

    def _effect_std(self, effects: EffectValues) -> Float64Array:
        std = np.array([parameter.scale for parameter in effects.parameters], dtype=np.float64)
        for name in effects.names:
            measured, at = measured_std(name, self.shape, self.prior), effects.slice_of(name)
            std[at] = np.where(measured > 0, measured, std[at])
        for name, given in self.given_effect_std.items():
            if name in effects.names:
                std[effects.slice_of(name)] = given
        return std

    def with_effects(self, names: Sequence[str]) -> UnknownsSpec:
        """The same object under the same prior with other effects."""
        return replace(self, effects=effect_values(names))

    def equal_cells(self) -> UnknownsSpec:
        """Without maps: only the scales and the effects are free."""
        return replace(self, modes=np.zeros((len(self.shape.cells), 0)))

    def as_traced(self) -> UnknownsSpec:
        """With the outline as it was traced."""
        return replace(self, outline_modes=NO_MODES)

    def cell_by_cell(self) -> UnknownsSpec:
        """Each cell with an unknown mass and friction of its own. It bears its own weight: one map fewer, and the same products of both."""
        return replace(self, prior=self.prior.without_pressure(), modes=np.eye(len(self.shape.cells)))

    def at_amplitude(self, amplitude: float) -> UnknownsSpec:
        """The same unknowns with the prior standard deviations of the maps multiplied by `amplitude`."""
        return replace(self, prior=replace(self.prior, **{name: amplitude * getattr(self.prior, name) for name in MAP_STDS}))

    def slice_of_effect(self, name: str) -> slice:
        """Position of the parameters of one effect in `z`. Raises InputError for an effect that is no unknown."""
        start, at = self.slices["effects"].start, self.effects.slice_of(name)
        return slice(start + at.start, start + at.stop)

    def shape_at(self, z: Float64Array) -> ObjectShape:
        """The object with its outline at `z`, shape (size,)."""
        if len(self.outline_modes) == 0:
            return self.shape
        return replace(self.shape, outline=self.shape.outline + np.tensordot(z[self.slices["outline"]], self.outline_modes, axes=1))

    @property
    def shared_names(self) -> tuple[str, ...]:
        """Names of the effects that pushes of a reference have, too."""
        return () if self.shared is None else self.shared.names

    @property
    def effect_std(self) -> Float64Array:
        """Prior standard deviation of each value of the effects, shape (n_values,)."""
        return self.blocks["effects"].std

    @property
    def map_remainder(self) -> Float64Array:
        """Prior variance of a unit map that the modes leave out, shape (n_cells,): posteriors add it back."""
        return np.maximum(0.0, 1.0 - np.sum(self.modes**2, axis=1))

    def acting_effects(self, z: Float64Array, *, of_reference: bool = False) -> tuple[EffectValues, Float64Array]:
        """All effects at `z`, shape (size,), with the changes since a reference or, `of_reference`, without, and the derivative of their
        values by `z`, shape (n_values, size). Values beyond a bound are clipped to it, and their derivative is 0."""
        blocks = [] if of_reference else [(self.effects, "effects")]
        if self.shared is not None:
            blocks.append((self.shared, _SHARED))
        acting = effect_values(tuple(dict.fromkeys(name for effects, _ in blocks for name in effects.names)))
        values, derivative = np.array(acting.values), np.zeros((len(acting), self.size))
        for effects, block in blocks:
            std, at = self.blocks[block].std, self.slices[block]
            for name in effects.names:
                to, of = acting.slice_of(name), effects.slice_of(name)
                values[to] += (std * z[at])[of]
                derivative[to, at.start + of.start : at.start + of.stop] = np.diag(std[of])
        low, high = (np.array([getattr(p, bound) for p in acting.parameters]) for bound in ("low", "high"))
        inside = (values >= low) & (values <= high)
        return acting.with_values(np.clip(values, low, high)), np.where(inside[:, None], derivative, 0.0)

    def amplitude_unit(self, amplitude: float) -> Float64Array:
        """Unit of each unknown at an amplitude of the maps, in units of the full prior, shape (size,): `amplitude` for maps, else 1."""
        unit = np.ones(self.size)
        unit[self.maps] = amplitude
        return unit


def nuisance_effects(shape: ObjectShape, prior: Prior) -> tuple[str, ...]:
    """Effects that are unknown by how shape and poses were measured, whatever the object is.

    Pushes show where an outline that a camera traced really is, and where the camera stands with respect to the pusher.
    """
    return tuple(name for name in (*CAMERA_ERRORS, *SENSOR_ERRORS) if np.any(measured_std(name, shape, prior) > 0))


def measured_std(name: str, shape: ObjectShape, prior: Prior) -> Float64Array:
    """Standard deviations of the parameters of an effect, as far as those who measured state them, shape (n_parameters,); else 0."""
    effect = EFFECTS[name]
    if effect.moves_outline:
        return np.full(len(effect.parameters), shape.outline_error or 0.0)
    if effect.is_sensor_error:
        uses = prior.force_offset_std > 0
        return np.array([prior.force_offset_std if p.unit == "N" else (p.sensor_std or 0.0) * uses for p in effect.parameters])
    stated = {"m": prior.camera_position_std, "rad": prior.camera_heading_std} if effect.is_camera_error else {}
    return np.array([stated.get(parameter.unit, 0.0) for parameter in effect.parameters])


# --- maps as Gaussian processes over the cells (Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, section 4.2)


def leading_modes(shape: ObjectShape, prior: Prior) -> Float64Array:
    """Modes of a unit Gaussian process over the cells, scaled so that modes @ unit normal has its covariance."""
    value, vector = np.linalg.eigh(map_covariance(relative_distances(shape), prior.correlation_length))
    keep = np.argsort(value)[::-1][: prior.max_modes]
    return np.asarray(vector[:, keep] * np.sqrt(np.maximum(value[keep], 0.0)))


def relative_distances(shape: ObjectShape) -> Float64Array:
    """Between the cells, divided by the diagonal of the object, shape (n_cells, n_cells)."""
    centres = shape.cells.centres
    diagonal = float(np.linalg.norm(np.ptp(centres, axis=0))) + shape.cells.size
    return np.asarray(np.linalg.norm(centres[:, None] - centres[None], axis=2) / diagonal)


def map_covariance(distances: Float64Array, length: float) -> Float64Array:
    """Of a unit Gaussian process over the cells (Matern 3/2); `length` and `distances` are divided by the diagonal of the object."""
    scaled = np.sqrt(3) / length * distances
    return np.asarray((1 + scaled) * np.exp(-scaled))
