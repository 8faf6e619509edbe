"""What a diagnosis takes for granted."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from push_ident.identification.observation import NoiseModel
from push_ident.identification.prior import Prior
from push_ident.physics.simulation import SimulationSettings

__all__ = ["DiagnosisSettings", "Thresholds"]

_N_MODES = 16
"""Of each map: more absorb effects and predict no better."""


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Differences of log evidence that decide [nat]."""

    seen: float = 5.0
    """An effect that gains less is not there as far as these data go."""
    also: float = 12.0
    """The same of an effect beside another one: the law of the first may not be quite that of the world."""
    also_share: float = 0.1
    """And so much of what was gained by effects before it whose law is a guess: what a law is off by grows with the effect."""
    apart: float = 6.0
    """Effects nearer than this to the best cannot be told from it."""
    apart_share: float = 0.1
    """Nor those whose law is a guess and that are nearer than this share of its gain."""
    sure: float = 12.0
    """An effect that gains less is named with its runners-up only."""
    unknown: float = 10.0
    """A smooth wrench must gain so much before the cause counts as unknown, and more than one effect that was named by `apart`; several
    effects must gain more than the wrench by as much, or it counts as unknown, too."""
    leftover: float = 1.1
    """Mean square of the residuals beside all that was named, over that of a model that is right, from which something else is there."""
    leftover_share: float = 0.03
    """And so much of what the base model leaves beyond a model that is right: what a law is off by grows with the effect."""
    lasting: float = 0.12
    """So much of it that lasts from frame to frame, from which something else is there, too: noise does not last."""
    lasting_share: float = 0.02
    """And so much of what the base model leaves beyond a model that is right."""
    alone: float = -1.0
    """An effect that gains less than this without one of the pushes is not believed: that push alone speaks for it."""
    most: float = 0.8
    """Where what was named gains this share of what a smooth wrench gains, the wrench is not needed."""
    trifles: dict[str, float] = field(default_factory=lambda: {"s": 2e-3, "m": 1e-4, "rad": 1e-3, "": 1e-3})
    """What moves what is driven or measured by less than this, by its unit, is not told, however well it is seen: no clock, no surface and
    no scale of a cell is known better, and engines that are both right differ by as much (their time steps and contacts)."""
    n_effects: int = 3
    """At most so many are added."""
    n_refits: int = 5
    """The best so many by their score are refitted."""


@dataclass(frozen=True, slots=True)
class DiagnosisSettings:
    """How a diagnosis is made. The base model has the nominal friction of the pusher: if it is not that, this is an effect too."""

    prior: Prior = field(default_factory=Prior)
    noise: NoiseModel = field(
        default_factory=lambda: NoiseModel(fit_discrepancy_position=0.008, fit_discrepancy_yaw=0.08, max_moving_frames=30)
    )
    numerics: SimulationSettings = field(default_factory=SimulationSettings)
    thresholds: Thresholds = field(default_factory=Thresholds)
    base_effects: tuple[str, ...] = ()
    """Effects that belong to the base model."""
    effect_std: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Prior standard deviations of the parameters of effects, by name, where they are not those of the catalogue."""
    outline_is_seen: bool = False
    """Whether a camera traced the outline, even where the shape does not say so: how far the surface is from it is then fitted with the
    base model."""

    @property
    def base_prior(self) -> Prior:
        """Smooth maps, and the friction of the pusher given."""
        return replace(self.prior, max_modes=min(self.prior.max_modes, _N_MODES)).with_pusher_friction_frozen()
