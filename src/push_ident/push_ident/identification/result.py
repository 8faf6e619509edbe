"""The outcome of an identification: a model with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from push_ident.identification.explanation import Explanation
from push_ident.identification.nuisances import nuisances_of
from push_ident.identification.observation import NoiseModel
from push_ident.identification.prior import MapPrior, Prior
from push_ident.identification.unknowns import Unknowns
from push_ident.physics.effect_values import EffectValues
from push_ident.types import Float64Array, ObjectModel, ObjectShape, SolveStatus, short_repr

__all__ = ["Candidate", "Checkpoint", "Estimate", "Identification", "ModelPosterior", "WarmStart", "prior_posterior"]


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its standard deviation."""

    value: float
    std: float


@dataclass(frozen=True)
class ModelPosterior:
    """A Gaussian over the unknowns of one object, given its pushes."""

    def __repr__(self) -> str:
        known = "given or measured" if self.total_mass_identifiable else "not determined by poses"
        return f"ModelPosterior({len(self.unknowns.shape.cells)} cells, {len(self.z)} unknowns, total mass {known})"

    unknowns: Unknowns
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

    @classmethod
    def of_prior(cls, unknowns: Unknowns) -> ModelPosterior:
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
    def model(self) -> ObjectModel:
        """The mean model, at the mean total mass."""
        at_nominal = self.unknowns.model(self.z)
        scale = self.total_mass.value / at_nominal.total_mass
        return ObjectModel(at_nominal.shape, at_nominal.mass * scale, at_nominal.friction, at_nominal.pusher_friction)

    @cached_property
    def _log_derivatives(self) -> tuple[Float64Array, Float64Array]:
        d_mass, d_friction = self.unknowns.log_derivatives(self.z)
        d_mass[:, self.unknowns.slice_of("total_mass")] = self.unknowns.block("total_mass").std
        return d_mass, d_friction

    @property
    def _total_variance(self) -> float:
        """Variance of the logarithm of the total mass where it is no unknown beside the others."""
        return 0.0 if self.unknowns.block("total_mass").size else (self.total_mass.std / self.total_mass.value) ** 2

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
        return self.unknowns.effects_at(self.z)

    @property
    def effects_std(self) -> Float64Array:
        """Standard deviation of the values of the effects, shape (n_values,)."""
        own = self.unknowns.slice_of("effects")
        return np.asarray(self.unknowns.effect_std * np.sqrt(np.diag(self.covariance)[own]))

    def _log_std(self, rows: Float64Array, left_out: float, other: float) -> Float64Array:
        """Standard deviation of a logarithm with derivative `rows`.

        `left_out` is the variance of the modes that the maps leave out, `other` that of anything else.
        """
        variance = np.sum((rows @ self.covariance) * rows, axis=1)
        return np.sqrt(variance + left_out * self.unknowns.map_remainder + other)

    @property
    def mass_std(self) -> Float64Array:
        """Standard deviation of the mass of each cell [kg], shape (n_cells,)."""
        model, (d_mass, _) = self.model, self._log_derivatives
        return np.asarray(model.mass * self._log_std(d_mass, self.prior.mass_map_std**2, self._total_variance))

    @property
    def friction_std(self) -> Float64Array:
        """Standard deviation of the support friction of each cell, shape (n_cells,)."""
        model, (_, d_friction) = self.model, self._log_derivatives
        return np.asarray(model.friction * self._log_std(d_friction, self.prior.friction_map_std**2, 0.0))

    @property
    def mass_friction_std(self) -> Float64Array:
        """Standard deviation of mass times friction of each cell [kg], shape (n_cells,)."""
        model, (d_mass, d_friction) = self.model, self._log_derivatives
        left_out = self.prior.mass_map_std**2 + self.prior.friction_map_std**2
        return np.asarray(model.mass * model.friction * self._log_std(d_mass + d_friction, left_out, self._total_variance))

    @property
    def pusher_friction(self) -> Estimate:
        """Friction coefficient between pusher and object."""
        value, own = self.model.pusher_friction, self.unknowns.slice_of("pusher_friction")
        (variance,) = np.diag(self.covariance)[own]
        return Estimate(value, float(value * self.prior.pusher_friction_std * np.sqrt(variance)))


def prior_posterior(shape: ObjectShape, prior: Prior | None = None) -> ModelPosterior:
    """The posterior of an object that was never pushed: its prior."""
    prior = prior or Prior()
    return ModelPosterior.of_prior(Unknowns(shape, prior, effects=nuisances_of(shape, prior)))


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The best model at one moment of the solve, with the work done until then."""

    __repr__ = short_repr

    n_simulations: int
    """Pushes simulated until then."""
    time_s: float
    cost: float
    model: ObjectModel


@dataclass(frozen=True, slots=True)
class WarmStart:
    """Where a fit ended."""

    __repr__ = short_repr

    name: str
    """Of the start that led there, for a solver with several."""
    x: Float64Array
    """Unknowns of the object and first poses, in the units of the caller's prior."""
    prior: MapPrior | None = None
    """Of the maps; None for a solver that sets none."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One prior that the pushes were explained with."""

    __repr__ = short_repr

    name: str
    log_evidence: float
    """With the prior odds of this prior [nat], up to a constant of the pushes."""
    maps: MapPrior | None
    """What the pushes made of the prior of the maps; None: no maps."""
    probability: float
    """Among the candidates, by evidence and prior odds [-]."""
    on_feet: ModelPosterior | None = None
    """Of a prior with feet, see `supports`; None: the whole base bears the load."""


@dataclass(frozen=True, slots=True)
class Identification:
    """Result of `identify`."""

    def __repr__(self) -> str:
        x, y = 1e3 * self.model.centre_of_friction
        return (
            f"Identification({self.status.name.lower()}, {len(self.model.mass)} cells, centre of friction ({x:.1f}, {y:.1f}) mm, "
            f"{self.method}: {self.n_simulations} simulations in {self.time_s:.2f} s)"
        )

    def _repr_html_(self) -> str:
        """For notebooks: what the pushes determine."""
        from push_ident.identification.summary_table import summary_table

        return summary_table(self)

    method: str
    status: SolveStatus
    posterior: ModelPosterior
    scalar: ObjectModel
    """Equal cells with the friction scale and the pusher friction fitted to the same pushes."""
    uniform: ObjectModel
    """Equal cells with nominal values."""
    cost: float
    """Half the robust sum of squared residuals plus half the squared unknowns."""
    reduced_chi2: float
    """Squared residual per degree of freedom: about 1 where the model fits to within the noise; NaN where the solver has no posterior."""
    n_simulations: int
    time_s: float
    """Of the solve [s]."""
    warm_starts: tuple[WarmStart, ...]
    """Where the fits of the solver ended: starts for the same solver, the same pushes and more."""
    history: tuple[Checkpoint, ...] = ()
    """Every improvement during the solve, the oldest first."""
    candidates: tuple[Candidate, ...] = ()
    """Priors that were compared."""
    explanation: Explanation = field(default_factory=Explanation)
    """How well the fit explains its training pushes, also where `posterior` is the prior because it does not."""

    @property
    def model(self) -> ObjectModel:
        """The mean model of the posterior."""
        return self.posterior.model
