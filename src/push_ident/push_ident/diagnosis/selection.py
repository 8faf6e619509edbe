"""Which effects are there: scores propose, refits decide, evidence counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from push_ident.diagnosis.fits import EffectFit, fit_effects, polished, with_another
from push_ident.diagnosis.parallel import side_by_side
from push_ident.diagnosis.scores import EffectScore, Information, information_beside, score_effects
from push_ident.diagnosis.settings import Thresholds
from push_ident.physics.effect import Law
from push_ident.physics.effects import EFFECTS

__all__ = ["Candidate", "Rival", "Selection", "Step", "select_effects"]

_RIVAL = 0.5
"""Share of the best one's gain from which another effect may yet take its place."""
_CLEARLY = 3.0
"""Gain of log evidence from which it does [nat]."""
_PROMISING = (-2.0, 0.5)
"""Expected gain of log evidence below which a refit is not worth its time [nat], of a first effect and of one beside others, which has
to gain more: a score is of second order only, but not that far off."""
_OUTSHONE = 0.1
"""So much of the best one's score is added to it: one of many times less is no rival."""

_STUCK = 1.0
"""Gain of log evidence of the same model, begun from the maps beside another effect, that shows it was stuck at a kink of the cost [nat]:
the effect gained by freeing it, not by being there."""

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect that was refitted together with what was there already."""

    name: str
    fit: EffectFit
    gain: float
    """Of log evidence over the fit without it [nat]."""


@dataclass(frozen=True, slots=True)
class Step:
    """One round: every absent effect scored, the best refitted."""

    before: EffectFit
    told: Information | None
    """By the pushes, of the absent effects."""
    scores: tuple[EffectScore, ...]
    candidates: tuple[Candidate, ...]
    """Refitted, the best first."""

    @property
    def best(self) -> Candidate | None:
        return self.candidates[0] if self.candidates else None


@dataclass(frozen=True, slots=True)
class Rival:
    """An effect that may be there in place of one that was found."""

    name: str
    of: str
    """The effect that was found."""
    fit: EffectFit
    """With the rival in its place."""
    behind: float
    """Log evidence that it lacks [nat]."""


@dataclass(frozen=True, slots=True)
class Selection:
    """The effects that were found, one a step."""

    base: EffectFit
    fit: EffectFit
    """With all effects that were found."""
    steps: tuple[Step, ...] = field(default=())
    """The last one found nothing more, unless the number of effects was the limit."""
    swaps: tuple[Rival, ...] = field(default=())
    """Rivals of effects other than the last one, each beside all that was found."""

    @property
    def found(self) -> tuple[str, ...]:
        """Effects beyond those of the base."""
        return tuple(name for name in self.fit.names if name not in self.base.names)

    @property
    def added(self) -> dict[str, tuple[Step, Candidate]]:
        """Of each effect that was found, in the order they came: the step in which it came, and the effect as it was refitted there.

        An effect that took the place of another one stands in that one's step.
        """
        own = {number: step.best for number, step in enumerate(self.steps) if step.best and step.best.name in self.found}
        for name in self.found:
            if name not in {candidate.name for candidate in own.values()}:
                free = ((n, c) for n, step in enumerate(self.steps) for c in step.candidates if c.name == name and n not in own)
                own.update([next(free)])
        return {candidate.name: (self.steps[number], candidate) for number, candidate in sorted(own.items())}

    @property
    def stages(self) -> dict[str, EffectFit]:
        """Fits with some of the effects that were found, by their names, in the order in which they were added."""
        parts = {tuple(name for name in step.before.names if name not in self.base.names): step.before for step in self.steps}
        return {", ".join(names): fit for names, fit in parts.items() if names and set(names) < set(self.found)}

    def until(self, stage: int) -> Selection:
        """What was found before a stage, by its number: 0 for the base alone."""
        fit = [self.base, *self.stages.values(), self.fit][stage]
        n_steps = next((number for number, step in enumerate(self.steps, 1) if step.before is fit), len(self.steps))
        return Selection(self.base, fit, self.steps[:n_steps])

    @property
    def rivals(self) -> tuple[Rival, ...]:
        """Of the last effect, the nearest first, then of those before it; one that only holds the effect as a special case is none."""
        if not self.found:
            return ()
        step, last = list(self.added.values())[-1]
        own = [Rival(c.name, last.name, c.fit, last.gain - c.gain) for c in step.candidates if c is not last]
        return tuple(r for r in (*own, *self.swaps) if r.name not in self.found and r.name not in EFFECTS[r.of].special_case_of)

    def open_rivals(self, thresholds: Thresholds) -> tuple[Rival, ...]:
        """Those that explain the pushes nearly as well: a law that holds as it stands lacks nothing if it is there, a law of friction or
        of loads may lack what it is off by."""
        gains = {name: candidate.gain for name, (_, candidate) in self.added.items()}

        def apart(rival: Rival) -> float:
            gain = gains[rival.of]
            if gain < thresholds.sure:
                return gain - 1.0
            return thresholds.apart if EFFECTS[rival.name].law is Law.EXACT else max(thresholds.apart, thresholds.apart_share * gain)

        return tuple(rival for rival in self.rivals if rival.behind < apart(rival))

    def special_cases(self, apart: float) -> dict[str, str]:
        """Of effects that were found: one that holds it as a special case and was not preferred, though it explains the pushes as well."""
        return {
            name: other.name
            for name, (step, candidate) in self.added.items()
            for other in step.candidates
            if other.name in EFFECTS[name].special_case_of and other.gain > candidate.gain - apart
        }


def select_effects(base: EffectFit, thresholds: Thresholds, on_progress: Progress | None = None) -> Selection:
    """Add effects while one is seen; drop one that another made needless. One that is too small to matter goes to the base.

    Args:
        base: converged.
        thresholds: what counts as seen.
        on_progress: told what is fitted.
    """
    report = on_progress or (lambda text: None)
    fit, steps, swaps = base, list[Step](), tuple[Rival, ...]()
    while True:
        report(f"scoring effects beside {', '.join(fit.names) or 'the base model'}")
        told = information_beside(fit)
        scores = tuple(score_effects(told, thresholds.seen))
        chosen = _worth_refitting(scores, thresholds, is_first=fit is base)
        if chosen:
            report(f"refitting with {', '.join(score.name for score in chosen)}")
        n_found = len(fit.names) - len(base.names)
        needed = _needed(Selection(base, fit, tuple(steps)), thresholds)
        # Of a first effect, all that were refitted are told in the ranking.
        worth = needed - thresholds.apart if n_found else -np.inf
        candidates = _ranked(side_by_side(partial(_refitted, fit, worth), chosen), thresholds.apart)
        if candidates and candidates[0].gain >= needed:
            freed = fit_effects(candidates[0].fit, fit.names)
            if freed.log_evidence > fit.log_evidence + _STUCK:
                freed = polished(freed)
                base, fit = freed if fit is base else base, freed
                continue
        if candidates and candidates[0].gain >= needed and _is_trifle(candidates[0], thresholds):
            report(f"{candidates[0].name} is too small to matter: it belongs to the base")
            return select_effects(polished(fit_effects(base, (*base.names, candidates[0].name))), thresholds, on_progress)
        steps.append(Step(fit, told, scores, tuple(candidates)))
        if not candidates or candidates[0].gain < needed or n_found >= thresholds.n_effects:
            return Selection(base, fit, tuple(steps), swaps)
        larger, larger_swaps = _swapped(polished(candidates[0].fit), steps)
        kept = _without_needless(base, larger, thresholds)
        if kept.log_evidence <= fit.log_evidence:
            return Selection(base, fit, tuple(steps), swaps)
        fit, swaps = kept, larger_swaps if kept is larger else ()


def _is_trifle(candidate: Candidate, thresholds: Thresholds) -> bool:
    """Whether an effect is smaller than cells are known."""
    effect, fit = EFFECTS[candidate.name], candidate.fit
    values = fit.effects.values[fit.effects.slice_of(candidate.name)]
    return effect.law is Law.EXACT and float(np.linalg.norm(values)) < thresholds.trifles.get(effect.parameters[0].unit, 0.0)


def _needed(selection: Selection, thresholds: Thresholds) -> float:
    """Gain of log evidence from which one more effect counts [nat]."""
    if not selection.found:
        return thresholds.seen
    nearly = sum(candidate.gain for name, (_, candidate) in selection.added.items() if EFFECTS[name].law is not Law.EXACT)
    return max(thresholds.also, thresholds.also_share * nearly)


def _worth_refitting(scores: tuple[EffectScore, ...], thresholds: Thresholds, *, is_first: bool) -> list[EffectScore]:
    if not scores:
        return []
    enough = max(_PROMISING[0] + _OUTSHONE * scores[0].gain, _PROMISING[not is_first])
    chosen = {score.name for score in scores[: thresholds.n_refits] if score.gain > enough}
    for name in sorted(chosen):
        group = {name, *EFFECTS[name].refit_with}
        if any(s.gain > 0 for s in scores if s.name in group):
            chosen |= group
    return [score for score in scores if score.name in chosen]


def _ranked(candidates: list[Candidate], apart: float) -> list[Candidate]:
    """The best first; a special case before what holds it, unless that gains much more."""
    ranked = sorted(candidates, key=lambda c: -c.gain)
    for place, candidate in enumerate(ranked):
        if ranked[0].name in EFFECTS[candidate.name].special_case_of and candidate.gain > ranked[0].gain - apart:
            return [candidate, *ranked[:place], *ranked[place + 1 :]]
    return ranked


def _refitted(fit: EffectFit, worth: float, score: EffectScore) -> Candidate:
    names = (*fit.names, score.name)
    own = fit_effects(fit, names, np.concatenate([fit.z[fit.parameters.effect_slice], score.start]), score.gain, worth)
    return Candidate(score.name, own, own.log_evidence - fit.log_evidence)


def _swapped(fit: EffectFit, steps: Sequence[Step]) -> tuple[EffectFit, tuple[Rival, ...]]:
    """Beside a new effect, an earlier one may turn out to have stood for one of its rivals: the best of them, and the others."""
    trials = [
        (step.best.name, rival)
        for step in steps[:-1]
        if step.best and step.best.name in fit.names
        for rival in step.candidates[1:]
        if rival.name not in fit.names and rival.gain > _RIVAL * step.best.gain
    ]
    fits = side_by_side(lambda trial: with_another(fit, trial[0], trial[1].name, trial[1].fit), trials)
    others = [(place, rival.name, other) for (place, rival), other in zip(trials, fits, strict=True)]
    place, name, best = max(others, key=lambda other: other[2].log_evidence, default=("", "", fit))
    if best.log_evidence > fit.log_evidence + _CLEARLY:
        # Those that would have come in the place of another effect than it did are not beside what is there now.
        others = [(name, place, fit), *((name, n, other) for p, n, other in others if p == place and other is not best)]
        fit = polished(best)
    return fit, tuple(Rival(n, p, other, fit.log_evidence - other.log_evidence) for p, n, other in others)


def _without_needless(base: EffectFit, fit: EffectFit, thresholds: Thresholds) -> EffectFit:
    """Drop an effect found earlier that explains nothing any more."""
    for name in [n for n in fit.names if n not in base.names][:-1]:
        rest = fit_effects(fit, [n for n in fit.names if n != name])
        if rest.log_evidence > fit.log_evidence - 0.5 * thresholds.seen:
            return polished(rest)
    return fit
