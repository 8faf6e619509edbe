"""Contacts that a fit starts with, and that it is freed from.

By outline and poses as they are reported, a pusher may move an object from a distance, or from its inside: an error of camera, tool or
outline opens such a gap of millimetres. A simulation that does not touch has no derivative that would close it, so that the displacement
of the surface (`Observation.shared`) starts at the pusher.

Where a pusher meets a corner, or passes it, a push has more than one such displacement with a minimum of the cost. They belong to that push
alone, so that they are looked for push by push.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from push_ident.geometry.outline import outline_distance
from push_ident.identification.fitting.budget import Budget, Meter
from push_ident.identification.fitting.levenberg_marquardt import minimise_roughly
from push_ident.identification.fitting.problem import FRAME_COST, Evaluation, FitProblem
from push_ident.identification.observing.observation import Observation
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import Float64Array, PushRecord

_CERTAIN: Final = 5.0
"""Standard deviations of a pose by which the object must have moved, and the gap differ from zero [-]."""
_FREEING_STEPS: Final = 15
"""Evaluations from each contact that is tried."""
_GAIN: Final = 1.0
"""Of the cost from which another contact is taken [nat]."""


def in_contact(problem: FitProblem, x: Float64Array) -> tuple[FitProblem, Float64Array]:
    """The problem and unknowns, shape (size,), with contact in each push that moves the object.

    The discrepancy of the contact becomes as large as the gaps are (root mean square). The same where no gap has to be closed, or the
    noise has no such discrepancy.
    """
    noise = problem.noise
    if noise is None or noise.discrepancy_modes == 0:
        return problem, x
    moved = _to_contact(problem)
    size = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    if size == 0.0:
        return problem, x
    contact, position, yaw = noise.discrepancy_factor
    contact = max(contact, contact * size / noise.surface_std(problem.records[0].shape))
    problem, x = problem.with_noise(replace(noise, discrepancy_factor=(contact, position, yaw))), np.array(x)
    for push in np.flatnonzero(np.any(moved != 0.0, axis=1)):
        std = problem.observations[push].surface_std
        x[problem.slice_of_push(int(push))] = _displaced(problem, int(push), -moved[push] / std)
    return problem, x


def freed(problem: FitProblem, x: Float64Array) -> Float64Array:
    """Unknowns, shape (size,), with other contacts in those pushes that are explained worse than noise would be and better with them.

    The same array where there is none.
    """
    if problem.noise is None or problem.noise.discrepancy_modes == 0:
        return x
    better = x
    for push in range(len(problem.records)):
        one = _OnePush(problem, x, push, problem.unknowns)
        before = one.evaluate(x[problem.slice_of_push(push)])
        if before.cost < FRAME_COST * len(before.residual):
            continue
        needed = before.cost - _GAIN
        for start in _contacts(problem, push):
            of_push, end, _ = minimise_roughly(one, start, _FREEING_STEPS, needed_cost=needed)
            if end.cost < needed:
                better, needed = np.array(better), end.cost
                better[problem.slice_of_push(push)] = of_push
    return better


def _contacts(problem: FitProblem, push: int) -> list[Float64Array]:
    """Unknowns of a push with its surface as reported, at the pusher, and displaced along its normal by one and two standard deviations,
    each shape (unknowns_of_push,)."""
    observed = problem.observations[push]
    gap, normal = _gap(problem.records[push], observed)
    return [_displaced(problem, push, n * normal) for n in (0.0, -gap / observed.surface_std, 1.0, -1.0, 2.0, -2.0)]


def _displaced(problem: FitProblem, push: int, surface: Float64Array) -> Float64Array:
    """Unknowns of a push, shape (unknowns_of_push,), whose surface is displaced by `surface` [standard deviations], shape (2,): the object
    that is touched lies elsewhere, and is seen where it was."""
    of_push = np.zeros(problem.unknowns_of_push)
    displacement = problem.observations[push].surface_std * np.append(surface, 0.0)
    of_push[:3], of_push[3:5] = np.linalg.solve(problem.first_scale[push], -displacement), surface
    return of_push


@dataclass(slots=True)
class _OnePush:
    """The cost of one push by its own unknowns, all others given."""

    problem: FitProblem
    x: Float64Array
    """All unknowns, shape (size,)."""
    push: int
    unknowns: UnknownsSpec
    meter: Meter = field(default_factory=lambda: Meter(Budget(max_seconds=None)))

    def evaluate(self, of_push: Float64Array) -> Evaluation:
        """Cost and derivatives at `of_push`, shape (unknowns_of_push,)."""
        x, n = np.array(self.x), self.problem.unknowns.size
        x[self.problem.slice_of_push(self.push)] = of_push
        end = self.problem.evaluate_push(x, self.push)
        if end is None:
            return Evaluation(np.inf, np.zeros(len(of_push)), np.eye(len(of_push)), np.empty((0, 3)))
        return Evaluation(end.cost, end.gradient[n:], end.hessian[n:, n:], end.residual)


def _to_contact(problem: FitProblem) -> Float64Array:
    """Displacements of the simulated object that bring its surface to the pusher which moves it [m], shape (n_pushes, 2); 0 where that is
    noise."""
    moved = np.zeros((len(problem.records), 2))
    for push, (record, observed) in enumerate(zip(problem.records, problem.observations, strict=True)):
        gap, normal = _gap(record, observed)
        if abs(gap) > _CERTAIN * float(np.sqrt(np.max(observed.last_covariance[:2, :2]))):
            moved[push] = gap * normal
    return moved


def _gap(record: PushRecord, observed: Observation) -> tuple[float, Float64Array]:
    """Gap between pusher and object when this begins to move, by poses and outline as reported [m], negative inside, and the outward normal
    of the outline there, table frame, shape (2,). A gap of 0 where no frame of the motion shows when that is."""
    away = np.linalg.norm(np.einsum("fij,fj->fi", observed.whitening, observed.pose - observed.pose[0]), axis=1)
    first = int(np.argmax(away > _CERTAIN))
    begins = float(observed.time[first])
    position = [[np.interp(begins, record.pusher.time, record.pusher.position[:, axis]) for axis in (0, 1)]]
    pose = [[np.interp(begins, record.poses.time, record.poses.pose[:, axis]) for axis in range(3)]]
    step = 1e-5  # [m]
    points = np.array(position) + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    distance = outline_distance(points, np.repeat(pose, len(points), axis=0), record.shape.outline)
    rise = np.array([distance[1] - distance[2], distance[3] - distance[4]])
    gap = float(distance[0]) - record.pusher.radius if 0 < first < len(away) - 1 else 0.0
    return gap, rise / max(float(np.linalg.norm(rise)), 1e-12)
