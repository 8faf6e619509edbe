"""What a planner believes of an object: the most probable mechanics, and others that may be true."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from push_ident.identification.observation import NoiseModel
from push_ident.identification.result import ModelPosterior
from push_ident.identification.unknowns import Mechanics
from push_ident.physics.batch import BatchModel
from push_ident.physics.effect_values import EffectValues, effect_values, reported_poses
from push_ident.physics.simulation import body_of_cells
from push_ident.physics.tape import N_BODY_PARAMETERS
from push_ident.types import Float64Array, ObjectModel, ObjectShape

__all__ = ["Belief"]


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Mechanics with their uncertainty, in the frame of the arm."""

    mean: Mechanics
    """Without the errors of the camera."""
    posterior: ModelPosterior | None
    """Where other models are drawn from; None where the mean is certain."""
    camera: Float64Array = field(default_factory=lambda: np.zeros(3))
    """The table frame of the arm in that of the camera (x, y, yaw), shape (3,), as the pushes have shown it."""

    @classmethod
    def of(cls, posterior: ModelPosterior) -> Belief:
        """What pushes have shown."""
        mechanics = posterior.unknowns.mechanics(posterior.z)
        camera = reported_poses(mechanics.effects, np.zeros((1, 3)))[0][0]
        return cls(replace(mechanics, effects=mechanics.effects.of_motion), posterior, camera)

    @classmethod
    def certain(cls, model: ObjectModel) -> Belief:
        """A model that is known to be true."""
        body = body_of_cells(model.shape, model.mass, model.friction)
        derivative = np.zeros((N_BODY_PARAMETERS + len(model.shape.cells), 0))
        return cls(Mechanics(model.shape, body, model.pusher_friction, effect_values(None), derivative), None)

    @property
    def shape(self) -> ObjectShape:
        """Of the object."""
        return self.mean.shape

    def models(self, n: int, rng: np.random.Generator) -> list[BatchModel]:
        """The mean, then `n` models drawn at random: those that are equally likely to be true. None but the mean where that is certain."""
        drawn, surface = [self.mean], np.zeros(1 + n)
        if self.posterior is not None:
            # Each push touches another part of the outline.
            surface[1:] = NoiseModel().surface_std(self.shape) * rng.normal(size=n)
            value, vector = np.linalg.eigh(self.posterior.covariance)
            root = vector * np.sqrt(np.maximum(value, 0.0))
            unknowns, z = self.posterior.unknowns, self.posterior.z
            drawn += [unknowns.mechanics(z + root @ draw) for draw in rng.normal(size=(n, len(z)))]
        return [
            BatchModel(own.body, own.pusher_friction, _surface(own.effects) + beside) for own, beside in zip(drawn, surface, strict=False)
        ]


def _surface(effects: EffectValues) -> float:
    """How far the surface lies outside the outline [m]."""
    return float(sum(np.sum(effects.values[effects.slice_of(effect.name)]) for effect in effects.effects if effect.moves_outline))
