"""A diagnosis in words, for an engineer without a background in statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.policy import UnknownPolicy
from push_ident.diagnosis.residual_groups import ResidualGroup
from push_ident.diagnosis.residuals import FrameResiduals
from push_ident.diagnosis.result import FoundEffect
from push_ident.diagnosis.unknown import SmoothWrench
from push_ident.physics.effects import EFFECTS
from push_ident.physics.effects.unknown_wrench import COMPONENTS

__all__ = [
    "describe_wrench", "sentence_of_effects", "sentence_of_negligible", "sentence_of_nothing", "sentence_of_outliers",
    "sentence_of_unknown", "sentence_of_unsupported", "size_of",
]  # fmt: skip

_SHOWN_IN = {"m": (1e3, "mm"), "rad": (180.0 / np.pi, "deg"), "s": (1e3, "ms")}
"""Everyday units of an effect's size, with their factor."""


def sentence_of_nothing(gap: Gap) -> str:
    """Of a diagnosis that found no gap."""
    before, _, noise = _millimetres(gap)
    share = f"noise of the poses accounts for {noise:.1f} mm of it"
    if noise > before:
        share = f"noise of the poses can cause {noise:.1f} mm"
    return f"No gap beyond noise: the mean error on held-out pushes is {before:.1f} mm, and {share}."


def sentence_of_effects(effects: Sequence[FoundEffect], confusion_sets: Mapping[str, Sequence[str]], gap: Gap) -> str:
    """Of a diagnosis that names causes.

    Args:
        effects: that were found, at least one.
        confusion_sets: names of those that may be there in place of some of them.
        gap: with the effects.
    """
    causes = "; and ".join(f"{_plain(e.name)} ({e.name}: {size_of(e)})" for e in effects)
    ties = "".join(f" These pushes cannot distinguish {name} from {' or '.join(names)}." for name, names in confusion_sets.items())
    added = "this effect" if len(effects) == 1 else "these effects"
    return f"The simulation leaves out that {causes}.{ties} {_outcome(f'With {added} added', gap)}"


def sentence_of_unknown(
    gap: Gap,
    wrench: SmoothWrench | None,
    residuals: FrameResiduals,
    where: Mapping[str, Sequence[ResidualGroup]],
    policy: UnknownPolicy,
) -> str:
    """Of a diagnosis whose cause is not in the catalogue.

    Args:
        gap: with the smooth wrench, where there is one.
        wrench: in place of the cause; None where none explains it.
        residuals: beside all effects that could be named.
        where: residuals of the base model in groups.
        policy: which parts of the wrench are described.
    """
    if wrench is not None:
        outcome = _outcome("With a smooth force in its place", gap)
        return f"The simulation leaves out something outside the catalogue of effects: it {describe_wrench(wrench, policy)}. {outcome}"
    before, _, noise = _millimetres(gap)
    _, by, name = max((max(group.rms), by, group.name) for by, groups in where.items() for group in groups)
    ratio, (autocorrelation, _) = residuals.residual_ratio[0], residuals.excess_autocorrelation
    trace = f"residuals are {np.sqrt(ratio):.1f} times as large as those of a correct model"
    if ratio < 1.0 or autocorrelation > ratio - 1.0:
        trace = f"{100.0 * autocorrelation / ratio:.0f} % of the squared residuals continue from frame to frame, unlike noise"
    return (
        f"The simulation leaves out something outside the catalogue of effects, and no smooth force explains it: {trace}. Residuals are "
        f"largest for {by.replace('_', ' ')} {name}. The mean error on held-out pushes is {before:.1f} mm; {_noise(noise)}."
    )


def sentence_of_unsupported(name: str, pushes: Sequence[str]) -> str:
    """Added to the sentence where an effect is rejected because only one push supports it.

    Args:
        name: of the effect.
        pushes: those that support it.
    """
    support, those = ("supports", "that push") if len(pushes) == 1 else ("support", "those pushes")
    return f" Only {' and '.join(pushes)} {support} {name}, so that it is not reported: repeat {those}."


def sentence_of_negligible(effects: Sequence[FoundEffect]) -> str:
    """Added to the sentence where effects below the accuracy of a cell were detected, at least one."""
    detected = "; ".join(f"{_plain(e.name)} ({e.name}: {size_of(e)})" for e in effects)
    return f" Detected but negligible, below the accuracy of a cell: {detected}."


def sentence_of_outliers(pushes: Sequence[str]) -> str:
    """Added to the sentence where some pushes of an object that a camera traced were set aside, at least one."""
    disagree, they = ("disagrees with all others and was", "it") if len(pushes) == 1 else ("disagree with all others and were", "they")
    named = " and ".join(pushes)
    return f" {named[0].upper()}{named[1:]} {disagree} set aside: compare the traced outline with the object where {they} touched it."


def describe_wrench(wrench: SmoothWrench, policy: UnknownPolicy) -> str:
    """What a wrench acts as, and what it varies with, to continue "it"."""
    on, by = (
        [name for name, share in sorted(shares.items(), key=lambda item: -item[1]) if share >= policy.min_described_share]
        or [max(shares, key=lambda n: shares[n])]
        for shares in (wrench.acts_on, wrench.varies_with)
    )
    varying = [name for name in by if name != "even"]
    acts = f"acts as a {' and a '.join(COMPONENTS[name] for name in on)}"
    return f"{acts}, and varies with the {' and the '.join(varying)}" if varying else acts


def size_of(effect: FoundEffect) -> str:
    """Sizes with their standard deviation, in everyday units."""
    parts = []
    for parameter in EFFECTS[effect.name].parameters:
        if not parameter.shape:
            factor, unit = _SHOWN_IN.get(parameter.unit, (1.0, parameter.unit))
            value, std = factor * effect.parameters[parameter.name], factor * effect.std[parameter.name]
            parts.append(f"{parameter.name} {value:.3g} ± {std:.2g} {unit}".rstrip())
    return ", ".join(parts)


def _outcome(added: str, gap: Gap) -> str:
    before, after, noise = _millimetres(gap)
    if after < before:
        change = f"the mean error on held-out pushes falls from {before:.1f} to {after:.1f} mm"
    else:
        change = f"held-out pushes are predicted no better ({after:.1f} mm, {before:.1f} mm without)"
    return f"{added}, {change}; {_noise(noise)}."


def _noise(noise: float) -> str:
    return f"noise of the poses accounts for {noise:.1f} mm"


def _plain(name: str) -> str:
    """What an effect is, to continue a sentence."""
    what = EFFECTS[name].what.rstrip(".")
    return what[0].lower() + what[1:]


def _millimetres(gap: Gap) -> tuple[float, float, float]:
    before, after, noise = (1e3 * float(np.mean(v)) for v in (gap.before, gap.after, gap.noise))
    return before, after, noise
