"""From evidence to probabilities: what is there, if everything that was considered is one of the explanations.

An explanation is a set of effects of the catalogue, with or without a free law of a mechanism or something else. Its weight is

    w = prior * exp(sum of B_k / tau_k)

with the log Bayes factors B_k of what it contains, each over what was found before it. tau >= 1 is the discrepancy of evidence: residuals
of pushing are neither independent nor exactly normal, and laws of friction are not exactly those of the world, so that differences of log
evidence are larger than what they are worth. Dividing them by tau is a power likelihood (Holmes & Walker, Assigning a value to a power
likelihood in a general Bayesian model, Biometrika 2017).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np
from scipy.special import logsumexp

from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.something_else.evidence import SomethingElse
from push_ident.physics.effect import Law, Mechanism, Subsystem
from push_ident.physics.effects import CAUSES, EFFECTS, FORCE_CAUSES

_T = TypeVar("_T")

SOMETHING_ELSE = "something_else"
"""Name of a cause outside the catalogue among those of effects."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """A set of causes, with the logarithm of its weight."""

    causes: frozenset[str]
    log_weight: float
    imitated_by: frozenset[str] = frozenset()
    """Effects whose evidence something else made, in this explanation."""
    free: str = ""
    """The mechanism of one of its causes that acts by a free law."""


@dataclass(frozen=True, slots=True)
class OutsideEvidence:
    """Evidence of free laws by their mechanism, and of something else, after its discrepancy [nat]."""

    in_place: Mapping[str, float]
    """In place of all selected effects."""
    in_addition: Mapping[str, float]
    """In addition to them."""
    as_law: Mapping[str, float] = field(default_factory=dict)
    """Of free laws in addition to an effect of their mechanism, which then acts by another law; among those of the mechanism."""

    @classmethod
    def of(
        cls,
        in_place: SomethingElse | None,
        in_addition: SomethingElse | None,
        residuals: Sequence[float],
        policy: SelectionPolicy,
        *,
        named: float = 0.0,
    ) -> OutsideEvidence:
        """From the search for patterns, and from residuals or a discrepancy that are too large without one.

        Args:
            in_place: structure in the residuals of the base model; None where it could not be looked for.
            in_addition: the same in the residuals of the fit with all selected effects.
            residuals: p-values of failed tests of the residuals of the fit with all selected effects: a structure that follows none of the
                patterns. A p-value p is worth at most the Bayes factor -1 / (e p log p) (Sellke, Bayarri & Berger,
                Calibration of p values, The American Statistician 2001).
            policy: discrepancy of the evidence.
            named: log Bayes factors of all effects that were found together [nat]: the error of their laws looks like something else, and
                grows with them.
        """
        bound = max((-math.log(-math.e * p * math.log(p)) for p in residuals if p < 1.0 / math.e), default=-math.inf)
        discrepancy = policy.discrepancy_something_else
        discrepancy_in_addition = max(discrepancy, policy.discrepancy_something_else_share * named)
        kept = int(in_place is not None and not _is_probable_without_each_fold(in_place, policy))
        return cls(
            _evidence(in_place, bound, lambda found, mechanism: found.log_bayes_factors(mechanism)[kept], discrepancy),
            _evidence(in_addition, bound, lambda found, mechanism: found.log_bayes_factors(mechanism)[0], discrepancy_in_addition),
            {} if in_addition is None else {m.value: in_addition.log_bayes_factor_as_law(m) for m in in_addition.mechanisms},
        )


def _evidence(
    found: SomethingElse | None, bound: float, of: Callable[[SomethingElse, Mechanism | None], float], discrepancy: float
) -> dict[str, float]:
    """Of every mechanism that has a free law, and of something else [nat]; `bound`: of the latter, from the size of the residuals."""
    if found is None:
        return {SOMETHING_ELSE: max(bound, 0.0)}

    def among_all(mechanism: Mechanism | None) -> float:
        # Errors of laws and of noise bring evidence for a structure, and take none away.
        value = of(found, mechanism)
        return (value / discrepancy if value > 0.0 else value) - math.log(2)

    laws = {mechanism.value: among_all(mechanism) for mechanism in found.mechanisms}
    of_none = max(bound, found.of_discrepancy) - math.log(2)
    return {**laws, SOMETHING_ELSE: float(np.logaddexp(among_all(None), of_none))}


def _is_probable_without_each_fold(found: SomethingElse, policy: SelectionPolicy) -> bool:
    """Whether something is more probable than nothing without any one fold of the pushes.

    Where it is not, the pushes of that fold made the evidence: something happened to them, or they lie at the edge between sticking and
    sliding, where small causes decide where the object goes. Only what is left without them counts then, in place of effects. Beside
    effects that were found something acts in any case.
    """
    return policy.log_prior_something_else + found.least / policy.discrepancy_something_else > 0.0


@dataclass(frozen=True, slots=True)
class Probabilities:
    """Of everything that may be there beside the base model."""

    nothing: float
    something_else: float
    """That a cause outside the catalogue acts, alone or beside effects."""
    effects: Mapping[str, float]
    """That an effect acts, alone or beside others; of all effects of the catalogue that the base model does not have."""
    subsystems: Mapping[Subsystem, float] = field(default_factory=dict)
    """That some effect of a part of the cell acts."""
    mechanisms: Mapping[str, float] = field(default_factory=dict)
    """That a mechanism acts, by whatever law."""
    free: Mapping[str, float] = field(default_factory=dict)
    """That it acts by a free law."""
    in_place_of_effects: Mapping[str, float] = field(default_factory=dict)
    """That only a free law of a mechanism of no effect that was found acts, or only something else, and no effect is an imitation of it."""
    outside_alone: float = 0.0
    """That only a cause outside the catalogue acts, imitated by effects or not."""
    beyond_effects: float = 0.0
    """That something else acts, or a mechanism of no effect that was found."""

    def acts_freely(self, mechanism: str) -> bool:
        """Whether a mechanism, if it acts, rather does so by a free law."""
        return self.free.get(mechanism, 0.0) > 0.5 * self.mechanisms.get(mechanism, 1.0)


def explanations_of(
    selection: Selection,
    outside: OutsideEvidence,
    policy: SelectionPolicy,
    *,
    rejected: Mapping[str, float] | None = None,
    closes_error: bool = False,
) -> tuple[Explanation, ...]:
    """All explanations that were considered, with their weights.

    `rejected`: log Bayes factors [nat] of effects in the pushes that do not support them: no effect that was not added has more.
    `closes_error`: whether held-out pushes are certainly nearer to their prediction with the selected effects.
    """
    names: list[str] = []
    weight = 0.0
    named: list[Explanation] = []
    for name, (_, candidate) in selection.added.items():
        weight += policy.log_prior_effect + candidate.log_bayes_factor / _discrepancy(names, selection, policy)
        names.append(name)
        named.append(Explanation(frozenset(names), weight))
    for rival in selection.rivals:
        causes = frozenset(name for name in names if name != rival.replaces) | {rival.name}
        named.append(Explanation(causes, weight - rival.deficit * policy.log_cost_wrong_name / selection.margin(rival, policy)))
    named += _twins(names, weight, named)
    law_of = {mechanism: frozenset(n for n in names if EFFECTS[n].mechanism == mechanism) for mechanism in outside.in_place}
    in_place = [
        # Where the law of an effect that was found is free, the effect still acts.
        Explanation(law_of[cause] or frozenset({cause}), policy.log_prior_something_else + value, free=_free(cause))
        for cause, value in outside.in_place.items()
    ]
    if names:
        named += [
            # Beforehand as probable as the law of the effect.
            Explanation(frozenset(names), weight + outside.as_law[cause], free=cause)
            if law_of.get(cause)
            else Explanation(frozenset([*names, cause]), weight + policy.log_prior_something_else + value, free=_free(cause))
            for cause, value in outside.in_addition.items()
        ]
    return (
        Explanation(frozenset(), 0.0),
        *in_place,
        *_with_imitations(named, policy, closes_error=closes_error),
        *_not_added(selection, weight, policy, rejected or {}),
    )


def _free(cause: str) -> str:
    return "" if cause == SOMETHING_ELSE else cause


def probabilities_of(explanations: tuple[Explanation, ...], base_effects: tuple[str, ...]) -> Probabilities:
    """Probability of each cause: of all explanations together that contain it."""
    weights = np.array([e.log_weight for e in explanations])
    shares = np.exp(weights - logsumexp(weights))

    def where(holds: Callable[[Explanation], bool]) -> float:
        return float(min(1.0, sum(share for e, share in zip(explanations, shares, strict=True) if holds(e))))

    def by_name(names: Iterable[_T], holds: Callable[[Explanation, _T], bool]) -> dict[_T, float]:
        return {name: where(partial(lambda name, e: holds(e, name), name)) for name in names}

    considered = {name for explanation in explanations for name in explanation.causes}
    names = (*CAUSES, *(name for name in FORCE_CAUSES if name in considered))
    mechanisms = sorted({mechanism_of(name) for name in (*names, *considered)} - {SOMETHING_ELSE})
    not_effects = considered - EFFECTS.keys()
    return Probabilities(
        nothing=where(lambda e: not e.causes),
        something_else=where(lambda e: SOMETHING_ELSE in e.causes),
        effects=by_name((name for name in names if name not in base_effects), lambda e, name: name in e.causes),
        subsystems=by_name(Subsystem, lambda e, part: part in map(_part_of, e.causes)),
        mechanisms=by_name(mechanisms, lambda e, name: name in map(mechanism_of, e.causes)),
        free=by_name(mechanisms, lambda e, name: e.free == name),
        in_place_of_effects=by_name(sorted(not_effects), lambda e, name: e.causes == {name} and not e.imitated_by),
        outside_alone=where(lambda e: e.causes == {SOMETHING_ELSE}),
        beyond_effects=where(lambda e: bool(e.causes & not_effects)),
    )


def mechanism_of(cause: str) -> str:
    """Of an effect, of a free law, whose name it is, or of something else."""
    return EFFECTS[cause].mechanism if cause in EFFECTS else cause


def _part_of(cause: str) -> Subsystem | None:
    """Where a cause acts; None for something else."""
    if cause in EFFECTS:
        return EFFECTS[cause].subsystem
    return None if cause == SOMETHING_ELSE else Mechanism(cause).subsystem


def is_outside(probabilities: Probabilities, policy: SelectionPolicy) -> bool:
    """Whether no effect is reported: probably a free law or something else acts in place of all of them, and something does.

    Beside effects that explain more it is the remainder that real pushes always hold: the effects are named, and it stays possible.
    """
    return sum(probabilities.in_place_of_effects.values()) > 0.5 and probabilities.nothing < policy.max_probability_of_nothing


def _twins(names: Sequence[str], weight: float, others: Sequence[Explanation]) -> list[Explanation]:
    """Exact twins in place of effects that were found, which no push distinguishes from them."""
    explained = {explanation.causes for explanation in others}
    twins = [frozenset(twin if n == name else n for n in names) for name in names for twin in EFFECTS[name].exact_twins]
    return [Explanation(causes, weight) for causes in twins if causes not in explained and len(causes) == len(names)]


def _with_imitations(explanations: Sequence[Explanation], policy: SelectionPolicy, *, closes_error: bool) -> list[Explanation]:
    """Explanations by effects, of each of which a part says that something else is there in their place, which they imitate.

    What leaves a structure is rather an imitation where it does not predict other pushes better.
    """
    in_part = policy.imitated_wholly if closes_error else policy.imitated_in_part
    split: list[Explanation] = []
    for one in explanations:
        effects = frozenset(cause for cause in one.causes if cause in EFFECTS)
        imitated = policy.imitated_wholly if effects == one.causes else in_part
        other = Explanation(frozenset({SOMETHING_ELSE}), one.log_weight + math.log(imitated), effects)
        split += [replace(one, log_weight=one.log_weight + math.log1p(-imitated)), other]
    return split


def _discrepancy(names: Sequence[str], selection: Selection, policy: SelectionPolicy) -> float:
    """Of the evidence of one more effect beside those that were found."""
    if not names:
        return policy.discrepancy_first
    added = selection.added
    approximate = sum(added[name][1].log_bayes_factor for name in names if EFFECTS[name].law is Law.APPROXIMATE)
    return max(policy.discrepancy_next, policy.discrepancy_next_share * approximate)


def _not_added(selection: Selection, weight: float, policy: SelectionPolicy, rejected: Mapping[str, float]) -> list[Explanation]:
    """Effects that were looked for beside those that were found, none of which was added."""
    step = next((step for step in selection.steps if step.before is selection.fit), None)
    if step is None:
        return []
    names = list(selection.selected)
    # Where refits do not keep what scores promise, those of others are worth no more.
    kept = max((max(candidate.log_bayes_factor, 0.0) for candidate in step.candidates), default=math.inf)
    evidence = {score.name: min(score.expected_log_bayes_factor, kept) for score in step.scores}
    evidence |= {candidate.name: candidate.log_bayes_factor for candidate in step.candidates}
    # The pushes that do not support an effect support none of its rivals more.
    limit = min(rejected.values(), default=math.inf)
    evidence = {name: min(value, limit) for name, value in evidence.items()}
    factor = _discrepancy(names, selection, policy)
    return [
        Explanation(frozenset([*names, name]), weight + policy.log_prior_effect + value / factor)
        for name, value in evidence.items()
        if name not in names
    ]
