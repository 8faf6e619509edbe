"""Weights of models by how well each predicts pushes that it was not fitted to.

The evidence of a model is how well it predicts all pushes from its prior on: a prior that is a little wrong costs it there what it has long
made good after some pushes. So models are weighed by the pushes that are left out, one at a time (stacking: Yao, Vehtari, Simpson & Gelman,
"Using stacking to average Bayesian predictive distributions", Bayesian Analysis 2018): the weights w maximise

    sum_i log sum_m w_m p(push i | other pushes, m) + sum_m e_m log w_m,       e_m = evidence of m / sum of all

The second sum is a Dirichlet prior, as sure as one push makes: models start with the probabilities that the evidence gives them.

Around a fit, a push adds nearly a quadratic with the slope g_i and the Hessian H_i to the cost, its own unknowns minimised over. Without
it the fit moves by (H - H_i)^-1 g_i, and with Laplace's approximation

    log p(push i | others) = -c_i - 1/2 g_i' (H - H_i)^-1 g_i + 1/2 log |H - H_i| - 1/2 log |H|
"""

from __future__ import annotations

import numpy as np
from scipy.special import softmax

from push_ident.identification.fitting.fit import Fit
from push_ident.types import Float64Array


def left_out_log_densities(fit: Fit) -> Float64Array:
    """Log density of each push under a fit to the others, up to a constant of the push [nat], shape (n_pushes,).

    One simulation per push. Negative infinity where one fails, or where the pushes left leave an unknown open.
    """
    problem, n = fit.problem, fit.problem.unknowns.size
    pushes = []
    hessian = np.diag(problem.unit_prior[:n]) + problem.past.hessian
    for i in range(len(problem.records)):
        terms = problem.evaluate_push(fit.x, i)
        if terms is None:
            return np.full(len(problem.records), -np.inf)
        own, shared = terms.hessian[n:, n:], terms.hessian[:n, n:]
        onto = np.linalg.solve(own, shared.T).T
        pushes.append(
            (
                terms.cost + 0.5 * np.linalg.slogdet(own)[1],
                terms.gradient[:n] - onto @ terms.gradient[n:],
                terms.hessian[:n, :n] - onto @ shared.T,
            )
        )
        hessian += pushes[-1][2]
    log_volume = np.linalg.slogdet(hessian)[1]
    densities = []
    for cost, slope, of_push in pushes:
        sign, of_others = np.linalg.slogdet(hessian - of_push)
        moved = 0.5 * float(slope @ np.linalg.solve(hessian - of_push, slope))
        densities.append(-cost - moved + 0.5 * (of_others - log_volume) if sign > 0 else -np.inf)
    return np.array(densities)


def stacked_weights(log_densities: Float64Array, log_evidence: Float64Array, tolerance: float = 1e-6) -> Float64Array:
    """Weights of models, shape (n_models,), sum 1, from the log densities of left-out pushes, shape (n_pushes, n_models), and the log
    evidence, shape (n_models,) [nat].

    By expectation and maximisation (Dempster, Laird & Rubin 1977), until no weight changes by `tolerance`. A push that no model explains
    counts for none.
    """
    prior = softmax(log_evidence)
    explained = log_densities[np.any(np.isfinite(log_densities), axis=1)]
    weights, change = prior, np.inf
    while change > tolerance:
        with np.errstate(divide="ignore"):
            following = prior + np.sum(softmax(explained + np.log(weights), axis=1), axis=0)
        following /= following.sum()
        change, weights = float(np.max(np.abs(following - weights))), following
    return weights
