"""Fifth stage: the verdict, the effects with their sizes, and what may be there in their place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from push_ident.diagnosis.fits import BASE_WITH_FORCES
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.odds import SOMETHING_ELSE
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.state import Decision, DiagnosisState
from push_ident.diagnosis.verdict import FoundEffect, Verdict
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array


def decide(state: DiagnosisState) -> DiagnosisState:
    """The stage: from what held-out pushes confirmed to a verdict."""
    if state.validation is None:
        return state
    validation, settings = state.validation, state.settings
    selection, is_unknown = validation.selection, validation.cause_is_unknown
    effects = found_effects(selection, validation.gap)
    sets = confusion_sets(selection, settings.policy.selection)
    if effects and validation.probabilities.outside_alone > settings.policy.selection.max_probability_of_error:
        last = effects[-1].name
        sets = {**sets, last: (*sets.get(last, ()), SOMETHING_ELSE)}
    verdict = Verdict.UNKNOWN if is_unknown else verdict_of(effects, sets)
    # Those that joined the base model because they are below the accuracy of a cell; their evidence is not reported.
    names = [] if is_unknown else [n for n in selection.base.names if n not in (*settings.base_effects, *BASE_WITH_FORCES)]
    negligible = tuple(_sized(selection.fit, selection.fit.posterior.effects_std, name, np.nan) for name in names)
    return replace(state, decision=Decision(verdict, effects, negligible, sets))


def found_effects(selection: Selection, gap: Gap) -> tuple[FoundEffect, ...]:
    """Effects that were found, in their order. Their standard deviation is the larger of the fit's and of the jackknife's."""
    if not selection.selected:
        return ()
    fit = selection.fit
    std = np.maximum(fit.posterior.effects_std, gap.effects_std)
    return tuple(_sized(fit, std, name, candidate.log_bayes_factor) for name, (_, candidate) in selection.added.items())


def confusion_sets(selection: Selection, policy: SelectionPolicy) -> dict[str, tuple[str, ...]]:
    """Of effects that were found: rivals in a tie with them, and their exact twins."""
    sets: dict[str, tuple[str, ...]] = {}
    for rival in selection.tied_rivals(policy):
        sets[rival.replaces] = (*sets.get(rival.replaces, ()), rival.name)
    for name in selection.selected:
        if twins := [twin for twin in EFFECTS[name].exact_twins if twin not in (*selection.selected, *sets.get(name, ()))]:
            sets[name] = (*sets.get(name, ()), *twins)
    return sets


def verdict_of(effects: Sequence[FoundEffect], sets: Mapping[str, Sequence[str]]) -> Verdict:
    """The verdict where the cause is not unknown."""
    if not effects:
        return Verdict.NO_GAP
    if len(effects) > 1:
        return Verdict.SEVERAL
    return Verdict.ONE_OF if sets else Verdict.NAMED


def _sized(fit: Fit, std: Float64Array, name: str, log_bayes_factor: float) -> FoundEffect:
    columns = fit.fitted_effects.slice_of(name)
    names = [p.name for p in EFFECTS[name].parameters]
    values, deviations = (dict(zip(names, map(float, v[columns]), strict=True)) for v in (fit.fitted_effects.values, std))
    return FoundEffect(name, values, deviations, log_bayes_factor)
