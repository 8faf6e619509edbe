"""Fifth stage: the verdict, the effects with their sizes, and what may be there in their place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from push_ident.diagnosis.fits import BASE_WITH_FORCES
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.odds import SOMETHING_ELSE, Probabilities, mechanism_of
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.something_else.family import Acts
from push_ident.diagnosis.state import Decision, DiagnosisState, Validation
from push_ident.diagnosis.verdict import FoundEffect, FreeLaw, Verdict
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array


def decide(state: DiagnosisState) -> DiagnosisState:
    """The stage: from what held-out pushes confirmed to a verdict."""
    if state.validation is None:
        return state
    validation, settings = state.validation, state.settings
    selection, probabilities = validation.selection, validation.probabilities
    effects = [_with_law(effect, probabilities) for effect in found_effects(selection, validation.gap)]
    free_law = _free_law(validation)
    sets = confusion_sets(selection, settings.policy.selection)
    doubted = free_law.mechanism.value if free_law else effects[-1].name if effects else ""
    doubts = _in_place_of(doubted, probabilities, settings.policy.selection) if doubted else ()
    if doubts:
        sets = {**sets, doubted: (*sets.get(doubted, ()), *doubts)}
    is_unknown = validation.names_no_effect and free_law is None
    verdict = Verdict.UNKNOWN if is_unknown else verdict_of([e.name for e in effects] or ([doubted] if doubted else []), sets)
    # Those that joined the base model because they are below the accuracy of a cell; their evidence is not reported.
    hidden = selection.base.names if validation.names_no_effect else (*settings.base_effects, *BASE_WITH_FORCES)
    names = [name for name in selection.base.names if name not in hidden]
    negligible = tuple(_sized(selection.fit, selection.fit.posterior.effects_std, name, np.nan) for name in names)
    return replace(state, decision=Decision(verdict, tuple(effects), negligible, sets, free_law))


def _with_law(effect: FoundEffect, probabilities: Probabilities) -> FoundEffect:
    """The effect, with whether its mechanism rather acts by another law than its own."""
    return replace(effect, is_free=probabilities.acts_freely(EFFECTS[effect.name].mechanism))


def _free_law(validation: Validation) -> FreeLaw | None:
    pattern = validation.free_law
    if pattern is None or pattern.family.mechanism is None:
        return None
    is_length = pattern.family.acts_on is Acts.PUSHER
    factor = 1e-3 if is_length else 1.0
    largest = float(pattern.amplitude[np.argmax(np.abs(pattern.amplitude))])
    unit = "m" if is_length else ""
    return FreeLaw(pattern.family.mechanism, factor * largest, factor * pattern.std, pattern.log_bayes_factor, unit)


def _in_place_of(name: str, probabilities: Probabilities, policy: SelectionPolicy) -> tuple[str, ...]:
    """What may act in place of a cause that is named, an effect or a mechanism with a free law, without any effect."""
    instead = {**probabilities.in_place_of_effects, SOMETHING_ELSE: probabilities.outside_alone}
    return tuple(other for other, value in instead.items() if other != name and value > policy.max_probability_of_error)


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


def verdict_of(names: Sequence[str], sets: Mapping[str, Sequence[str]]) -> Verdict:
    """The verdict where the cause is not unknown. Laws of one mechanism are one cause: which of them acts may be open."""
    if not names:
        return Verdict.NO_GAP
    if len(names) > 1:
        return Verdict.SEVERAL
    others = {mechanism_of(rival) for rivals in sets.values() for rival in rivals} - {mechanism_of(name) for name in names}
    return Verdict.ONE_OF if others else Verdict.NAMED


def _sized(fit: Fit, std: Float64Array, name: str, log_bayes_factor: float) -> FoundEffect:
    columns = fit.fitted_effects.slice_of(name)
    names = [p.name for p in EFFECTS[name].parameters]
    values, deviations = (dict(zip(names, map(float, v[columns]), strict=True)) for v in (fit.fitted_effects.values, std))
    return FoundEffect(name, values, deviations, log_bayes_factor)
