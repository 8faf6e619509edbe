"""Third stage: which effects are there. Scores propose, refits decide by log evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from push_ident.diagnosis.fits import fit_effects, polished, under_usual_discrepancy, with_another, with_shared
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.relabelling import gains_by_chance
from push_ident.diagnosis.scores import EffectScore, effect_information, score_effects, score_in_place
from push_ident.diagnosis.selection import Candidate, RivalFit, Selection, Step
from push_ident.diagnosis.settings import Progress
from push_ident.diagnosis.state import DiagnosisState
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effect import Law
from push_ident.physics.effects import EFFECTS
from push_ident.threads import map_in_threads
from push_ident.types import SolveStatus


def select(state: DiagnosisState, on_progress: Progress) -> DiagnosisState:
    """The stage: effects beside the base model."""
    if state.abstains or state.base is None:
        return state
    return replace(state, selection=select_effects(state.base, state.settings.policy.selection, on_progress))


def select_effects(base: Fit, policy: SelectionPolicy, on_progress: Progress | None = None) -> Selection:
    """Add effects while one is detected; drop one that another made needless. A negligible one joins the base model."""
    report = on_progress or (lambda text: None)
    selection = Selection(base, base)
    while True:
        step = _make_step(selection, policy, report)
        best = step.best
        if (sharing := _shared_instead(selection, step, policy)) is not None:
            report(f"{sharing.unknowns.shared_names[-1]} acts on the reference, too: it joins the base model")
            return select_effects(sharing, policy, on_progress)
        if best is None or not step.log_bayes_factor >= required_log_bayes_factor(selection, policy):
            return replace(selection, steps=(*selection.steps, step))
        if (freed := _freed(selection, best, policy)) is not selection:
            selection, step = freed, _beside(step, freed.fit)
            if not step.log_bayes_factor >= required_log_bayes_factor(selection, policy):
                continue
        if _is_negligible(best, policy):
            report(f"{best.name} is negligible: it joins the base model")
            return select_effects(polished(fit_effects(selection.base, (*selection.base.names, best.name))), policy, on_progress)
        if len(selection.selected) >= policy.max_effects:
            return replace(selection, steps=(*selection.steps, step))
        before, selection = selection.fit, _with_next(selection, step, policy)
        if selection.fit is before:
            return selection


def required_log_bayes_factor(selection: Selection, policy: SelectionPolicy) -> float:
    """Log Bayes factor from which one more effect counts [nat]."""
    if not selection.selected:
        return policy.min_log_bayes_factor
    approximate = [c.log_bayes_factor for name, (_, c) in selection.added.items() if EFFECTS[name].law is Law.APPROXIMATE]
    return max(policy.min_log_bayes_factor_next, policy.discrepancy_next_share * policy.detection_log_bayes_factor * sum(approximate))


def choose_refits(scores: Sequence[EffectScore], policy: SelectionPolicy, *, required: float, is_first: bool) -> list[EffectScore]:
    """Effects whose scores justify a refit, in the order of the scores, of which the most promising comes first.

    `required`: log Bayes factor that one more effect needs [nat]; `is_first`: whether no effect was found yet.
    """
    if not scores or scores[0].expected_log_bayes_factor < policy.min_promised_share * required:
        return []
    promises = {score.name: score.expected_log_bayes_factor for score in scores}
    least = policy.min_promise_first if is_first else policy.min_promise_next
    enough = max(policy.min_promise_first + policy.promise_share * scores[0].expected_log_bayes_factor, least)
    best = [score.name for score in scores[: policy.max_refits] if promises[score.name] > enough]
    chosen = set(best)
    for name in best:
        # Scores of these effects mislead about one another.
        group = (name, *EFFECTS[name].refit_with)
        if any(promises.get(member, -np.inf) > 0 for member in group):
            chosen.update(group)
    chosen.update(name for name in promises if is_first and chosen and EFFECTS[name].is_abrupt)
    return [score for score in scores if score.name in chosen]


def _make_step(selection: Selection, policy: SelectionPolicy, report: Progress) -> Step:
    """Score all absent effects beside a selection, and refit those whose scores justify it."""
    fit = selection.fit
    report(f"scoring effects beside {', '.join(fit.names) or 'the base model'}")
    information = effect_information(fit)
    by_chance = gains_by_chance(fit, policy)
    near_fit = score_effects(information, policy)
    scores = near_fit
    if fit.has_discrepancy_above(policy.usual_discrepancy):
        under_usual = score_effects(effect_information(under_usual_discrepancy(fit)), policy)
        scores = _or_under_usual(near_fit, under_usual, policy)
    near_fit, scores = (
        sorted((s.beyond(by_chance.get(s.name, 0.0)) for s in group), key=lambda s: -s.expected_log_bayes_factor)
        for group in (near_fit, scores)
    )
    needed = required_log_bayes_factor(selection, policy)
    # Refits also free a fit that stopped before its optimum, where scores mean little.
    least = needed if fit.status is SolveStatus.CONVERGED else -np.inf
    is_first = fit is selection.base
    # Pushes that a usual discrepancy does not explain at all promise there what no refit keeps.
    tried = {s.name for group in (near_fit, scores) for s in choose_refits(group, policy, required=least, is_first=is_first)}
    chosen = [score for score in scores if score.name in tried]
    if chosen:
        report(f"refitting with {', '.join(score.name for score in chosen)}")
    # All refits of a first effect are completed, since the ranking shows them; later ones end where they cannot matter any more.
    required = needed - policy.tie_margin if selection.selected else -np.inf
    refits = map_in_threads(lambda score: _refit(fit, required, score, fit), chosen)
    candidates = _ranked(_freed_candidates(fit, refits, by_chance, required, policy), policy.tie_margin)
    return Step(fit, information, tuple(scores), tuple(candidates))


def _or_under_usual(scores: Sequence[EffectScore], under_usual: Sequence[EffectScore], policy: SelectionPolicy) -> list[EffectScore]:
    """The scores near a fit, with those under a discrepancy of the usual size where these promise much more: what an effect does has then
    become discrepancy."""
    others = {score.name: replace(score, under_usual=True) for score in under_usual}

    def better(score: EffectScore) -> EffectScore:
        other = others.get(score.name, score)
        promised = policy.promise_share * other.expected_log_bayes_factor
        return other if promised > max(score.expected_log_bayes_factor, policy.tie_margin) else score

    return [better(score) for score in scores]


def _shared_instead(selection: Selection, step: Step, policy: SelectionPolicy) -> Fit | None:
    """Beside a reference: the base model with an effect that pushes of the reference have, too, where that explains more than any change.

    None where none does, or there is no reference.
    """
    if selection.fit.unknowns.shared is None:
        return None
    scores = score_effects(effect_information(selection.fit, shared=True), policy)
    best = next((score for score in scores if not EFFECTS[score.name].follows_order), None)
    least = max(required_log_bayes_factor(selection, policy), step.log_bayes_factor)
    if best is None or best.expected_log_bayes_factor <= policy.promise_share * least:
        return None
    fit = with_shared(selection.fit, best.name, best.start)
    explains_more = fit.log_evidence - selection.fit.log_evidence > least
    return polished(fit_effects(fit, selection.base.names)) if explains_more else None


def _refit(fit: Fit, required: float, score: EffectScore, maps: Fit) -> Candidate:
    """The fit with the effect of a score, from the maps and contacts of `maps`."""
    effect = EFFECTS[score.name]
    typical = np.array([(p.typical - p.nominal) / p.scale for p in effect.parameters])
    start = np.concatenate([fit.effect_unknowns, typical if effect.is_abrupt else score.start])
    needed = required + score.by_chance + fit.log_evidence - maps.log_evidence
    expected = score.expected_log_bayes_factor + score.by_chance
    refit = fit_effects(maps, (*fit.names, score.name), start, expected, needed, under_usual=score.under_usual)
    return Candidate(score.name, refit, refit.log_evidence - fit.log_evidence - score.by_chance)


def _freed_candidates(
    fit: Fit, candidates: Sequence[Candidate], by_chance: Mapping[str, float], required: float, policy: SelectionPolicy
) -> list[Candidate]:
    """The candidates, with those fitted again from the maps and contacts beside the best one that promise more there than they had: they
    stopped at a kink of the cost, or were not tried, as what the best one moves lay beyond their linear range."""
    best = max(candidates, key=lambda candidate: candidate.log_bayes_factor, default=None)
    if best is None or best.log_bayes_factor <= 0.0:
        return list(candidates)
    refitted = {candidate.name: candidate for candidate in candidates}

    def tied(score: EffectScore) -> float:
        return best.log_bayes_factor - policy.tie_margin_of(EFFECTS[score.name].law, best.log_bayes_factor)

    def falls_short(score: EffectScore) -> bool:
        known = refitted[score.name].log_bayes_factor if score.name in refitted else -np.inf
        return score.expected_log_bayes_factor > max(tied(score), known + policy.tie_margin)

    of_best = best.fit.log_evidence - fit.log_evidence
    scores = [score.beyond(by_chance.get(score.name, 0.0)) for score in score_in_place(best.fit, best.name, of_best, policy)]
    promising = [replace(score, expected_log_bayes_factor=of_best + score.expected_log_bayes_factor) for score in scores]
    first = sorted(promising, key=lambda score: -score.expected_log_bayes_factor)[: policy.max_refits]
    again = map_in_threads(lambda score: _refit(fit, max(required, tied(score)), score, best.fit), filter(falls_short, first))
    for candidate in again:
        refitted[candidate.name] = max(candidate, refitted.get(candidate.name, candidate), key=lambda one: one.log_bayes_factor)
    return list(refitted.values())


def _ranked(candidates: Sequence[Candidate], tie_margin: float) -> list[Candidate]:
    """The best first; a special case before the effect that contains it, unless that one is better by more than a tie."""
    ranked = sorted(candidates, key=lambda c: -c.log_bayes_factor)
    for rank, candidate in enumerate(ranked):
        is_special_case = ranked[0].name in EFFECTS[candidate.name].special_case_of
        if is_special_case and candidate.log_bayes_factor > ranked[0].log_bayes_factor - tie_margin:
            return [candidate, *ranked[:rank], *ranked[rank + 1 :]]
    return ranked


def _freed(selection: Selection, best: Candidate, policy: SelectionPolicy) -> Selection:
    """The selection with its fit repeated from the maps beside the best effect, where it had stopped at a kink of the cost; else the
    selection itself."""
    freed = fit_effects(best.fit, selection.fit.names)
    if freed.log_evidence <= selection.fit.log_evidence + policy.min_restart_gain:
        return selection
    freed = polished(freed)
    return replace(selection, base=freed if selection.fit is selection.base else selection.base, fit=freed)


def _beside(step: Step, fit: Fit) -> Step:
    """The same step beside a better fit of the same effects."""
    gained = fit.log_evidence - step.before.log_evidence
    candidates = tuple(replace(c, log_bayes_factor=c.log_bayes_factor - gained) for c in step.candidates)
    return replace(step, before=fit, candidates=candidates)


def _is_negligible(candidate: Candidate, policy: SelectionPolicy) -> bool:
    """Whether an effect with an exact law is smaller than the accuracy of a cell."""
    effect, fit = EFFECTS[candidate.name], candidate.fit
    values = fit.fitted_effects.values[fit.fitted_effects.slice_of(candidate.name)]
    return effect.law is Law.EXACT and float(np.linalg.norm(values)) < policy.negligible.get(effect.parameters[0].unit, 0.0)


def _with_next(selection: Selection, step: Step, policy: SelectionPolicy) -> Selection:
    """The selection after a step, with the first of its candidates that explains more in the end; without any where none does."""
    for candidate in step.candidates:
        if not candidate.log_bayes_factor >= required_log_bayes_factor(selection, policy):
            continue
        others = tuple(other for other in step.candidates if other is not candidate)
        stepped = replace(selection, steps=(*selection.steps, replace(step, candidates=(candidate, *others))))
        if (larger := _with_best(stepped, candidate, policy)) is not stepped:
            return larger
    return replace(selection, steps=(*selection.steps, step))


def _with_best(selection: Selection, best: Candidate, policy: SelectionPolicy) -> Selection:
    """The selection with the best effect of its last step; the selection itself where that explains no more in the end."""
    larger, swaps = _swapped(polished(best.fit), selection.steps, policy)
    kept = _without_needless(selection.base, larger, policy)
    if kept.log_evidence <= selection.fit.log_evidence:
        return selection
    return replace(selection, fit=kept, swaps=swaps if kept is larger else ())


def _swapped(fit: Fit, steps: Sequence[Step], policy: SelectionPolicy) -> tuple[Fit, tuple[RivalFit, ...]]:
    """Try rivals of earlier effects in their place: beside a new effect one of them may explain more. The best fit, and the others."""
    trials = [
        (step.best.name, rival)
        for step in steps[:-1]
        if step.best and step.best.name in fit.names
        for rival in step.candidates[1:]
        if rival.name not in fit.names and rival.log_bayes_factor > policy.swap_candidate_share * step.best.log_bayes_factor
    ]
    fits = map_in_threads(lambda trial: with_another(fit, trial[0], trial[1].name, trial[1].fit), trials)
    others = [(replaced, rival.name, other) for (replaced, rival), other in zip(trials, fits, strict=True)]
    replaced, name, best = max(others, key=lambda other: other[2].log_evidence, default=("", "", fit))
    if best.log_evidence > fit.log_evidence + policy.min_swap_gain:
        # Rivals of other effects were not fitted beside the one that is there now.
        others = [(name, replaced, fit), *((name, n, other) for p, n, other in others if p == replaced and other is not best)]
        fit = polished(best)
    return fit, tuple(RivalFit.of(n, p, other, fit, fit.log_evidence - other.log_evidence) for p, n, other in others)


def _without_needless(base: Fit, fit: Fit, policy: SelectionPolicy) -> Fit:
    """Drop an effect found earlier that explains nothing any more."""
    for name in [n for n in fit.names if n not in base.names][:-1]:
        rest = fit_effects(fit, [n for n in fit.names if n != name])
        if rest.log_evidence > fit.log_evidence - policy.drop_share * policy.min_log_bayes_factor:
            return polished(rest)
    return fit
