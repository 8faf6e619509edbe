"""Fourth stage: what held-out pushes confirm of the effects that were selected, and whether something without a name remains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from push_ident.diagnosis.account import account_of
from push_ident.diagnosis.held_out import Gap, measure_gap
from push_ident.diagnosis.policy import UnknownPolicy, ValidationPolicy
from push_ident.diagnosis.residuals import FrameResiduals, standardized_residuals
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.state import DiagnosisState, UnsupportedEffect, Validation
from push_ident.diagnosis.unknown import SmoothWrench, fit_wrench

__all__ = ["residuals_exceed_noise", "supported_selection", "validate", "wrench_explains_more"]

Progress = Callable[[str], None]


def validate(state: DiagnosisState, on_progress: Progress) -> DiagnosisState:
    """The stage: held-out errors, effects that every push supports, and whether the cause is unknown.

    Neither a wrench nor a named effect is accepted where it predicts held-out pushes worse.
    """
    if state.abstains or state.selection is None:
        return state
    on_progress("looking for an unknown cause")
    selection, policy = state.selection, state.settings.policy
    base_residuals = standardized_residuals(selection.base, policy.residuals)
    residuals = base_residuals if selection.fit is selection.base else standardized_residuals(selection.fit, policy.residuals)
    wrench = fit_wrench(selection, policy.unknown)
    remains = _remains(state, base_residuals, residuals)
    if wrench is not None and (gap := _gap_of_wrench(wrench, selection, state, on_progress, remains=remains)) is not None:
        account = account_of(gap, selection.base.problem, policy.account)
        validation = Validation(selection.without_effects(), gap, account, base_residuals, residuals, cause_is_unknown=True, wrench=wrench)
    elif remains:
        gap = measure_gap(selection.base, selection.base, policy.validation, on_progress)
        account = account_of(gap, selection.base.problem, policy.account)
        validation = Validation(selection.without_effects(), gap, account, base_residuals, residuals, cause_is_unknown=True)
    else:
        validation = _validate_effects(state, base_residuals, residuals, on_progress)
        validation = validation if validation.cause_is_unknown else replace(validation, wrench=wrench)
    return replace(state, validation=validation)


def residuals_exceed_noise(base: FrameResiduals, residuals: FrameResiduals, policy: UnknownPolicy, *, noise_is_known: bool) -> bool:
    """Whether residuals beside all named effects are larger than noise, or continue from frame to frame as noise does not.

    Args:
        base: residuals of the base model; what it leaves in excess widens the limits.
        residuals: beside all effects that were named.
        policy: limits.
        noise_is_known: whether the correlation of the pose errors is known; else correlated residuals may be noise.
    """
    excess = max(base.residual_ratio[0] - 1.0, 0.0)
    ratio, p_value = residuals.residual_ratio
    if ratio > max(policy.max_residual_ratio, 1.0 + policy.residual_ratio_share * excess) and p_value < policy.max_p_value:
        return True
    autocorrelation, p_value = residuals.excess_autocorrelation
    limit = policy.max_excess_autocorrelation + policy.excess_autocorrelation_share * excess
    return noise_is_known and autocorrelation > limit and p_value < policy.max_p_value


def wrench_explains_more(wrench: SmoothWrench, selection: Selection, policy: UnknownPolicy, tie_margin: float) -> bool:
    """Whether a smooth wrench explains the pushes better than the effects that were named.

    It has to be better than a single effect by a wide margin: no named law is exactly that of the world, and a wrench of any shape also
    fits the rest. Several effects easily imitate a cause outside the catalogue, so that they have to be better than the wrench by a tie.
    """
    named = selection.fit.log_evidence - selection.base.log_evidence
    if len(selection.found) > 1:
        return wrench.log_bayes_factor > named - tie_margin
    return wrench.log_bayes_factor > max(named + tie_margin, named / policy.named_share)


def supported_selection(selection: Selection, gap: Gap, policy: ValidationPolicy) -> tuple[Selection, UnsupportedEffect | None]:
    """The effects that held-out pushes support: none where they are predicted worse.

    An effect without evidence in the fit without one push came from that push: something happened to it, or it lies at the edge between
    sticking and sliding, where small causes decide where the object goes. It is rejected, and so are those that were added after it.
    """
    if not selection.found:
        return selection, None
    if gap.is_worse:
        return selection.without_effects(), None
    earlier = set(selection.base.names)
    fits = [*selection.stages.values(), selection.fit]
    for stage, (fit, log_bayes_factors) in enumerate(zip(fits, gap.log_bayes_factor_without, strict=True)):
        fold = int(np.argmin(log_bayes_factors))
        names = [name for name in fit.names if name not in earlier]
        if log_bayes_factors[fold] < policy.min_log_bayes_factor_without_push:
            return selection.until(stage), UnsupportedEffect(" and ".join(names), gap.folds[fold])
        earlier |= set(names)
    return selection, None


def _remains(state: DiagnosisState, base: FrameResiduals, residuals: FrameResiduals) -> bool:
    # Errors of perceived poses depend on the pose, so that they continue from frame to frame.
    known = state.rest_noise_known and not state.from_camera
    return residuals_exceed_noise(base, residuals, state.settings.policy.unknown, noise_is_known=known)


def _gap_of_wrench(
    wrench: SmoothWrench, selection: Selection, state: DiagnosisState, on_progress: Progress, *, remains: bool
) -> Gap | None:
    """The gap with the wrench, where it replaces the named effects; None where it does not, or held-out pushes do not support it."""
    policy = state.settings.policy
    if not wrench.log_bayes_factor > policy.unknown.min_log_bayes_factor:
        return None
    if not remains and not wrench_explains_more(wrench, selection, policy.unknown, policy.selection.tie_margin):
        return None
    gap = measure_gap(selection.base, wrench.fit, policy.validation, on_progress)
    return gap if gap.is_above_noise and not gap.is_worse else None


def _validate_effects(
    state: DiagnosisState, base_residuals: FrameResiduals, residuals: FrameResiduals, on_progress: Progress
) -> Validation:
    """The named effects against held-out pushes; where one was rejected, the cause may turn out to be unknown."""
    assert state.selection is not None
    selected, policy = state.selection, state.settings.policy
    gap = measure_gap(selected.base, selected.fit, policy.validation, on_progress, between=selected.stages)
    selection, unsupported = supported_selection(selected, gap, policy.validation)
    if selection is selected:
        return Validation(selection, gap, account_of(gap, selection.base.problem, policy.account), base_residuals, residuals)
    residuals = standardized_residuals(selection.fit, policy.residuals)
    is_unknown = unsupported is not None and _remains(state, base_residuals, residuals)
    selection = selected.without_effects() if is_unknown else selection
    gap = measure_gap(selection.base, selection.fit, policy.validation, on_progress, between=selection.stages)
    account = account_of(gap, selection.base.problem, policy.account)
    return Validation(selection, gap, account, base_residuals, residuals, cause_is_unknown=is_unknown, unsupported=unsupported)
