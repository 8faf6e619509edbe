"""From evidence to probabilities: what is there, if everything that was considered is one of the explanations.

An explanation is a set of effects of the catalogue, with or without something else. Its weight is

    w = prior * exp(sum of B_k / tau_k)

with the log Bayes factors B_k of what it contains, each over what was found before it. tau >= 1 is the discrepancy of evidence: residuals
of pushing are neither independent nor exactly normal, and laws of friction are not exactly those of the world, so that differences of log
evidence are larger than what they are worth. Dividing them by tau is a power likelihood (Holmes & Walker, Assigning a value to a power
likelihood in a general Bayesian model, Biometrika 2017).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import logsumexp

from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.selection import RivalFit, Selection
from push_ident.diagnosis.something_else.evidence import SomethingElse
from push_ident.physics.effect import Law, Subsystem
from push_ident.physics.effects import CAUSES, EFFECTS, FORCE_CAUSES

SOMETHING_ELSE = "something_else"
"""Name of a cause outside the catalogue among those of effects."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """A set of causes, with the logarithm of its weight."""

    causes: frozenset[str]
    log_weight: float
    imitated_by: frozenset[str] = frozenset()
    """Effects whose evidence something else made, in this explanation."""


@dataclass(frozen=True, slots=True)
class OutsideEvidence:
    """Evidence of something else, after its discrepancy [nat]."""

    in_place: float
    """Of something else in place of all selected effects."""
    in_addition: float
    """Of something else in addition to them."""

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
        """From the search for patterns, and from residuals that are too large without one.

        Args:
            in_place: structure in the residuals of the base model; None where it could not be looked for.
            in_addition: the same in the residuals of the fit with all selected effects.
            residuals: p-values of failed tests of the residuals of the fit with all selected effects: a structure that follows none of the
                patterns, one family more. A p-value p is worth at most the Bayes factor -1 / (e p log p) (Sellke, Bayarri & Berger,
                Calibration of p values, The American Statistician 2001).
            policy: discrepancy of the evidence.
            named: log Bayes factors of all effects that were found together [nat]: the error of their laws looks like something else, and
                grows with them.
        """
        bound = max((-math.log(-math.e * p * math.log(p)) for p in residuals if p < 1.0 / math.e), default=0.0)

        def both(something_else: SomethingElse | None, log_bayes_factor: float, discrepancy: float) -> float:
            if something_else is None:
                return bound
            n = len(something_else.patterns)
            # Errors of laws and of noise bring evidence for a structure, and take none away.
            log_bayes_factor = log_bayes_factor / discrepancy if log_bayes_factor > 0.0 else log_bayes_factor
            return float(np.logaddexp(log_bayes_factor + math.log(n), bound) - math.log(n + 1))

        discrepancy = policy.discrepancy_something_else
        discrepancy_in_addition = max(discrepancy, policy.discrepancy_something_else_share * named)
        return cls(
            both(in_place, 0.0 if in_place is None else _evidence_in_place(in_place, policy), discrepancy),
            both(in_addition, 0.0 if in_addition is None else in_addition.log_bayes_factor, discrepancy_in_addition),
        )


def _evidence_in_place(something_else: SomethingElse, policy: SelectionPolicy) -> float:
    """Log Bayes factor of something else against nothing [nat]: the one without a fold where nothing is more probable without it.

    The pushes of that fold then made the evidence: something happened to them, or they lie at the edge between sticking and sliding, where
    small causes decide where the object goes. Beside effects that were found something acts in any case.
    """
    is_carried = policy.log_prior_something_else + something_else.least / policy.discrepancy_something_else > 0.0
    return something_else.log_bayes_factor if is_carried else something_else.least


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
    outside_alone: float = 0.0
    """That only a cause outside the catalogue acts."""
    outside_alone_unlike_effects: float = 0.0
    """The same, and no effect that was found is an imitation of it."""


def explanations_of(
    selection: Selection,
    outside: OutsideEvidence,
    policy: SelectionPolicy,
    *,
    rejected: Mapping[str, float] | None = None,
    closed: float = 0.0,
) -> tuple[Explanation, ...]:
    """All explanations that were considered, with their weights.

    `rejected`: log Bayes factors [nat] of effects in the pushes that do not support them: no effect that was not added has more.
    `closed`: part of the gap that the selected effects close on held-out pushes [1].
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
        named.append(Explanation(causes, weight - rival.deficit / _rivalry(rival, selection, policy)))
    named += _twins(names, weight, named)
    if names:
        named.append(Explanation(frozenset([*names, SOMETHING_ELSE]), weight + policy.log_prior_something_else + outside.in_addition))
    nothing = Explanation(frozenset(), 0.0)
    other = Explanation(frozenset({SOMETHING_ELSE}), policy.log_prior_something_else + outside.in_place)
    return (nothing, other, *_with_imitations(named, closed, policy), *_not_added(selection, weight, policy, rejected or {}))


def probabilities_of(explanations: tuple[Explanation, ...], base_effects: tuple[str, ...]) -> Probabilities:
    """Probability of each cause: of all explanations together that contain it."""
    weights = np.array([e.log_weight for e in explanations])
    shares = np.exp(weights - logsumexp(weights))

    def of(name: str) -> float:
        return float(min(1.0, sum(share for e, share in zip(explanations, shares, strict=True) if name in e.causes)))

    nothing = float(sum(share for e, share in zip(explanations, shares, strict=True) if not e.causes))
    outside_only = [(share, e.imitated_by) for e, share in zip(explanations, shares, strict=True) if e.causes == {SOMETHING_ELSE}]
    outside_alone = float(sum(share for share, _ in outside_only))
    unlike = float(sum(share for share, imitated_by in outside_only if not imitated_by))

    def of_part(part: Subsystem) -> float:
        acts = (any(name != SOMETHING_ELSE and EFFECTS[name].subsystem is part for name in e.causes) for e in explanations)
        return float(min(1.0, sum(share for share, here in zip(shares, acts, strict=True) if here)))

    subsystems = {part: of_part(part) for part in Subsystem}
    considered = {name for explanation in explanations for name in explanation.causes}
    names = (*CAUSES, *(name for name in FORCE_CAUSES if name in considered))
    effects = {name: of(name) for name in names if name not in base_effects}
    return Probabilities(nothing, of(SOMETHING_ELSE), effects, subsystems, outside_alone, unlike)


def is_outside(probabilities: Probabilities, policy: SelectionPolicy) -> bool:
    """Whether only a cause outside the catalogue is reported: probably it acts in place of all effects, and something does.

    Beside effects that explain more it is the remainder that real pushes always hold: the effects are named, and it stays possible.
    """
    return probabilities.outside_alone_unlike_effects > 0.5 and probabilities.nothing < policy.max_probability_of_nothing


def _twins(names: Sequence[str], weight: float, others: Sequence[Explanation]) -> list[Explanation]:
    """Exact twins in place of effects that were found, which no push distinguishes from them."""
    explained = {explanation.causes for explanation in others}
    twins = [frozenset(twin if n == name else n for n in names) for name in names for twin in EFFECTS[name].exact_twins]
    return [Explanation(causes, weight) for causes in twins if causes not in explained and len(causes) == len(names)]


def _with_imitations(explanations: Sequence[Explanation], closed: float, policy: SelectionPolicy) -> list[Explanation]:
    """Explanations by effects, of each of which a part says that something else is there in their place, which they imitate.

    What leaves a structure is the less probably an imitation, the more of the gap it closes.
    """
    in_part = max(policy.imitated_wholly, policy.imitated_in_part * (1.0 - closed))
    split: list[Explanation] = []
    for one in explanations:
        imitated = in_part if SOMETHING_ELSE in one.causes else policy.imitated_wholly
        other = Explanation(frozenset({SOMETHING_ELSE}), one.log_weight + math.log(imitated), one.causes - {SOMETHING_ELSE})
        split += [replace(one, log_weight=one.log_weight + math.log1p(-imitated)), other]
    return split


def _discrepancy(names: Sequence[str], selection: Selection, policy: SelectionPolicy) -> float:
    """Of the evidence of one more effect beside those that were found."""
    if not names:
        return policy.discrepancy_first
    added = selection.added
    approximate = sum(added[name][1].log_bayes_factor for name in names if EFFECTS[name].law is Law.APPROXIMATE)
    return max(policy.discrepancy_next, policy.discrepancy_next_share * approximate)


def _rivalry(rival: RivalFit, selection: Selection, policy: SelectionPolicy) -> float:
    """Discrepancy of the difference of evidence between a rival and the effect that was found."""
    if EFFECTS[rival.name].law is Law.EXACT:
        return policy.discrepancy_rivals
    return max(policy.discrepancy_rivals, policy.discrepancy_rivals_share * selection.added[rival.replaces][1].log_bayes_factor)


def _not_added(selection: Selection, weight: float, policy: SelectionPolicy, rejected: Mapping[str, float]) -> list[Explanation]:
    """Effects that were looked for beside those that were found, none of which was added."""
    step = next((step for step in selection.steps if step.before is selection.fit), None)
    if step is None:
        return []
    names = list(selection.selected)
    evidence = {score.name: score.expected_log_bayes_factor for score in step.scores}
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
