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
        observed, own = problem.observations[push], problem.slice_of_push(int(push)).start
        x[own : own + 3] = np.linalg.solve(problem.first_scale[push], np.append(moved[push], 0.0))
        x[own + 3 : own + 5] = -moved[push] / observed.surface_std
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
        ends = [minimise_roughly(one, start, _FREEING_STEPS)[:2] for start in _contacts(problem, push)]
        own, end = min(ends, key=lambda found: found[1].cost)
        if end.cost < before.cost - _GAIN:
            better = np.array(better)
            better[problem.slice_of_push(push)] = own
    return better


def _contacts(problem: FitProblem, push: int) -> list[Float64Array]:
    """Unknowns of a push with its surface as reported, at the pusher, and displaced along its normal by one and two standard deviations,
    each shape (n_own,)."""
    observed = problem.observations[push]
    gap, normal = _gap(problem.records[push], observed)
    starts = []
    for deviations in (0.0, -gap / observed.surface_std, 1.0, -1.0, 2.0, -2.0):
        own = np.zeros(problem.unknowns_of_push)
        own[:3] = np.linalg.solve(problem.first_scale[push], -deviations * observed.surface_std * np.append(normal, 0.0))
        own[3:5] = deviations * normal
        starts.append(own)
    return starts


@dataclass(slots=True)
class _OnePush:
    """The cost of one push by its own unknowns, all others given."""

    problem: FitProblem
    x: Float64Array
    """All unknowns, shape (size,)."""
    push: int
    unknowns: UnknownsSpec
    meter: Meter = field(default_factory=lambda: Meter(Budget(max_seconds=None)))

    def evaluate(self, own: Float64Array) -> Evaluation:
        """Cost and derivatives at `own`, shape (n_own,)."""
        x, n = np.array(self.x), self.problem.unknowns.size
        x[self.problem.slice_of_push(self.push)] = own
        end = self.problem.evaluate_push(x, self.push)
        if end is None:
            return Evaluation(np.inf, np.zeros(len(own)), np.eye(len(own)), np.empty((0, 3)))
        return Evaluation(end.cost, end.gradient[n:], end.hessian[n:, n:], end.residual)


def _to_contact(problem: FitProblem) -> Float64Array:
    """Displacements of the simulated object that bring its surface to the pusher which moves it [m], shape (n_pushes, 2); 0 where that is
    noise."""
    moved = np.zeros((len(problem.records), 2))
    for push, (record, observed) in enumerate(zip(problem.records, problem.observations, strict=True)):
        gap, normal = _gap(record, observed)
        deviation = float(np.sqrt(np.max(observed.last_covariance[:2, :2])))
        moves = np.linalg.norm(observed.pose[-1, :2] - observed.pose[0, :2]) > _CERTAIN * deviation
        if moves and abs(gap) > _CERTAIN * deviation:
            moved[push] = gap * normal
    return moved


def _gap(record: PushRecord, observed: Observation) -> tuple[float, Float64Array]:
    """Gap between pusher and object when this begins to move, by poses and outline as reported [m], negative inside, and the outward normal
    of the outline there, table frame, shape (2,)."""
    away = np.linalg.norm(np.einsum("fij,fj->fi", observed.whitening, observed.pose - observed.pose[0]), axis=1)
    begins = min(float(observed.time[int(np.argmax(away > _CERTAIN))]), float(record.pusher.time[-1]))
    position = [[np.interp(begins, record.pusher.time, record.pusher.position[:, axis]) for axis in (0, 1)]]
    pose = [[np.interp(begins, record.poses.time, record.poses.pose[:, axis]) for axis in range(3)]]
    step = 1e-5  # [m]
    points = np.array(position) + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    distance = outline_distance(points, np.repeat(pose, len(points), axis=0), record.shape.outline)
    rise = np.array([distance[1] - distance[2], distance[3] - distance[4]])
    return float(distance[0]) - record.pusher.radius, rise / max(float(np.linalg.norm(rise)), 1e-12)
