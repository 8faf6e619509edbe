"""Effects: the smallest size that the pushes would show, from one fit, and the proof by injection into twins of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import brentq

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.scores import EffectInformation, EffectScore, effect_information, score_effects
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.verdict import Verdict
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.observing.observation import NoiseModel
from push_ident.physics.effect import Law
from push_ident.physics.effect_values import effect_values
from push_ident.physics.effects import EFFECTS
from push_ident.recovery.twins import twins_of
from push_ident.threads import map_in_threads
from push_ident.types import PushRecord

_LARGEST: Final = 20.0
"""Typical sizes up to which an effect is looked for [1]."""


@dataclass(frozen=True, slots=True)
class VisibleEffect:
    """An effect of the catalogue that these pushes could show."""

    name: str
    smallest: float
    """Size of its first parameter that a diagnosis would detect on average, in its unit; infinite where none up to 20 typical ones."""
    typical: float
    """In practice, in its unit."""

    @property
    def is_visible(self) -> bool:
        """Whether it would be detected at its typical size."""
        return self.smallest <= self.typical


@dataclass(frozen=True, slots=True)
class Proof:
    """An effect that was put into twins of the pushes, and what a diagnosis of them said."""

    name: str
    size: float
    """Of its first parameter, in its unit."""
    outcome: str
    """`named`, `left open` (among others that the pushes cannot distinguish from it), `by its mechanism` or `not named`."""
    verdict: str
    """Of the diagnosis."""
    named: tuple[str, ...]
    """Effects that it named."""


def visible_effects(fit: Fit, policy: SelectionPolicy) -> list[VisibleEffect]:
    """Every effect that a fit does not have, the most visible one for its typical size first."""
    information = effect_information(fit)
    scores = score_effects(information, policy)
    return sorted(
        map_in_threads(lambda score: _visible(score, information, policy), scores), key=lambda e: (e.smallest / e.typical, e.name)
    )


def _visible(score: EffectScore, information: EffectInformation | None, policy: SelectionPolicy) -> VisibleEffect:
    effect = EFFECTS[score.name]
    first = effect.parameters[0]
    typical = abs(first.typical - first.nominal)
    largest = min(_LARGEST * typical, max(abs(first.low), abs(first.high)))
    smallest = score.smallest_detectable
    if information is not None and information.linear is not None and smallest < largest:
        linear = information.linear
        acting = np.array([not p.shape for p in effect.parameters])
        new = linear.new[information.indices[score.name][acting]]
        pushes, index = linear.pushes.of_unknowns(np.r_[linear.fitted, new]), len(linear.fitted) + np.arange(len(new))

        def missing(log_size: float) -> float:
            at = np.array(pushes.at)
            at[index[0]] = np.exp(log_size) / first.scale
            return policy.min_log_bayes_factor - pushes.expected_gain(at, index)

        try:
            # Its score leaves out that a discrepancy grows where the effect is missing.
            if missing(np.log(smallest)) > 0.0:
                is_shown = missing(np.log(largest)) < 0.0
                smallest = float(np.exp(brentq(missing, np.log(smallest), np.log(largest), xtol=0.05))) if is_shown else np.inf
        except np.linalg.LinAlgError:
            pass
    if effect.law is Law.EXACT:  # smaller ones are negligible
        smallest = max(smallest, policy.negligible.get(first.unit, 0.0))
    return VisibleEffect(score.name, smallest if smallest <= largest else np.inf, typical)


def worth_proving(effects: Sequence[VisibleEffect]) -> list[VisibleEffect]:
    """The most and the least visible effect of those that are visible at their typical size, then one between them."""
    visible = [effect for effect in effects if effect.is_visible]
    return [visible[k] for k in dict.fromkeys((0, len(visible) - 1, len(visible) // 2))] if visible else []


def prove(
    records: Sequence[PushRecord],
    base: Fit,
    effect: VisibleEffect,
    noise: NoiseModel,
    settings: DiagnosisSettings,
    rng: np.random.Generator,
) -> Proof:
    """Put an effect at twice its smallest visible size into twins of the pushes, and diagnose them. Raises InputError as `twins_of`."""
    first, mechanics = EFFECTS[effect.name].parameters[0], base.mechanics
    size = float(np.clip(2.0 * effect.smallest, -np.inf, abs(first.high - first.nominal)))
    acting = effect_values((*base.names, effect.name))
    values = np.array(acting.values)
    for name in base.names:
        values[acting.slice_of(name)] = base.effects.values[base.effects.slice_of(name)]
    values[acting.slice_of(effect.name).start] += size
    acting = acting.with_values(values)
    twins = twins_of(records, replace(mechanics, effects=acting.of_poses, all_effects=acting), noise, rng)
    diagnosis = diagnose(twins, settings)
    return Proof(effect.name, size, _outcome(effect.name, diagnosis), diagnosis.verdict.value, tuple(e.name for e in diagnosis.effects))


def _outcome(name: str, diagnosis: Diagnosis) -> str:
    right = {name, *EFFECTS[name].exact_twins}
    if diagnosis.verdict in (Verdict.NAMED, Verdict.SEVERAL) and right.intersection(e.name for e in diagnosis.effects):
        return "named"
    if right.intersection((*(e.name for e in diagnosis.effects), *diagnosis.confusion_set)):
        return "left open"
    by_law = diagnosis.free_law is not None and diagnosis.free_law.mechanism.value == EFFECTS[name].mechanism
    return "by its mechanism" if by_law else "not named"
