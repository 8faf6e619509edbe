"""Second stage: the base model, fitted to all pushes without any absent effect, and whether its numerics can be trusted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from push_ident.diagnosis.fits import fit_base
from push_ident.diagnosis.policy import GatePolicy
from push_ident.diagnosis.residuals import correlation_in_motion
from push_ident.diagnosis.result import Gate
from push_ident.diagnosis.state import DiagnosisState
from push_ident.identification.evidence import explain
from push_ident.identification.fit import Fit
from push_ident.types import SolveStatus

__all__ = ["check_fit", "fit_base_model"]

Progress = Callable[[str], None]


def fit_base_model(state: DiagnosisState, on_progress: Progress) -> DiagnosisState:
    """The stage: the base fit and its gates.

    Where frames at rest do not show how the errors of the poses are correlated, the residuals of the motions do, and the fit is repeated.
    """
    if state.abstains:
        return state
    on_progress("fitting the base model")
    settings = state.settings
    base = fit_base(state.records, settings)
    if not state.rest_noise_known:
        correlation = correlation_in_motion(base, settings.policy.residuals)
        if correlation > settings.noise.correlation:
            base = fit_base(state.records, replace(settings, noise=replace(settings.noise, correlation=correlation)))
    return replace(state, base=base, selection=None, fit_gates=tuple(check_fit(base, settings.policy.gates)))


def check_fit(fit: Fit, policy: GatePolicy) -> list[Gate]:
    """Gates of the base fit: convergence, pushes that are possible, and end poses under half the time steps and smoothing speed."""
    problem = fit.problem
    contradiction = explain(fit.posterior, problem.records, settings=problem.settings).contradiction
    change = float(np.median(problem.step_errors(fit.x)))
    impossible = [Gate(False, contradiction, "No effect explains them: correct the recording first.")] if contradiction else []
    return [
        *impossible,
        Gate(
            fit.status in (SolveStatus.CONVERGED, SolveStatus.STALLED),
            f"the fit of the base model ended with status {fit.status.name.lower()}",
            "Look at the pushes with the largest residuals; poses may have jumped.",
        ),
        Gate(
            change < policy.max_step_effect,
            f"half the time steps move the end poses by {change:.1f} standard deviations of their noise",
            "The motion does not settle with shorter steps, as behind a jerky path of the pusher: smooth the paths, or push more slowly.",
        ),
    ]
