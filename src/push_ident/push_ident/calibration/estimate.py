"""Where camera and tool stand relative to each other, by least squares over gaps that should be zero.

Gaps have errors of four kinds. Each frame has its own. All frames of a push share one error of their pose, as those of a tracker do. Every
edge of an outline is displaced by its own amount, in all pushes alike, and so is the outline as a whole: only an object that is pushed at
several headings tells that from a camera. How large the first two are, relative to what the poses state, the gaps show themselves
(restricted maximum likelihood, Patterson & Thompson, Biometrika 58, 1971), and what they leave open is averaged over, so that few pushes
give wide intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.calibration.contacts import N_UNKNOWNS, Contacts, Gaps, gaps_of
from push_ident.identification.observing.observation import UNCHECKED, NoiseModel
from push_ident.types import Float64Array

_FACTORS: Final = np.exp(np.linspace(np.log(0.05), np.log(16.0), 27))
"""On stated standard deviations that are tried [-], each 1.25 times the one before."""
_HUBER: Final = 2.5
"""Standard deviations beyond which a frame counts less (Huber 1964): 1 in 80 frames without outliers [-]."""
_DRAWN: Final = 1e-3 / 3.0
"""Standard deviation of the place of an edge of an outline that was measured or drawn [m]: a third of the 1 mm of `contact_tolerance`."""
_FLOOR: Final = NoiseModel().floor_position
"""Standard deviation of a gap that no frame is better than [m]."""
_SMALL: Final = 0.1
"""Step from which on the fit has converged [standard deviations]: what is left adds 1 % to the squared error."""
_ROUNDS: Final = 20
"""Linearizations; three are enough within some millimetres, a camera that is wrong by centimetres needs ten."""
NOTHING: Final = np.array([1.0, 1.0, 1.0, 1.0, 1.0])
"""Prior standard deviations of unknowns of which nothing is known [m, m, rad, m, s]: far larger than any that a push can show."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Errors of a calibration."""

    unknowns: Float64Array
    """Camera x, y [m] and heading [rad], surface [m], clock [s], shape (5,)."""
    covariance: Float64Array
    """Shape (5, 5)."""
    contact_variance: float
    """Of one push: what its gap errs by that more frames do not average out, the median of the pushes [m^2]."""
    converged: bool


@dataclass(frozen=True, slots=True)
class _Rows:
    """The gaps of all pushes, those of each push turned so that their errors are independent."""

    gap: Float64Array
    """Over the standard deviation that a factor of 1 on the errors of frames gives [-], shape (n,)."""
    derivative: Float64Array
    """Of the same by unknowns, the place of the outline and of its edges, shape (n, n_columns)."""
    shared: Float64Array
    """Variance by the error that the push shares, over that of the frames, at factors of 1 [-], shape (n,)."""


def estimate(contacts: Sequence[Contacts], prior_std: Float64Array = NOTHING) -> Estimate:
    """Fit all unknowns to the contacts of pushes of one object, at least one.

    `prior_std`: standard deviations of the unknowns about 0, shape (5,).
    """
    unknowns = np.zeros(N_UNKNOWNS)
    for number in range(_ROUNDS):
        gaps = [gaps_of(one, unknowns) for one in contacts]
        edges, outline_std = _outline(contacts, gaps)
        precision = 1.0 / np.concatenate([prior_std, outline_std]) ** 2
        pull = -precision * np.concatenate([unknowns, np.zeros(len(outline_std))])
        step, covariance, shared = _averaged(_rows(contacts, gaps, edges), precision, pull)
        # Where two edges take turns as the nearest one, whole steps would, too.
        unknowns = unknowns + (1.0 if number < _ROUNDS // 2 else 0.5) * step[:N_UNKNOWNS]
        if converged := bool(np.all(np.abs(step[:N_UNKNOWNS]) < _SMALL * np.sqrt(np.diag(covariance)[:N_UNKNOWNS]))):
            break
    of_pushes = [
        np.median(np.einsum("ni,ij,nj->n", one.by_pose, push.shared_covariance, one.by_pose))
        for push, one in zip(contacts, gaps, strict=True)
    ]
    of_push = shared**2 * float(np.median(of_pushes)) + float(np.median(outline_std**2))
    return Estimate(unknowns, covariance[:N_UNKNOWNS, :N_UNKNOWNS], of_push, converged)


def _outline(contacts: Sequence[Contacts], gaps: Sequence[Gaps]) -> tuple[list[int], Float64Array]:
    """Edges of the outline that tools touch, and standard deviations of the place of the whole, along x and y, and of each of them [m]."""
    shape = contacts[0].record.shape
    touched = np.unique(np.concatenate([one.edge for one in gaps]))
    of_edges = np.full(len(touched), _DRAWN) if shape.outline_std is None else shape.outline_std[touched]
    whole = shape.outline_error or _DRAWN
    return touched.tolist(), np.concatenate([[whole, whole], of_edges])


def _rows(contacts: Sequence[Contacts], gaps: Sequence[Gaps], edges: Sequence[int]) -> _Rows:
    variances = [
        np.einsum("ni,nij,nj->n", one.by_pose, push.covariance, one.by_pose) + _FLOOR**2 for push, one in zip(contacts, gaps, strict=True)
    ]
    apart = [(one.gap - np.median(one.gap)) / np.sqrt(variance) for one, variance in zip(gaps, variances, strict=True)]
    several = [values for values in apart if len(values) > 2]
    scale = _HUBER * max(1.4826 * float(np.median(np.abs(np.concatenate(several)))), 1e-6) if several else np.inf
    gap, derivative, shared = [], [], []
    for push, one, variance, values in zip(contacts, gaps, variances, apart, strict=True):
        std = np.sqrt(variance) * np.maximum(1.0, np.abs(values) / scale)
        of_edges = -np.equal.outer(one.edge, np.array(edges, dtype=np.intp)).astype(np.float64)
        together = one.by_pose @ push.shared_covariance @ one.by_pose.T / np.outer(std, std)
        size, turn = np.linalg.eigh(together)
        gap.append(turn.T @ (one.gap / std))
        derivative.append(turn.T @ (np.hstack([one.by_unknown, -one.normal, of_edges]) / std[:, None]))
        shared.append(np.maximum(size, 0.0))
    return _Rows(np.concatenate(gap), np.vstack(derivative), np.concatenate(shared))


def _averaged(rows: _Rows, precision: Float64Array, pull: Float64Array) -> tuple[Float64Array, Float64Array, float]:
    """Step of the columns and its covariance, averaged over the factors on the stated errors, and the factor on those that a push shares.

    `precision` and `pull`: of the prior, and its product with the distance of the prior's middle, both shape (n_columns,).
    """
    n = len(precision)
    frame, shared = (factor.ravel() for factor in np.meshgrid(_FACTORS, _FACTORS))
    variance = np.multiply.outer(frame**2, np.ones(len(rows.gap))) + np.multiply.outer(shared**2, rows.shared)
    squares = (rows.derivative[:, :, None] * rows.derivative[:, None, :]).reshape(-1, n * n)
    information = (1.0 / variance @ squares).reshape(-1, n, n) + np.diag(precision)
    right = pull - (rows.gap / variance) @ rows.derivative
    covariance = np.linalg.inv(information)
    step = np.einsum("gij,gj->gi", covariance, right)
    misfit = np.sum(np.log(variance) + rows.gap**2 / variance, axis=1) - np.sum(right * step, axis=1) + np.linalg.slogdet(information)[1]
    prior = (np.log(frame) ** 2 + np.log(shared) ** 2) / np.log(UNCHECKED) ** 2
    weight = np.exp(-0.5 * (misfit + prior - np.min(misfit + prior)))
    weight /= np.sum(weight)
    mean = weight @ step
    apart = step - mean
    mixed = np.einsum("g,gij->ij", weight, covariance) + np.einsum("g,gi,gj->ij", weight, apart, apart)
    return mean, mixed, float(weight @ shared)
