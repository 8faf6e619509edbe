"""Last stage: the outcome in words, where the gap lies, and what to do next."""

from __future__ import annotations

import numpy as np

from push_ident.diagnosis import wording
from push_ident.diagnosis.next_push import most_informative_push
from push_ident.diagnosis.odds import SOMETHING_ELSE
from push_ident.diagnosis.residuals import group_residuals
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.settings import Progress
from push_ident.diagnosis.something_else.words import DISCREPANCY, PatternWords, describe_pattern
from push_ident.diagnosis.state import Decision, DiagnosisState, Validation
from push_ident.diagnosis.verdict import Verdict
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.physics.effects import EFFECTS
from push_ident.pushing.push import PushSettings

_ANYWHERE = (-1.0, 1.0, -1.0, 1.0)
"""Workspace of a proposed push where the caller gave no limits [m]."""


def explain(state: DiagnosisState, push_settings: PushSettings | None, on_progress: Progress, *, proposes_push: bool = True) -> Diagnosis:
    """The outcome of a diagnosis after all other stages; where a gate was not passed, it abstains.

    `push_settings`: limits of the push that is proposed, from where the object lies now.
    """
    policy, validation, decision = state.settings.policy, state.validation, state.decision
    if validation is None or decision is None:
        return _abstention(state)
    last = state.records[-1]
    pose, limits = np.array(last.poses.pose[-1]), push_settings or PushSettings(pusher_radius=last.pusher.radius, workspace=_ANYWHERE)
    next_push = None
    if proposes_push and validation.account.more_pushes != 0:
        on_progress("looking for the next push")
        next_push = most_informative_push(validation.selection.fit, pose, limits, policy.next_push)
    something_else = validation.something_else
    sources = [state.source_of(push) for push in range(len(state.records) + len(state.reference))]
    pattern = validation.free_law or (None if something_else is None else something_else.best)
    words = None if pattern is None else describe_pattern(pattern, sources)
    if something_else is not None and validation.free_law is None and something_else.of_discrepancy > something_else.log_bayes_factor:
        words = DISCREPANCY
    return Diagnosis(
        verdict=decision.verdict,
        sentence=_sentence(state, validation, decision, next_push, words),
        gates=state.gates,
        warnings=state.contradictions,
        policy=policy,
        effects=decision.effects,
        free_law=decision.free_law,
        confusion_sets=decision.confusion_sets,
        gap=validation.gap,
        account=validation.account,
        selection=validation.selection,
        held_out=validation.held_out,
        where=group_residuals(validation.base_residuals, policy.residuals),
        next_push=next_push,
        check=_check(decision, words),
        probabilities=validation.probabilities,
        something_else=something_else,
        pattern=words,
        base_residuals=validation.base_residuals,
        residual_ratio=validation.residuals.residual_ratio()[0],
        excess_autocorrelation=validation.residuals.excess_autocorrelation()[0],
    )


def _abstention(state: DiagnosisState) -> Diagnosis:
    failed = next(gate for gate in state.gates if not gate.passed)
    sentence = f"These data cannot be diagnosed: {failed.finding}. {failed.remedy}"
    return Diagnosis(Verdict.NOT_TRUSTWORTHY, sentence, state.gates, state.settings.policy, check=failed.remedy)


def _check(decision: Decision, words: PatternWords | None) -> str:
    """What a person at the cell can look at, for each cause that is named last or left open; empty where nothing is."""
    if decision.verdict is Verdict.UNKNOWN or decision.free_law:
        return "" if words is None else f"Look for {words.look_for}."
    names = [decision.effects[-1].name] if decision.effects else []
    for found, rivals in decision.confusion_sets.items():
        names += [found, *rivals]
    checks = {name: EFFECTS[name].check for name in names if name in EFFECTS}
    return " ".join(checks.values() if len(checks) == 1 else (f"{name}: {check}" for name, check in checks.items()))


def _sentence(
    state: DiagnosisState, validation: Validation, decision: Decision, next_push: PlannedPush | None, words: PatternWords | None
) -> str:
    account = validation.account
    if decision.free_law and words is not None:
        sentence = wording.sentence_of_free_law(decision.free_law, words, decision.confusion_sets, account)
    elif decision.verdict is Verdict.UNKNOWN:
        groups = group_residuals(validation.base_residuals, state.settings.policy.residuals)
        sentence = wording.sentence_of_unknown(account, words, validation.probabilities.beyond_effects, validation.residuals, groups)
    elif decision.effects:
        sentence = wording.sentence_of_effects(decision.effects, decision.confusion_sets, account, is_change=bool(state.reference))
        if any(SOMETHING_ELSE in names for names in decision.confusion_sets.values()) and words is not None:
            sentence += wording.sentence_of_doubt(words, validation.probabilities.outside_alone)
        elif words is not None and validation.probabilities.beyond_effects > state.settings.policy.selection.max_probability_of_error:
            remainder = account.after - float(np.mean(account.gap.noise))
            sentence += wording.sentence_of_remainder(words, validation.probabilities.beyond_effects, remainder)
    elif state.reference:
        sentence = wording.sentence_of_no_change(account)
    else:
        sentence = wording.sentence_of_nothing(account, [state.source_of(push) for push in range(len(state.records))], next_push)
        if validation.probabilities.nothing < state.settings.policy.selection.max_probability_of_nothing:
            sentence += wording.sentence_of_suspicion(validation.probabilities)
    if decision.negligible:
        sentence += wording.sentence_of_negligible(decision.negligible)
    if validation.unsupported is not None:
        sentence += wording.sentence_of_unsupported(
            validation.unsupported.name, [state.source_of(push) for push in validation.unsupported.pushes]
        )
    if validation.departing:
        sentence += wording.sentence_of_departing({state.source_of(push): times for push, times in validation.departing.items()})
    return sentence
