"""Settings of a diagnosis: the base model, and the policy that decides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from push_ident.diagnosis.policy import DecisionPolicy
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.simulation import SimulationSettings

Progress = Callable[[str], None]
"""Called with what is under way."""


@dataclass(frozen=True, slots=True)
class DiagnosisSettings:
    """How a diagnosis is made. The base model has the nominal pusher friction: another value is an effect."""

    prior: Prior = field(default_factory=Prior)
    """Of the maps and the scales."""
    noise: NoiseModel = field(default_factory=lambda: NoiseModel(discrepancy_modes=6, max_moving_frames=30, single_frame_inflation=1.0))
    """Of the poses. Where no rest checks what single frames claim, the pushes do, by the size of the errors of frames. The model
    discrepancy is calibrated on effect-free pushes, which it brings to a reduced chi-square of about 1. Thirty frames of a motion, not
    ten, double the information about lag and latency at no measurable cost."""
    numerics: SimulationSettings = field(default_factory=SimulationSettings)
    """Of the simulation."""
    policy: DecisionPolicy = field(default_factory=DecisionPolicy)
    """Every number that decides."""
    base_effects: tuple[str, ...] = ()
    """Effects that belong to the base model."""
    effect_std: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Prior standard deviations of the parameters of effects, by name, where they are not those of the catalogue."""
    max_modes: int = 16
    """Of each map: with more, the maps absorb effects, and predictions are no better (prototype)."""
    outline_from_camera: bool = False
    """Whether poses and outline come from a camera, even where the shape does not state it: errors of a calibrated camera then belong to
    the base model."""
