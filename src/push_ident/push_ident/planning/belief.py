"""What a planner believes of an object: the most probable mechanics, and others that may be true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.identification.result import ModelPosterior
from push_ident.identification.unknowns import Mechanics
from push_ident.physics.batch import BatchModel
from push_ident.physics.effect_values import effect_values
from push_ident.physics.simulation import body_of_cells
from push_ident.physics.tape import N_BODY_PARAMETERS
from push_ident.types import ObjectModel, ObjectShape

__all__ = ["Belief"]


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Mechanics with their uncertainty."""

    mean: Mechanics
    posterior: ModelPosterior | None
    """Where other models are drawn from; None where the mean is certain."""

    @classmethod
    def of(cls, posterior: ModelPosterior) -> Belief:
        """What pushes have shown."""
        return cls(posterior.unknowns.mechanics(posterior.z), posterior)

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
        drawn = [self.mean]
        if self.posterior is not None:
            value, vector = np.linalg.eigh(self.posterior.covariance)
            root = vector * np.sqrt(np.maximum(value, 0.0))
            unknowns, z = self.posterior.unknowns, self.posterior.z
            drawn += [unknowns.mechanics(z + root @ draw) for draw in rng.normal(size=(n, len(z)))]
        return [BatchModel(own.body, own.pusher_friction) for own in drawn]
