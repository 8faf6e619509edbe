"""Fourth stage: what held-out pushes confirm of the effects that were selected, and how probable it is that something else acts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from push_ident.diagnosis.account import account_of
from push_ident.diagnosis.fits import fit_effects, polished
from push_ident.diagnosis.held_out import Gap, HeldOutFits, folds_of, measure_gap
from push_ident.diagnosis.odds import SOMETHING_ELSE, OutsideEvidence, Probabilities, explanations_of, is_outside, probabilities_of
from push_ident.diagnosis.policy import UnknownPolicy, ValidationPolicy
from push_ident.diagnosis.residuals import FrameResiduals, standardized_residuals
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.settings import Progress
from push_ident.diagnosis.something_else.evidence import Pattern, SomethingElse, error_with_patterns, find_something_else
from push_ident.diagnosis.something_else.family import VariesWith
from push_ident.diagnosis.state import DiagnosisState, UnsupportedEffect, Validation
from push_ident.identification.fitting.discrepancy import departing_pushes
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.problem import FitProblem
from push_ident.physics.effect import Mechanism
from push_ident.physics.effects import EFFECTS
from push_ident.threads import map_in_threads

_Structure = tuple[FrameResiduals, SomethingElse | None]
"""Residuals of a fit, and structure in them."""


def validate(state: DiagnosisState, on_progress: Progress) -> DiagnosisState:
    """The stage: held-out errors, effects that every push supports, and how probable a cause outside the catalogue is."""
    if state.abstains or state.selection is None:
        return state
    on_progress("looking for something else")
    selection, policy = state.selection, state.settings.policy
    # Folds decide only about something else in place of effects.
    folds = folds_of(selection.base.problem.n_pushes, policy.validation.max_folds)
    fits = [(selection.base, folds), *([(selection.fit, ())] if selection.selected else [])]
    base, *others = map_in_threads(lambda task: _look_for_structure(state, *task), fits)
    remaining = others[0] if others else base
    reported, probabilities = _weigh_outside(state, selection, base, remaining, {})
    held_out = HeldOutFits(state.earlier)
    unsupported, rejected, closes_nothing = None, dict[str, float](), False
    if not is_outside(probabilities, policy.selection):
        gap = measure_gap(selection.base, selection.fit, policy.validation, on_progress, between=selection.stages, held_out=held_out)
        supported, unsupported = supported_selection(selection, gap, policy.validation)
        if supported is not selection:
            rejected = dict.fromkeys(
                (name for name in selection.selected if name not in supported.selected), policy.validation.min_log_bayes_factor_without_push
            )
            selection, remaining = supported, _look_for_structure(state, supported.fit, ()) if supported.selected else base
            gap = measure_gap(selection.base, selection.fit, policy.validation, on_progress, between=selection.stages, held_out=held_out)
        closes_error = bool(selection.selected) and gap.closes_error
        reported, probabilities = _weigh_outside(state, selection, base, remaining, rejected, closes_error=closes_error)
        closes_nothing = bool(selection.selected) and not (gap.closes_error or gap.is_more_probable) and probabilities.beyond_effects > 0.5
    names_no_effect, free_law = closes_nothing or is_outside(probabilities, policy.selection), None
    instead = _mechanism_instead(selection, probabilities, names_no_effect=names_no_effect)
    if instead:
        bare = measure_gap(selection.base, selection.base, policy.validation, on_progress, held_out=held_out)
        bare, law = _with_patterns(bare, selection, base[1], instead)
        if names_no_effect or (law is not None and np.mean(bare.after) < np.mean(gap.after)):
            names_no_effect, free_law, gap, selection = True, law, bare, selection.without_effects()
            reported = base[1]
    validation = Validation(
        selection=selection,
        gap=gap,
        account=account_of(gap, selection.fit.problem, policy.account),
        base_residuals=base[0],
        residuals=remaining[0],
        probabilities=probabilities,
        names_no_effect=names_no_effect,
        free_law=free_law,
        something_else=reported,
        unsupported=unsupported,
        held_out=held_out,
        departing=_departing(selection.fit.problem, policy.validation),
    )
    return replace(state, validation=validation)


def _departing(problem: FitProblem, policy: ValidationPolicy) -> dict[int, float]:
    return departing_pushes(np.array(problem.precisions[: problem.n_pushes]), policy.max_p_value)


def failed_tests(
    base: FrameResiduals, residuals: FrameResiduals, policy: UnknownPolicy, *, correlation_std: float, correlation: float = 0.0
) -> tuple[float, ...]:
    """P-values of those tests in which residuals beside all named effects are larger than noise, or continue from frame to frame as noise
    does not. What the base model leaves in excess widens the limits.

    `correlation` of the errors of neighbouring poses, and its standard error [1]; infinite where correlated residuals may be noise. Errors
    whose mean is as uncertain as that of independent ones have a variance proportional to (1 - correlation) / (1 + correlation).
    """
    excess = max(base.residual_ratio()[0] - 1.0, 0.0)
    failed = []
    of_variance = 2.0 * correlation_std / (1.0 - correlation**2) if np.isfinite(correlation_std) else 0.0
    ratio, p_value = residuals.residual_ratio(of_variance)
    if ratio > max(policy.max_residual_ratio, 1.0 + policy.residual_ratio_share * excess) and p_value < policy.max_p_value:
        failed.append(p_value)
    autocorrelation, p_value = residuals.excess_autocorrelation(correlation_std)
    limit = policy.max_excess_autocorrelation + policy.excess_autocorrelation_share * excess
    if autocorrelation > limit and p_value < policy.max_p_value:
        failed.append(p_value)
    return tuple(failed)


def supported_selection(selection: Selection, gap: Gap, policy: ValidationPolicy) -> tuple[Selection, UnsupportedEffect | None]:
    """The effects that held-out pushes support: none where they are predicted worse.

    An effect without evidence in the fit without one push came from that push: something happened to it, or it lies at the edge between
    sticking and sliding, where small causes decide where the object goes. It is rejected, and so are those that were added after it, unless
    it certainly brings held-out pushes nearer to their prediction. One on whose values the pushes contradict each other is rejected alone.
    """
    if not selection.selected:
        return selection, None
    if gap.is_worse:
        return selection.without_effects(), None
    earlier = set(selection.base.names)
    fits = [*selection.stages.values(), selection.fit]
    for stage, (fit, log_bayes_factors) in enumerate(zip(fits, gap.log_bayes_factor_without, strict=True)):
        fold = int(np.argmin(log_bayes_factors))
        names = [name for name in fit.names if name not in earlier]
        if log_bayes_factors[fold] < policy.min_log_bayes_factor_without_push and not gap.closes_error_at(stage):
            return selection.until(stage), UnsupportedEffect(" and ".join(names), gap.folds[fold])
        earlier |= set(names)
    contradicted = [name for name in selection.selected if not gap.determines(name)]
    if not contradicted:
        return selection, None
    kept = [name for name in selection.fit.names if name not in contradicted]
    none_left = not set(kept) - set(selection.base.names)
    rest = selection.without_effects() if none_left else replace(selection, fit=polished(fit_effects(selection.fit, kept)), swaps=())
    return rest, UnsupportedEffect(" and ".join(contradicted), ())


def _look_for_structure(state: DiagnosisState, fit: Fit, folds: Sequence[Sequence[int]]) -> _Structure:
    policy = state.settings.policy
    if state.reference:  # what recordings share outside the catalogue is no change
        return standardized_residuals(fit, policy.residuals), None
    return (standardized_residuals(fit, policy.residuals), find_something_else(fit, policy, folds))


def _weigh_outside(
    state: DiagnosisState,
    selection: Selection,
    base: _Structure,
    remaining: _Structure,
    rejected: Mapping[str, float],
    *,
    closes_error: bool = False,
) -> tuple[SomethingElse | None, Probabilities]:
    """From the residuals of the base model and of the fit with all effects of a selection: something else in place of the effects or
    in addition to them, whichever explains more, and the probabilities of all causes."""
    policy, (base_residuals, in_place), (residuals, in_addition) = state.settings.policy, base, remaining
    # Errors of perceived poses depend on the pose, so that they continue from frame to frame.
    correlation_std = state.rest_correlation_std if state.rest_noise_known and not state.from_camera else np.inf
    failed: tuple[float, ...] = ()
    if not state.reference:
        noise = state.settings.noise
        failed = failed_tests(base_residuals, residuals, policy.unknown, correlation_std=correlation_std, correlation=noise.correlation)
    named = sum(candidate.log_bayes_factor for _, candidate in selection.added.values())
    evidence = OutsideEvidence.of(in_place, in_addition, failed, policy.selection, named=named)
    explanations = explanations_of(selection, evidence, policy.selection, rejected=rejected, closes_error=closes_error)
    outside = [explanation for explanation in explanations if explanation.free or SOMETHING_ELSE in explanation.causes]
    most = max(outside, key=lambda explanation: explanation.log_weight)
    reported = in_addition if (most.causes | most.imitated_by) & EFFECTS.keys() else in_place
    return reported, probabilities_of(explanations, selection.base.names)


def _mechanism_instead(selection: Selection, probabilities: Probabilities, *, names_no_effect: bool) -> str:
    """What may act without any effect of the selection: the most probable cause if no effect is named; the mechanism of the only effect,
    where that acts by a free law; else ""."""
    if names_no_effect:
        return max(probabilities.in_place_of_effects, key=lambda name: probabilities.in_place_of_effects[name])
    mechanisms = {EFFECTS[name].mechanism for name in selection.selected}
    return next((name for name in mechanisms if len(mechanisms) == 1 and probabilities.acts_freely(name)), "")


def _with_patterns(gap: Gap, selection: Selection, something_else: SomethingElse | None, cause: str) -> tuple[Gap, Pattern | None]:
    """The gap with the patterns of a cause, where held-out pushes end nearer to their prediction with it; and the best of them where it is
    the free law of a mechanism that certainly closes a part, or that no push shows of another one."""
    if something_else is None:
        return gap, None
    patterns = something_else.of(None if cause == SOMETHING_ELSE else Mechanism(cause))
    if patterns[0].family.varies_with is VariesWith.FREQUENCY:
        return replace(gap, names=(cause,)), patterns[0]
    change = error_with_patterns(selection.base, patterns, gap.folds)
    if not float(np.mean(change)) < 0.0:
        return gap, None
    is_named = cause != SOMETHING_ELSE and gap.mean_interval(-change)[0] > 0.0
    return replace(gap, after=np.maximum(gap.before + change, 0.0), names=(cause,)), patterns[0] if is_named else None
