"""A diagnosis in words, for an engineer who knows nothing of statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.residuals import Frames, Group
from push_ident.diagnosis.unknown import SmoothWrench
from push_ident.diagnosis.verdict import FoundEffect
from push_ident.physics.effects import EFFECTS

__all__ = [
    "sentence_of_effects", "sentence_of_lone", "sentence_of_nothing", "sentence_of_odd", "sentence_of_trifles", "sentence_of_unknown",
    "size_of",
]  # fmt: skip

_SHOWN_IN = {"m": (1e3, "mm"), "rad": (180.0 / np.pi, "deg"), "s": (1e3, "ms")}
"""Units in which people think of an effect's size, with their factor."""


def sentence_of_nothing(gap: Gap) -> str:
    """Of a diagnosis that found no gap."""
    before, _, noise = _millimetres(gap)
    share = f"and {noise:.1f} mm of that are the noise of the poses"
    if noise > before:
        share = f"less than the {noise:.1f} mm that the noise of the poses alone may make"
    return f"No gap beyond noise: pushes that the simulation was not fitted to are predicted to {before:.1f} mm, {share}."


def sentence_of_effects(effects: Sequence[FoundEffect], doubts: Mapping[str, Sequence[str]], gap: Gap) -> str:
    """Of a diagnosis that names causes.

    Args:
        effects: that were found, at least one.
        doubts: names of those that may be there in place of some of them.
        gap: with the effects.
    """
    causes = "; and ".join(f"{_plain(e.name)} ({e.name}: {size_of(e)})" for e in effects)
    doubt = ""
    if doubts:
        instead = [
            f"it is {' or '.join(names)} instead" if len(effects) == 1 else f"in place of {name} it is {' or '.join(names)}"
            for name, names in doubts.items()
        ]
        doubt = f" (or {', or '.join(instead)}: these pushes cannot tell)"
    return f"The simulation leaves out that {causes}{doubt}. {_outcome('With that added', gap)}"


def sentence_of_unknown(gap: Gap, wrench: SmoothWrench | None, rest: Frames, where: dict[str, list[Group]]) -> str:
    """Of a diagnosis that found something it has no name for.

    Args:
        gap: with the smooth wrench, where there is one.
        wrench: that stands for the cause; None where none does.
        rest: what all that could be named leaves.
        where: the residuals in groups.
    """
    if wrench is not None:
        return (
            f"The simulation leaves out something that is not in the catalogue: it {wrench.description}. "
            f"{_outcome('With a smooth force in its place', gap)}"
        )
    before, _, noise = _millimetres(gap)
    _, by, name = max((max(group.rms), by, group.name) for by, groups in where.items() for group in groups)
    leftover, (lasting, _) = rest.misfit[0], rest.persistence
    trace = f"residuals are {np.sqrt(leftover):.1f} times those of a model that is right"
    if leftover < 1.0 or lasting > leftover - 1.0:
        trace = f"{100.0 * lasting / leftover:.0f} % of the residuals go on from frame to frame, which noise does not"
    return (
        f"The simulation leaves out something that is not in the catalogue, and no smooth force explains it either: {trace}, most by "
        f"{by.replace('_', ' ')} at {name}. Pushes that it was not fitted to are predicted to {before:.1f} mm; {noise:.1f} mm is what the "
        f"noise of the poses makes."
    )


def sentence_of_lone(name: str, pushes: Sequence[str]) -> str:
    """What is added to the sentence where an effect is not believed because nothing else bears it out.

    Args:
        name: of the effect.
        pushes: those that alone speak for it.
    """
    speak, those = ("speaks", "that push") if len(pushes) == 1 else ("speak", "those pushes")
    return f" Only {' and '.join(pushes)} {speak} for {name}, which is not believed until another push does: repeat {those}."


def sentence_of_trifles(trifles: Sequence[FoundEffect]) -> str:
    """What is added to the sentence where something was seen that is smaller than any cell is known.

    Args:
        trifles: at least one.
    """
    seen = "; ".join(f"{_plain(e.name)} ({e.name}: {size_of(e)})" for e in trifles)
    return f" {seen[0].upper()}{seen[1:]}, but by too little to matter."


def sentence_of_odd(pushes: Sequence[str]) -> str:
    """What is added to the sentence where some pushes of an object that a camera traced were set aside.

    Args:
        pushes: those, at least one.
    """
    go, they = ("goes its own way and was", "it") if len(pushes) == 1 else ("go their own way and were", "they")
    seen = " and ".join(pushes)
    return f" {seen[0].upper()}{seen[1:]} {go} set aside: hold the traced outline beside the object where {they} touched it."


def _outcome(added: str, gap: Gap) -> str:
    before, after, noise = _millimetres(gap)
    if after < before:
        change = f"the error on pushes that it was not fitted to falls from {before:.1f} to {after:.1f} mm"
    else:
        change = f"pushes that it was not fitted to are predicted no better ({after:.1f} mm, {before:.1f} without)"
    return f"{added}, {change}; {noise:.1f} mm is what the noise of the poses makes."


def size_of(effect: FoundEffect) -> str:
    """Sizes with their deviation, in units in which people think of them."""
    parts = []
    for parameter in EFFECTS[effect.name].parameters:
        if not parameter.shape:
            factor, unit = _SHOWN_IN.get(parameter.unit, (1.0, parameter.unit))
            value, std = factor * effect.parameters[parameter.name], factor * effect.std[parameter.name]
            parts.append(f"{parameter.name} {value:.3g} ± {std:.2g} {unit}".rstrip())
    return ", ".join(parts)


def _plain(name: str) -> str:
    """What an effect is, to go on with in a sentence."""
    what = EFFECTS[name].what.rstrip(".")
    return what[0].lower() + what[1:]


def _millimetres(gap: Gap) -> tuple[float, float, float]:
    before, after, noise = (1e3 * float(np.mean(v)) for v in (gap.before, gap.after, gap.noise))
    return before, after, noise
