"""The fast gradient of the paper (Song & Boularias 2020, Algorithm 1)."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.fitting.solver import CellByCellSolver
from push_ident.identification.unknowns.mechanics import model_at, unknowns_of_maps
from push_ident.physics.simulation import GRAVITY, Motion
from push_ident.types import CellGrid, Float64Array, SolveStatus


class FastGradient(CellByCellSolver):
    """Raise friction and mass of the cells that the simulation moves too far, lower them where it moves them too little.

    With a rigid object, a lasting contact and an inelastic impact, the gradient of the cells' position error by their friction forces and
    masses is that error itself up to a constant, which the learning rate absorbs: no derivative is simulated. Rates are alpha for the
    friction forces and sqrt(alpha) for the masses. The position error is a vector and the update a number: the component of the error
    along the displacement of the cell. The updates of one pass over all pushes are summed, so that the loss belongs to one model. Nothing
    makes the loss fall, so the best model is kept, and the rate is halved after many passes without a better one.
    """

    name: ClassVar[str] = "fast_gradient"
    rate: ClassVar[float] = 1.0
    """Initial learning rate alpha of the paper, relative to the distance that a cell moves: one simulated 10 % too far gets 10 % more
    friction."""
    least_rate: ClassVar[float] = 1e-3
    """At which the search ends."""
    target: ClassVar[float] = 0.5
    """The paper's loss threshold, as a share of the loss that noise would cause without any model error."""
    floor: ClassVar[float] = 1e-3
    """Smallest friction force and mass of a cell, as a share of the mean."""
    patience: ClassVar[int] = 20
    """Passes without a better point after which the rate is halved and the search returns to the best point."""

    def solve(self, problem: FitProblem, x0: Float64Array, rng: np.random.Generator) -> tuple[Float64Array, SolveStatus]:
        """As `CellByCellSolver.solve`; `STALLED` where the rate became too small, or the next model could not be simulated."""
        unknowns, meter = problem.unknowns, problem.meter
        start = model_at(unknowns, problem.object_unknowns(x0))
        mass = start.mass.copy()
        force = start.friction * start.mass * GRAVITY
        if not np.any(x0):
            force = force * rng.uniform(0.5, 1.5, len(mass))  # "Initialize mu_f randomly"; an earlier result stays as it is
        mean_mass, mean_force = float(mass.mean()), float(force.mean())
        best, best_force, best_mass, waited, rate = np.array(x0), force, mass, 0, self.rate
        while True:
            x = np.array(x0)
            x[: unknowns.size] = unknowns_of_maps(unknowns, mass, force / (GRAVITY * mass), start.pusher_friction)
            motions = problem.simulate(x)
            if meter.offer(x, problem.cost_of(x, motions)):
                best, best_force, best_mass, waited = x, force, mass, 0
            else:
                waited += 1
            if motions[-1].status is SolveStatus.SIMULATION_FAILED:
                return best, SolveStatus.SIMULATION_FAILED if meter.best is None else SolveStatus.STALLED
            passes = [_errors_along_path(problem, motion, push) for push, motion in enumerate(motions)]
            loss, expected = (float(np.mean([p[i] for p in passes])) for i in (1, 2))
            if loss <= self.target * expected:
                return best, SolveStatus.CONVERGED
            if meter.spent:
                return best, SolveStatus.BUDGET_SPENT
            if waited > self.patience:
                force, mass, waited, rate = best_force, best_mass, 0, 0.5 * rate
                if rate < self.least_rate:
                    return best, SolveStatus.STALLED
                continue
            error = np.mean([p[0] for p in passes], axis=0)
            force = np.maximum(force + rate * mean_force * error, self.floor * mean_force)
            mass = np.maximum(mass + np.sqrt(rate) * mean_mass * error, self.floor * mean_mass)


SOLVER = FastGradient()


def _errors_along_path(problem: FitProblem, motion: Motion, push: int) -> tuple[Float64Array, float, float]:
    """Errors of one push.

    Returns:
        Error of each cell along its displacement, relative to that displacement; mean distance of the cells [m]; and the distance that
        noise would cause [m].
    """
    observation = problem.observations[push]
    cells: CellGrid = problem.unknowns.shape.cells
    first = transform_points(motion.pose[0], cells.centres)
    along, travel, distance = np.zeros(len(cells)), 1e-3, 0.0
    for simulated, observed in zip(motion.pose[1:], observation.pose[1:], strict=True):
        centres = transform_points(simulated, cells.centres)
        moved = centres - first
        length = np.linalg.norm(moved, axis=1)
        error = centres - transform_points(observed, cells.centres)
        along += np.sum(error * moved, axis=1) / np.maximum(length, 1e-9)
        travel += float(length.mean())
        distance += float(np.linalg.norm(error, axis=1).mean())
    covariance = np.linalg.inv(np.einsum("fji,fjk->fik", observation.whitening[1:], observation.whitening[1:]))
    spread = np.mean(np.sum((cells.centres - cells.centres.mean(axis=0)) ** 2, axis=1))
    expected = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1] + spread * covariance[:, 2, 2]).mean()
    return along / travel, distance / (len(motion.pose) - 1), float(expected)
