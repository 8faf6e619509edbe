"""Effects that were selected step by step, and the rivals of each."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.scores import EffectInformation, EffectScore
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effects import EFFECTS


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect that was refitted together with those found before it."""

    name: str
    fit: Fit
    log_bayes_factor: float
    """Over the fit without it, less what it gains by chance [nat]; see `EffectScore.by_chance`."""


@dataclass(frozen=True, slots=True)
class Step:
    """One round: every absent effect scored, the best refitted."""

    before: Fit
    information: EffectInformation | None
    """Of the pushes about the absent effects."""
    scores: tuple[EffectScore, ...]
    candidates: tuple[Candidate, ...]
    """Refitted effects, the best first."""

    @property
    def best(self) -> Candidate | None:
        """The refitted effect with the largest log Bayes factor, or its special case in a tie."""
        return self.candidates[0] if self.candidates else None

    @property
    def log_bayes_factor(self) -> float:
        """The largest of all refitted effects [nat]: that something acts, whichever is named."""
        return max((candidate.log_bayes_factor for candidate in self.candidates), default=-np.inf)


@dataclass(frozen=True, slots=True)
class RivalFit:
    """A fit with another effect in place of one that was found."""

    name: str
    """Of the rival."""
    replaces: str
    """The effect that was found."""
    fit: Fit
    """With the rival in its place."""
    deficit: float
    """Log evidence by which it is behind [nat]."""
    deficit_std: float
    """Standard error of that, by how much it differs from push to push [nat]: laws and discrepancy are not exactly those of the world, so
    that on as many other pushes it would be another one (Vuong, Likelihood ratio tests for model selection and non-nested hypotheses,
    Econometrica 1989)."""

    @classmethod
    def of(cls, name: str, replaces: str, fit: Fit, selected: Fit, deficit: float) -> RivalFit:
        """`selected`: the fit with the effect that was found, of which the rival's `fit` is behind by `deficit` [nat]."""
        difference = selected.push_log_densities - fit.push_log_densities
        return cls(name, replaces, fit, deficit, float(np.std(difference, ddof=1)) * len(difference) ** 0.5)


@dataclass(frozen=True, slots=True)
class Selection:
    """The effects that were found, one a step."""

    base: Fit
    fit: Fit
    """With all effects that were found."""
    steps: tuple[Step, ...] = field(default=())
    """The last one found nothing more, unless the number of effects was the limit."""
    swaps: tuple[RivalFit, ...] = field(default=())
    """Rivals of effects other than the last one, each fitted beside all others that were found."""

    @property
    def selected(self) -> tuple[str, ...]:
        """Effects beyond those of the base."""
        return tuple(name for name in self.fit.names if name not in self.base.names)

    @property
    def added(self) -> dict[str, tuple[Step, Candidate]]:
        """Of each effect that was found, in the order in which they were added: its step, and the effect as it was refitted there.

        An effect that took the place of another one has that one's step.
        """
        numbered = [(number, candidate) for number, step in enumerate(self.steps) for candidate in step.candidates]
        # The last step counts of which an effect is the best: it may have been replaced, and added again.
        chosen = {c.name: (n, c) for n, c in numbered if c is self.steps[n].best and c.name in self.selected}
        for name in self.selected:
            if name not in chosen:
                taken = {number for number, _ in chosen.values()}
                refitted = [(n, c) for n, c in numbered if c.name == name]
                chosen[name] = next((found for found in refitted if found[0] not in taken), refitted[-1])
        return {name: (self.steps[number], candidate) for name, (number, candidate) in sorted(chosen.items(), key=lambda item: item[1][0])}

    @property
    def smallest_detectable(self) -> dict[str, float]:
        """Size of each effect that would be detected on average beside all that were found before, in its unit; infinite where none."""
        return {score.name: score.smallest_detectable for step in self.steps for score in step.scores}

    @property
    def stages(self) -> dict[str, Fit]:
        """Fits with some of the effects that were found, by their names, in the order in which they were added."""
        parts = {tuple(name for name in step.before.names if name not in self.base.names): step.before for step in self.steps}
        return {", ".join(names): fit for names, fit in parts.items() if names and set(names) < set(self.selected)}

    def until(self, stage: int) -> Selection:
        """What was found before a stage, by its number: 0 for the base only."""
        fit = [self.base, *self.stages.values(), self.fit][stage]
        n_steps = next((number for number, step in enumerate(self.steps, 1) if step.before is fit), len(self.steps))
        return Selection(self.base, fit, self.steps[:n_steps])

    def without_effects(self) -> Selection:
        """The base only, with all steps that were made."""
        return Selection(self.base, self.base, self.steps)

    @property
    def rivals(self) -> tuple[RivalFit, ...]:
        """Of the last effect, the nearest first, then of those before it. An effect that contains the found one as a special case is
        none."""
        if not self.selected:
            return ()
        step, last = list(self.added.values())[-1]
        of_last = [
            RivalFit.of(c.name, last.name, c.fit, last.fit, last.log_bayes_factor - c.log_bayes_factor)
            for c in step.candidates
            if c is not last
        ]
        return tuple(
            r for r in (*of_last, *self.swaps) if r.name not in self.selected and r.name not in EFFECTS[r.replaces].special_case_of
        )

    def tied_rivals(self, policy: SelectionPolicy) -> tuple[RivalFit, ...]:
        """Rivals that explain the pushes nearly as well."""
        return tuple(rival for rival in self.rivals if rival.deficit < self.margin(rival, policy))

    def margin(self, rival: RivalFit, policy: SelectionPolicy) -> float:
        """Deficit at which a rival is excluded [nat]: such that other pushes would hardly turn it round, too."""
        of_law = policy.tie_margin_of(EFFECTS[rival.name].law, self.added[rival.replaces][1].log_bayes_factor)
        return max(of_law, policy.min_deficit_standard_errors * rival.deficit_std)

    def special_cases(self, tie_margin: float) -> dict[str, str]:
        """Of effects that were found: one that contains it as a special case and explains the pushes no better."""
        return {
            name: other.name
            for name, (step, candidate) in self.added.items()
            for other in step.candidates
            if other.name in EFFECTS[name].special_case_of and other.log_bayes_factor > candidate.log_bayes_factor - tie_margin
        }
