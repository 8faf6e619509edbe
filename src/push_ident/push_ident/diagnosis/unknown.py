"""What no effect of the catalogue explains: a smooth wrench, what it acts on, and what it varies with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from push_ident.diagnosis.fits import EffectFit, fit_effects, held_at_zero
from push_ident.diagnosis.parallel import side_by_side
from push_ident.diagnosis.scores import information_beside, score_effects
from push_ident.diagnosis.settings import Thresholds
from push_ident.physics.effects.unknown_wrench import COMPONENTS, EFFECT, FEATURES

__all__ = ["SmoothWrench", "find_unknown"]

_PROMISING = -10.0
"""Expected gain of log evidence below which a refit is not worth its time [nat]: the score is of second order only."""
_CHOICE = 2.0
"""What a part costs for having been chosen among all [nat]."""
_STANDS_OUT = 0.2
"""Share of all that the wrench says from which a part of it is named."""


@dataclass(frozen=True, slots=True)
class SmoothWrench:
    """Maps and a smooth wrench that together fit the pushes."""

    fit: EffectFit
    """With those parts of the wrench that the pushes need."""
    gain: float
    """Of log evidence over the base model, less what its parts cost for having been chosen [nat]."""
    acts_on: dict[str, float]
    """Share of each component of the wrench, see `COMPONENTS`; they sum to 1."""
    varies_with: dict[str, float]
    """The same of each feature, see `FEATURES`."""

    @property
    def description(self) -> str:
        """In words: what it acts on, what it varies with."""
        on, by = (
            [name for name, share in sorted(shares.items(), key=lambda item: -item[1]) if share >= _STANDS_OUT]
            or [max(shares, key=lambda n: shares[n])]
            for shares in (self.acts_on, self.varies_with)
        )
        varying = [name for name in by if name != "even"]
        return f"acts as a {' and a '.join(COMPONENTS[name] for name in on)}" + (
            f", and varies with the {' and the '.join(varying)}" if varying else ""
        )


def find_unknown(base: EffectFit, thresholds: Thresholds) -> SmoothWrench | None:
    """Fit a smooth wrench in place of all effects that were added to `base`; None where there is no trace of one."""
    (score,) = score_effects(information_beside(base, (EFFECT.name,)), thresholds.seen) or (None,)
    if score is None or score.gain < _PROMISING:
        return None
    known = base.z[base.parameters.effect_slice]
    names = (*base.names, EFFECT.name)
    # The score's guess reaches far and may end in another valley than the way from zero.
    starts = [np.concatenate([known, start]) for start in (score.start, np.zeros_like(score.start))]
    fits = side_by_side(lambda start: fit_effects(base, names, start), starts)
    fit = max(fits, key=lambda fit: fit.log_evidence + _needed_parts(fit)[1])
    parts, _ = _needed_parts(fit)
    first = fit.parameters.effect_slice.start + fit.parameters.effects.slice_of(EFFECT.name).start
    needless = [first + number for part, numbers in _blocks().items() if part not in parts for number in numbers]
    fit = held_at_zero(fit, needless)
    acts_on, varies_with = dict.fromkeys(COMPONENTS, 0.0), dict.fromkeys(FEATURES, 0.0)
    for (component, feature), share in parts.items():
        acts_on[component] += share
        varies_with[feature] += share
    return SmoothWrench(fit, fit.log_evidence - base.log_evidence - _CHOICE * len(parts), acts_on, varies_with)


def _needed_parts(fit: EffectFit) -> tuple[dict[tuple[str, str], float], float]:
    """The parts of the wrench that the pushes need, with the share of what each says, and the evidence that goes with the others.

    Around the fit the posterior is normal with covariance S. With the weights r of some parts held at zero the log evidence changes by
    -1/2 w_r' S_rr^-1 w_r - 1/2 log det S_rr, without another fit. Parts are taken away while that grows; each that stays costs as
    much as there was to choose from.
    """
    own = fit.parameters.effects.slice_of(EFFECT.name)
    first = fit.parameters.effect_slice.start
    place = slice(first + own.start, first + own.stop)
    weight, covariance = fit.z[place], fit.covariance[place, place]
    blocks = _blocks()

    def change(without: list[int]) -> float:
        if not without:
            return 0.0
        among = covariance[np.ix_(without, without)]
        w = weight[without]
        return float(-0.5 * w @ np.linalg.solve(among, w) - 0.5 * np.linalg.slogdet(among)[1])

    kept, best = dict(blocks), -_CHOICE * len(blocks)
    gone: list[int] = []
    while kept:
        value, part = max((change([*gone, *numbers]) - _CHOICE * (len(kept) - 1), part) for part, numbers in kept.items())
        if value <= best:
            break
        best = value
        gone += kept.pop(part)
    says = {part: max(change(gone) - change([*gone, *numbers]), 0.0) for part, numbers in kept.items()}
    total = max(sum(says.values()), 1e-9)
    return {part: share / total for part, share in says.items()}, best


def _blocks() -> dict[tuple[str, str], list[int]]:
    """Numbers of the weights of each part: a component and a feature."""
    blocks: dict[tuple[str, str], list[int]] = {}
    number = 0
    for component in COMPONENTS:
        for feature, functions in FEATURES.items():
            blocks[component, feature] = list(range(number, number + len(functions)))
            number += len(functions)
    return blocks
