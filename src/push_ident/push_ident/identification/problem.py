"""The fit as one problem: residuals of all pushes and their Jacobian, metered.

Unknowns x = (z, first pose of push 1, first pose of push 2, ...): the first pose of a push is uncertain too, so it is fitted with
the maps, started from the mean of the rest frames. All unknowns are scaled to unit prior, so that the cost is

    1/2 sum_frames rho(|W (y - f(x))|^2) + 1/2 |z|^2,      rho: quadratic up to `outlier`, then linear (Huber)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.observation import NoiseModel, Observation, observe_push
from push_ident.identification.parameters import MapParameters
from push_ident.physics.rollout import PARAM_MASS
from push_ident.physics.simulation import SimulationSettings, simulate_body
from push_ident.types import Float64Array, PushRecord, SolveStatus

__all__ = ["Evaluation", "FitProblem"]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Cost and its first derivatives at one point."""

    cost: float
    """Half the robust sum of squares plus half the squared unknowns; infinite where a simulation failed."""
    gradient: Float64Array
    """Shape (n_unknowns,)."""
    hessian: Float64Array
    """Gauss-Newton approximation, prior included, shape (n_unknowns, n_unknowns)."""
    residual: Float64Array
    """Whitened, shape (n_frames of all pushes, 3)."""


class FitProblem:
    """Pushes of one object as a least-squares problem.

    Args:
        records: pushes of one object; all with the same cells.
        parameters: the unknowns of the object.
        noise: of the observations.
        settings: numerics of the simulation.
        outlier: whitened distance of a frame beyond which it counts less.

    Raises:
        InputError: no push, or pushes of objects with different cells.
    """

    def __init__(
        self,
        records: Sequence[PushRecord],
        parameters: MapParameters,
        *,
        noise: NoiseModel | None = None,
        settings: SimulationSettings | None = None,
        outlier: float = 4.0,
    ) -> None:
        if not records:
            raise InputError("There is no push to learn from; give at least one push record.")
        n_cells = len(parameters.shape.cells)
        for record in records:
            if len(record.shape.cells) != n_cells:
                raise InputError(f"{record.source or 'A push'} has {len(record.shape.cells)} cells, expected {n_cells} as the others.")
        self.records = list(records)
        self.parameters = parameters
        self.observations: list[Observation] = [observe_push(record, noise) for record in records]
        self._settings = settings or SimulationSettings()
        self._outlier = outlier
        self._first_scale = [np.linalg.cholesky(o.first_covariance) for o in self.observations]
        self.n_simulations = 0

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.parameters.size + 3 * len(self.records)

    def first_pose(self, x: Float64Array, push: int) -> Float64Array:
        """First pose of a push, table frame, shape (3,)."""
        start = self.parameters.size + 3 * push
        return self.observations[push].pose[0] + self._first_scale[push] @ x[start : start + 3]

    def evaluate(self, x: Float64Array) -> Evaluation:
        """Simulate all pushes at `x`, shape (size,). One simulation a push, with its derivative."""
        n_z = self.parameters.size
        z = x[:n_z]
        body, pusher_friction, d_body = self.parameters.body(z)
        cost = 0.5 * float(z @ z)
        gradient = np.zeros(self.size)
        hessian = np.zeros((self.size, self.size))
        gradient[:n_z] = z
        hessian[np.arange(n_z), np.arange(n_z)] = 1.0
        residuals = []
        for push, (record, seen) in enumerate(zip(self.records, self.observations, strict=True)):
            motion = simulate_body(
                record.shape,
                body,
                pusher_friction,
                record.pusher,
                self.first_pose(x, push),
                seen.time,
                settings=self._settings,
                jacobian=True,
            )
            self.n_simulations += 1
            if motion.status is SolveStatus.SIMULATION_FAILED:
                return Evaluation(np.inf, gradient, hessian, np.empty((0, 3)))
            residual = np.einsum("fij,fj->fi", seen.whitening, motion.pose - seen.pose)
            size2 = np.sum(residual**2, axis=1)
            weight = np.minimum(1.0, self._outlier / np.sqrt(np.maximum(size2, 1e-300)))
            cost += 0.5 * float(np.sum(np.where(weight < 1.0, self._outlier * (2 * np.sqrt(size2) - self._outlier), size2)))
            whitened = np.einsum("fij,fjp->fip", seen.whitening, motion.jacobian)
            # Columns: first pose (scaled), then the body chained to z.
            own = whitened[:, :, :3] @ self._first_scale[push]
            shared = whitened[:, :, PARAM_MASS:] @ d_body[PARAM_MASS:]
            jacobian = np.concatenate([shared, own], axis=2)
            columns = np.r_[0:n_z, n_z + 3 * push : n_z + 3 * push + 3]
            weighted = (jacobian * weight[:, None, None]).reshape(-1, jacobian.shape[2])
            gradient[columns] += weighted.T @ residual.ravel()
            hessian[np.ix_(columns, columns)] += weighted.T @ jacobian.reshape(-1, jacobian.shape[2])
            residuals.append(residual)
        return Evaluation(cost, gradient, hessian, np.concatenate(residuals))
