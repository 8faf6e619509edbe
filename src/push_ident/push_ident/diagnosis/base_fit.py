"""Second stage: the base model, fitted to all pushes without any absent effect, and whether its numerics can be trusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from push_ident.diagnosis.fits import fit_base, fit_with_reference
from push_ident.diagnosis.policy import GatePolicy
from push_ident.diagnosis.residuals import correlation_in_motion
from push_ident.diagnosis.settings import DiagnosisSettings, Progress
from push_ident.diagnosis.state import DiagnosisState
from push_ident.diagnosis.verdict import Gate
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.results.explanation import explain
from push_ident.types import SolveStatus


def fit_base_model(state: DiagnosisState, on_progress: Progress) -> DiagnosisState:
    """The stage: the base fit and its gates.

    Where frames at rest do not show how the errors of the poses are correlated, the residuals of the motions do, and the fit is repeated.
    So it is where the shortest time steps are still too long for the poses, which then count as less exact than they are.
    """
    if state.abstains:
        return state
    on_progress("fitting the base model")
    settings = state.settings
    policy = settings.policy
    base = _fit(state, settings)
    if not state.rest_noise_known:
        correlation = correlation_in_motion(base, policy.residuals)
        if correlation > settings.noise.correlation:
            base = _fit(state, replace(settings, noise=replace(settings.noise, correlation=correlation)))
    change = step_effect(base)
    noise = noise_above_steps(base, change, policy.gates)
    if noise is not None:
        on_progress("the time steps are less exact than the poses: repeating the fit with poses as exact as the steps")
        base = _fit(state, replace(settings, noise=noise))
        change = step_effect(base)
    return replace(state, base=base, selection=None, fit_gates=tuple(check_fit(base, change, policy.gates)))


def _fit(state: DiagnosisState, settings: DiagnosisSettings) -> Fit:
    if state.reference:
        return fit_with_reference(state.records, state.reference, settings)
    return fit_base(state.records, settings, state.earlier)


def step_effect(fit: Fit) -> float:
    """Median effect of half the time steps and half the smoothing speed on end poses, in standard deviations of their noise [1]."""
    return float(np.median(fit.problem.step_errors(fit.x)))


def noise_above_steps(fit: Fit, change: float, policy: GatePolicy) -> NoiseModel | None:
    """The noise of a fit with so large a floor that half the time steps move end poses by no more than the policy accepts.

    None where they do not move them by more (`change`: `step_effect` of the fit), or where the floor would be larger than the largest.
    """
    problem, noise = fit.problem, fit.problem.noise or NoiseModel()
    excess = (change / policy.max_step_effect) ** 2 - 1.0
    if not 0.0 <= excess < np.inf:
        return None
    variance = np.median([np.diag(observation.last_covariance) for observation in problem.observations], axis=0)
    position, yaw = np.sqrt(np.diag(noise.floor)[[0, 2]] + policy.step_margin * excess * np.array([variance[:2].mean(), variance[2]]))
    if position > policy.max_floor[0] or yaw > policy.max_floor[1]:
        return None
    return replace(noise, floor_position=float(position), floor_yaw=float(yaw))


def check_fit(fit: Fit, change: float, policy: GatePolicy) -> list[Gate]:
    """Gates of the base fit: convergence, pushes that are possible, and end poses under half the time steps (`change` of `step_effect`)."""
    problem = fit.problem
    contradiction = explain(fit.posterior, problem.records, settings=problem.settings).contradiction
    floor = (problem.noise or NoiseModel()).floor_position
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
            f"half the time steps move the end poses by {change:.1f} standard deviations of their noise, which counts as "
            f"{1e3 * floor:.1f} mm at least",
            "The motion does not settle with shorter steps, as behind a jerky path of the pusher: smooth the paths, or push more slowly.",
        ),
    ]
