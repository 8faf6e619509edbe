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
    weight: Float64Array = field(default_factory=lambda: np.empty(0))
    """Of each cell as a share of the whole, shape (n_cells,), in the most probable model."""

    @classmethod
    def of(cls, posterior: ModelPosterior) -> Belief:
        """What pushes have shown."""
        mechanics = posterior.unknowns.mechanics(posterior.z)
        camera = reported_poses(mechanics.effects, np.zeros((1, 3)))[0][0]
        weight = _share(posterior.unknowns.model(posterior.z))
        return cls(replace(mechanics, effects=mechanics.effects.of_motion), posterior, camera, weight)

    @classmethod
    def certain(cls, model: ObjectModel) -> Belief:
        """A model that is known to be true."""
        body = body_of_cells(model.shape, model.mass, model.friction)
        derivative = np.zeros((N_BODY_PARAMETERS + len(model.shape.cells), 0))
        return cls(Mechanics(model.shape, body, model.pusher_friction, effect_values(None), derivative), None, weight=_share(model))

    @property
    def shape(self) -> ObjectShape:
        """Of the object."""
        return self.mean.shape

    def models(self, n: int, rng: np.random.Generator) -> list[BatchModel]:
        """The mean, then `n` models drawn at random: those that are equally likely to be true. None but the mean where that is certain."""
        drawn, surface, weights = [self.mean], np.zeros(1 + n), [self.weight]
        if self.posterior is not None:
            # Each push touches another part of the outline.
            surface[1:] = NoiseModel().surface_std(self.shape) * rng.normal(size=n)
            value, vector = np.linalg.eigh(self.posterior.covariance)
            root = vector * np.sqrt(np.maximum(value, 0.0))
            unknowns, z = self.posterior.unknowns, self.posterior.z
            others = [z + root @ draw for draw in rng.normal(size=(n, len(z)))]
            drawn += [unknowns.mechanics(other) for other in others]
            weights += [_share(unknowns.model(other)) for other in others]
        return [
            BatchModel(own.body, own.pusher_friction, _surface(own.effects) + beside, weight)
            for own, beside, weight in zip(drawn, surface, weights, strict=False)
        ]


def _share(model: ObjectModel) -> Float64Array:
    return np.asarray(model.mass / model.total_mass)


def _surface(effects: EffectValues) -> float:
    """How far the surface lies outside the outline [m]."""
    return float(sum(np.sum(effects.values[effects.slice_of(effect.name)]) for effect in effects.effects if effect.moves_outline))
