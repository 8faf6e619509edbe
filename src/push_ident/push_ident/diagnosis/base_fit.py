"""Second stage: the base model, fitted to all pushes without any absent effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from push_ident.diagnosis.fits import fit_base
from push_ident.diagnosis.gates import check_fit
from push_ident.diagnosis.residuals import correlation_in_motion
from push_ident.diagnosis.state import DiagnosisState

__all__ = ["fit_base_model"]

Progress = Callable[[str], None]


def fit_base_model(state: DiagnosisState, on_progress: Progress) -> DiagnosisState:
    """The stage: the base fit and its gates.

    Where frames at rest do not show how the errors of the poses are correlated, the residuals of the motions do, and the fit is repeated.
    """
    on_progress("fitting the base model")
    settings = state.settings
    base = fit_base(state.records, settings)
    if not state.rest_noise_known:
        correlation = correlation_in_motion(base, settings.policy.residuals)
        if correlation > settings.noise.correlation:
            base = fit_base(state.records, replace(settings, noise=replace(settings.noise, correlation=correlation)))
    return replace(state, base=base, selection=None, fit_gates=tuple(check_fit(base, settings.policy.gates)))
