"""Belief of a planner about an object: the most probable mechanics, and samples of the posterior.

Fitted effects are part of it as far as they change where a push ends: pushes are planned from rest to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.mechanics import Mechanics, mechanics_at, model_at
from push_ident.physics.batch import BatchModel
from push_ident.physics.effect import OnPusherPath, OnTable
from push_ident.physics.effect_values import EffectsLike, EffectValues, effect_values, reported_poses
from push_ident.physics.simulation import SimulationSettings, body_of_cells
from push_ident.physics.tape import N_BODY_PARAMETERS
from push_ident.types import Float64Array, ObjectModel, ObjectShape


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Mechanics with their uncertainty, in the frame of the arm."""

    mean: Mechanics
    """Most probable mechanics, without the errors of the camera and effects that vanish at rest."""
    posterior: ModelPosterior | None
    """Distribution of the models; None where the mean is certain."""
    camera: Float64Array = field(default_factory=lambda: np.zeros(3))
    """The table frame of the arm in that of the camera (x, y, yaw), shape (3,), as estimated from the pushes."""
    weight: Float64Array = field(default_factory=lambda: np.empty(0))
    """Of each cell as a share of the whole, shape (n_cells,), in the most probable model."""
    numerics: SimulationSettings = field(default_factory=SimulationSettings)
    """The law of friction that pushes are simulated with: its smoothing speed, and whether there is inertia."""

    @classmethod
    def of(cls, posterior: ModelPosterior, numerics: SimulationSettings | None = None) -> Belief:
        """From the posterior of a fit with `numerics`."""
        mechanics = posterior.mean_mechanics
        camera = reported_poses(mechanics.effects, np.zeros((1, 3)))[0][0]
        weight = _share(posterior.model)
        return cls(replace(mechanics, effects=mechanics.effects.at_rest), posterior, camera, weight, numerics or SimulationSettings())

    @classmethod
    def certain(cls, model: ObjectModel, effects: EffectsLike | None = None) -> Belief:
        """A model that is known to be true, with the effects that act on its motion."""
        body = body_of_cells(model.shape, model.mass, model.friction)
        acting = effect_values(effects)
        derivative = np.zeros((N_BODY_PARAMETERS + len(model.shape.cells) + len(acting), 0))
        mean = Mechanics(model.shape, body, model.pusher_friction, acting.at_rest, derivative)
        return cls(mean, None, reported_poses(acting, np.zeros((1, 3)))[0][0], _share(model))

    @property
    def shape(self) -> ObjectShape:
        """Of the object."""
        return self.mean.shape

    @property
    def depends_on_pose(self) -> bool:
        """Whether the motion by a push depends on the pose of the object in the table frame."""
        acts = (effect.acts for effect in self.mean.effects.effects)
        return any(isinstance(acting, OnTable | OnPusherPath) for acting in acts)

    def models(self, n: int, rng: np.random.Generator) -> list[BatchModel]:
        """The mean, then `n` samples of the posterior; only the mean where that is certain."""
        drawn, surface, weights = [self.mean], np.zeros(1 + n), [self.weight]
        if self.posterior is not None:
            # Each push touches another part of the outline.
            surface[1:] = NoiseModel().surface_std(self.shape) * rng.normal(size=n)
            others = self.posterior.drawn(rng.normal(size=(n, self.posterior.most_unknowns)))
            drawn += [mechanics_at(part.unknowns, z) for part, z in others]
            weights += [_share(model_at(part.unknowns, z)) for part, z in others]
        return [
            BatchModel(one.body, one.pusher_friction, _surface(one.effects) + offset, weight, effects=one.effects.at_rest.beside_outline)
            for one, offset, weight in zip(drawn, surface, weights, strict=False)
        ]


def _share(model: ObjectModel) -> Float64Array:
    return np.asarray(model.mass / model.total_mass)


def _surface(effects: EffectValues) -> float:
    """Distance of the surface outside the outline [m]."""
    return float(sum(np.sum(effects.values[effects.slice_of(effect.name)]) for effect in effects.effects if effect.moves_outline))
