"""What a change since a reference gains by chance: a permutation test of the evidence.

If nothing has changed, it does not matter which pushes are those of the reference. Pushes differ from the model in ways that depend on
where and how they push, so that some change fits any half of them. What an effect gains where as many pushes, drawn at random from both
recordings, are called the changed ones, is what it gains for no reason (Fisher, "The Design of Experiments", 1935; Good, "Permutation,
Parametric, and Bootstrap Tests of Hypotheses", 2005). It is computed as the scores are (`scores.py`), in the linear range of one fit:

    1/2 g' (S + 1)^-1 g - 1/2 log det (S + 1),    S = sum G_k - D' D,    D = sum D_k,    g = sum g_k     over the pushes that are drawn

with the derivatives C_k of push k by the parameters of the effect, and of all pushes F by everything fitted, G_k = C_k' C_k,
D_k = L^-1 F_k' C_k for the root L of the Hessian of everything fitted, and g_k = C_k' r_k for the residuals r that the fit leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.problem import FitProblem, Linearisation
from push_ident.physics.effect_values import effect_values
from push_ident.physics.effects import CAUSES, FORCE_CAUSES
from push_ident.types import Float64Array


def gains_by_chance(fit: Fit, policy: SelectionPolicy) -> dict[str, float]:
    """Log Bayes factor of each change that the fit does not have, which a share `chance_quantile` of relabellings does not exceed [nat], at
    least 0; none without a reference, or where a push cannot be simulated or is unstable."""
    before, n_reference = fit.unknowns, fit.problem.n_reference
    if before.shared is None or n_reference == 0:
        return {}
    visible = (*CAUSES, *FORCE_CAUSES) if fit.problem.uses_forces else CAUSES
    shared = effect_values((*before.shared.names, *(name for name in visible if name not in before.shared.names)))
    problem = fit.problem.of(replace(before, shared=shared))
    first = problem.unknowns.slices["shared_effects"].start
    n_known, n_new = len(before.shared), len(shared) - len(before.shared)
    x = np.insert(fit.x, first + n_known, np.zeros(n_new))
    linear = problem.linearise(x)
    if linear is None:
        return {}
    fitted = np.delete(np.arange(problem.size), first + n_known + np.arange(n_new))
    rng, n_pushes = np.random.default_rng(0), len(problem.records)
    drawn = [rng.choice(n_pushes, problem.n_pushes, replace=False) for _ in range(policy.relabellings)]
    columns = {name: np.r_[shared.slice_of(name)] for name in visible if name not in before.effects.names}
    try:
        pushes = _Pushes.of(problem, x, linear, fitted, first + np.arange(len(shared)))
        gains = {name: [pushes.gain(push, index) for push in drawn] for name, index in columns.items()}
    except np.linalg.LinAlgError:  # an unstable push, beside whose Hessian rounding hides all others
        return {}
    return {name: max(0.0, float(np.quantile(values, policy.chance_quantile))) for name, values in gains.items()}


@dataclass(frozen=True, slots=True)
class _Pushes:
    """What each push says of effects that act on it."""

    information: Float64Array
    """G_k, shape (n_pushes, n, n)."""
    onto_fitted: Float64Array
    """D_k, shape (n_pushes, n_fitted, n)."""
    slope: Float64Array
    """g_k, shape (n_pushes, n)."""

    @classmethod
    def of(
        cls, problem: FitProblem, x: Float64Array, linear: Linearisation, fitted: NDArray[np.intp], effects: NDArray[np.intp]
    ) -> _Pushes:
        """Of all pushes, linear at `x`, shape (size,); `fitted`, `effects`: places of what was fitted and of the effects."""
        residuals = (*linear.poses, *linear.forces)
        weight = np.concatenate([np.repeat(np.sqrt(problem.frame_weight(residual)), residual.shape[1]) for residual in residuals])
        jacobian = weight[:, None] * np.concatenate([linear.by_poses, linear.by_forces])
        observed = -weight * np.concatenate([residual.ravel() for residual in residuals])
        by_fitted, by_effects = jacobian[:, fitted], jacobian[:, effects]
        _, slope, hessian = problem.prior_at(x)
        root = np.linalg.cholesky(by_fitted.T @ by_fitted + hessian[np.ix_(fitted, fitted)])
        step = np.linalg.solve(root @ root.T, by_fitted.T @ observed - slope[fitted])
        left, onto = observed - by_fitted @ step, solve_triangular(root, by_fitted.T, lower=True)
        ends = np.cumsum([0, *(residual.size for residual in residuals)])
        parts = [np.r_[a:b] for a, b in pairwise(ends)]
        n = len(linear.poses)
        rows = [np.r_[of_poses, of_forces] for of_poses, of_forces in zip(parts[:n], parts[n:], strict=True)]
        return cls(
            np.array([by_effects[row].T @ by_effects[row] for row in rows]),
            np.array([onto[:, row] @ by_effects[row] for row in rows]),
            np.array([by_effects[row].T @ left[row] for row in rows]),
        )

    def gain(self, pushes: NDArray[np.intp], effect: NDArray[np.intp]) -> float:
        """Log Bayes factor of an effect, by its columns, that acts on some pushes only [nat]."""
        onto = np.sum(self.onto_fitted[pushes][:, :, effect], axis=0)
        information = np.sum(self.information[pushes][:, effect][:, :, effect], axis=0) - onto.T @ onto + np.eye(len(effect))
        slope = np.sum(self.slope[pushes][:, effect], axis=0)
        return 0.5 * float(slope @ np.linalg.solve(information, slope)) - 0.5 * float(np.linalg.slogdet(information)[1])
