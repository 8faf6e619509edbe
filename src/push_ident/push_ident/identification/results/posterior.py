"""What is known of an object, given its pushes: a Gaussian over its unknowns, or a mixture of some.

Smooth maps of a whole base and a few feet are different unknowns, and few pushes leave more than one of them possible. The Gaussian of the
likeliest one is what reports and the next fit go on from; the others stand beside it with their weights. What is predicted, and the maps
with their standard deviations, are those of the mixture: of each cell the mean mass and the mean friction limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.unknowns.mechanics import Mechanics, effects_at, log_derivatives_at, mechanics_at, model_at
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec, nuisance_effects
from push_ident.physics.effect_values import EffectValues
from push_ident.physics.simulation import body_of_cells
from push_ident.types import Float64Array, ObjectModel, ObjectShape

_GOLDEN: Final = 0.5 * (np.sqrt(5.0) - 1.0)
"""Golden ratio: its multiples, without their whole parts, divide the unit interval as evenly as any sequence does, however long it is
(Knuth, The Art of Computer Programming 3, section 6.4)."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its standard deviation."""

    value: float
    std: float


@dataclass(frozen=True)
class ModelPosterior:
    """A Gaussian over the unknowns of one object, given its pushes, with the alternatives that they leave."""

    def __repr__(self) -> str:
        known = "given or measured" if self.total_mass_identifiable else "not determined by poses"
        return f"ModelPosterior({len(self.unknowns.shape.cells)} cells, {len(self.z)} unknowns, total mass {known})"

    unknowns: UnknownsSpec
    z: Float64Array
    """Mean, shape (n_unknowns,)."""
    covariance: Float64Array
    """Shape (n_unknowns, n_unknowns)."""
    total_mass: Estimate
    """[kg]; the prior's where `total_mass_identifiable` is False."""
    total_mass_identifiable: bool
    """Whether measured forces or a given weight determine it; poses never do."""
    pose_noise_factor: float | None = None
    """On the stated standard deviation of poses that no other frame checks, set by the pushes; None: not set by them."""
    alternatives: tuple[tuple[float, ModelPosterior], ...] = ()
    """Other kinds of support that are possible: the weight of each [1], and its Gaussian, without alternatives. The rest of the weight is
    that of `z`."""

    @classmethod
    def of_prior(cls, unknowns: UnknownsSpec) -> ModelPosterior:
        """The posterior without any push."""
        prior = unknowns.prior
        return cls(
            unknowns=unknowns,
            z=np.zeros(unknowns.size),
            covariance=np.eye(unknowns.size),
            total_mass=Estimate(prior.total_mass, prior.total_mass * prior.total_mass_std),
            total_mass_identifiable=prior.total_mass_std == 0,
        )

    @cached_property
    def parts(self) -> tuple[tuple[float, ModelPosterior], ...]:
        """The Gaussians of the mixture with their weights [1], of sum 1: that of `z` first."""
        if not self.alternatives:
            return ((1.0, self),)
        return ((1.0 - sum(weight for weight, _ in self.alternatives), replace(self, alternatives=())), *self.alternatives)

    @cached_property
    def model(self) -> ObjectModel:
        """The mean model, at the mean total mass."""
        at_nominal = self._at_nominal
        scale = self.total_mass.value / at_nominal.total_mass
        return ObjectModel(at_nominal.shape, at_nominal.mass * scale, at_nominal.friction, at_nominal.pusher_friction)

    @cached_property
    def _at_nominal(self) -> ObjectModel:
        """The mean model at the nominal total mass: means of masses and of friction limits, and the geometric mean of the pusher's."""
        models = [(weight, model_at(part.unknowns, part.z)) for weight, part in self.parts]
        first = models[0][1]
        if len(models) == 1:
            return first
        mass = np.sum([weight * model.mass for weight, model in models], axis=0)
        limit = np.sum([weight * model.mass * model.friction for weight, model in models], axis=0)
        return ObjectModel(first.shape, mass, limit / mass, float(np.exp(sum(w * np.log(model.pusher_friction) for w, model in models))))

    @property
    def mechanics(self) -> Mechanics:
        """The moving body of `z`, with its derivative."""
        return mechanics_at(self.unknowns, self.z)

    @property
    def mean_mechanics(self) -> Mechanics:
        """The moving body of the mean model, for predictions: without a derivative where there are alternatives."""
        mechanics = self.mechanics
        if not self.alternatives:
            return mechanics
        model = self._at_nominal
        body = replace(body_of_cells(model.shape, model.mass, model.friction), outline_modes=mechanics.body.outline_modes)
        derivative = np.zeros((len(mechanics.derivative), 0))
        return replace(mechanics, shape=model.shape, body=body, pusher_friction=model.pusher_friction, derivative=derivative)

    def drawn(self, normal: Float64Array) -> list[tuple[ModelPosterior, Float64Array]]:
        """Drawn models, one for each row of unit normal numbers, shape (n, `most_unknowns` and more): the part of the mixture, and its
        unknowns.

        Parts have their share of any first n of them.
        """
        ends = np.cumsum([weight for weight, _ in self.parts])
        chosen = np.searchsorted(ends[:-1], (0.5 + _GOLDEN * np.arange(len(normal))) % 1.0, side="right")
        roots = [square_root(part.covariance) for _, part in self.parts]
        drawn = []
        for row, k in zip(normal, chosen, strict=True):
            part = self.parts[k][1]
            drawn.append((part, part.z + roots[k] @ row[: len(part.z)]))
        return drawn

    @property
    def most_unknowns(self) -> int:
        """Of the largest part of the mixture."""
        return max(len(part.z) for _, part in self.parts)

    @cached_property
    def _log_derivatives(self) -> tuple[Float64Array, Float64Array]:
        d_mass, d_friction = log_derivatives_at(self.unknowns, self.z)
        d_mass[:, self.unknowns.slices["total_mass"]] = self.unknowns.blocks["total_mass"].std
        return d_mass, d_friction

    @property
    def _total_variance(self) -> float:
        """Variance of the logarithm of the total mass where it is no unknown beside the others."""
        return 0.0 if self.unknowns.blocks["total_mass"].size else (self.total_mass.std / self.total_mass.value) ** 2

    def noise(self, noise: NoiseModel | None = None) -> NoiseModel:
        """A noise model, with the factor of unchecked poses that these pushes set unless the model has one."""
        noise = noise or NoiseModel()
        return replace(noise, single_frame_inflation=self.pose_noise_factor) if noise.single_frame_inflation is None else noise

    @property
    def prior(self) -> Prior:
        """Of the unknowns."""
        return self.unknowns.prior

    @property
    def effects(self) -> EffectValues:
        """The effects beside the maps, at their mean values."""
        return effects_at(self.unknowns, self.z)

    @property
    def effects_std(self) -> Float64Array:
        """Standard deviation of the values of the effects, shape (n_values,)."""
        at = self.unknowns.slices["effects"]
        return np.asarray(self.unknowns.effect_std * np.sqrt(np.diag(self.covariance)[at]))

    def _log_std(self, rows: Float64Array, left_out: float, other: float) -> Float64Array:
        """Standard deviation of a logarithm with derivative `rows`.

        `left_out` is the variance of the modes that the maps leave out, `other` that of anything else.
        """
        variance = np.sum((rows @ self.covariance) * rows, axis=1)
        return np.sqrt(variance + left_out * self.unknowns.map_remainder + other)

    def _mixed_std(self, of_part: Callable[[ModelPosterior], tuple[Float64Array, Float64Array]]) -> Float64Array:
        """Standard deviation of a quantity of the cells, from its value and standard deviation in each part of the mixture, each shape
        (n_cells,)."""
        values = [(weight, *of_part(part)) for weight, part in self.parts]
        if len(values) == 1:
            return values[0][2]
        mean = np.sum([weight * value for weight, value, _ in values], axis=0)
        return np.sqrt(np.sum([weight * (std**2 + (value - mean) ** 2) for weight, value, std in values], axis=0))

    @property
    def mass_std(self) -> Float64Array:
        """Standard deviation of the mass of each cell [kg], shape (n_cells,)."""

        def of_part(part: ModelPosterior) -> tuple[Float64Array, Float64Array]:
            model, (d_mass, _) = part.model, part._log_derivatives
            return model.mass, model.mass * part._log_std(d_mass, part.prior.mass_map_std**2, part._total_variance)

        return self._mixed_std(of_part)

    @property
    def friction_std(self) -> Float64Array:
        """Standard deviation of the support friction of each cell, shape (n_cells,)."""

        def of_part(part: ModelPosterior) -> tuple[Float64Array, Float64Array]:
            model, (_, d_friction) = part.model, part._log_derivatives
            return model.friction, model.friction * part._log_std(d_friction, part.prior.friction_map_std**2, 0.0)

        return self._mixed_std(of_part)

    @property
    def mass_friction_std(self) -> Float64Array:
        """Standard deviation of mass times friction of each cell [kg], shape (n_cells,)."""

        def of_part(part: ModelPosterior) -> tuple[Float64Array, Float64Array]:
            model, (d_mass, d_friction) = part.model, part._log_derivatives
            left_out, product = part.prior.mass_map_std**2 + part.prior.friction_map_std**2, model.mass * model.friction
            return product, product * part._log_std(d_mass + d_friction, left_out, part._total_variance)

        return self._mixed_std(of_part)

    @property
    def pusher_friction(self) -> Estimate:
        """Friction coefficient between pusher and object."""

        def of_part(part: ModelPosterior) -> tuple[Float64Array, Float64Array]:
            value, at = np.array([part.model.pusher_friction]), part.unknowns.slices["pusher_friction"]
            return value, value * part.prior.pusher_friction_std * np.sqrt(np.diag(part.covariance)[at])

        return Estimate(self.model.pusher_friction, float(self._mixed_std(of_part)[0]))


def prior_posterior(shape: ObjectShape, prior: Prior | None = None) -> ModelPosterior:
    """The posterior of an object that was never pushed: its prior."""
    prior = prior or Prior()
    return ModelPosterior.of_prior(UnknownsSpec.of(shape, prior, effects=nuisance_effects(shape, prior), outline=True))


def with_total_mass(posterior: ModelPosterior) -> ModelPosterior:
    """State the total mass of a posterior that has it among its unknowns; any other stays as it is.

    Poses carry no information about it. A force determines the product of total mass and friction scale; poses (through inertia) and the
    prior bound both factors weakly. It is identified when its posterior standard deviation is below half of the prior's.
    """
    block, at = posterior.unknowns.blocks["total_mass"], posterior.unknowns.slices["total_mass"]
    if block.size == 0:
        return posterior
    (std,), prior = block.std, posterior.prior
    value = prior.total_mass * float(np.exp(std * posterior.z[at][0]))
    log_std = float(std * np.sqrt(posterior.covariance[at, at][0, 0]))
    identified = bool(prior.total_mass_std == 0 or log_std < 0.5 * prior.total_mass_std)
    return replace(posterior, total_mass=Estimate(value, value * log_std), total_mass_identifiable=identified)


def lower_root(covariance: Float64Array) -> Float64Array:
    """Lower triangular L with L L' = covariance, shape (n, n): that of Cholesky where there is one.

    The inverse of a Hessian with very steep and very flat directions can have eigenvalues just below 0, and so can a covariance from which
    a part was taken away: they count as 0. Being triangular, L gives the first unknowns the same draws whatever follows them.
    """
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        value, vector = np.linalg.eigh(covariance)
        _, upper = np.linalg.qr((vector * np.sqrt(np.maximum(value, 0.0))).T)
        return np.asarray(np.where(np.diag(upper) < 0.0, -1.0, 1.0) * upper.T)


def square_root(covariance: Float64Array) -> Float64Array:
    """A with A A' = covariance, shape (n, n), also where some directions are known exactly."""
    value, vector = np.linalg.eigh(covariance)
    return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))
