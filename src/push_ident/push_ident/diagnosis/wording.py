"""A diagnosis in words, for an engineer without a background in statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from push_ident.diagnosis.account import Account, AccountPart
from push_ident.diagnosis.odds import SOMETHING_ELSE, Probabilities
from push_ident.diagnosis.residuals import FrameResiduals, ResidualGroup
from push_ident.diagnosis.something_else.words import PatternWords
from push_ident.diagnosis.verdict import FoundEffect, FreeLaw
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.physics.effect import Mechanism
from push_ident.physics.effects import EFFECTS

_MECHANISM_IN_WORDS = {
    Mechanism.FRICTION_BY_SPEED: "that friction depends on the speed",
    Mechanism.FRICTION_BY_PLACE: "that friction depends on the place on the table",
    Mechanism.FRICTION_BY_HEADING: "that friction depends on the direction of motion in the table",
    Mechanism.FRICTION_BY_HEADING_IN_OBJECT: "that friction depends on the direction of motion in the object",
    Mechanism.FRICTION_SINCE_CONTACT: "that friction changes after contact, with time or the way slid",
    Mechanism.FRICTION_BY_ORDER: "that friction changed in the course of the pushes",
    Mechanism.FORCE_ON_OBJECT: "a force on the object",
    Mechanism.OUTLINE: "that the surface which the pusher touches is not where the outline says",
    Mechanism.TOOL_MOVED: "that the tool, or the camera, was displaced in the course of the pushes",
    Mechanism.TOOL_WOBBLES: "that the tool leaves its reported path within each push",
}
"""To continue "leaves out"."""
_SHOWN_IN = {"m": (1e3, "mm"), "rad": (180.0 / np.pi, "°"), "s": (1e3, "ms")}
"""Everyday units of an effect's size, with their factor."""


def sentence_of_nothing(account: Account, sources: Sequence[str], first: PlannedPush | None = None) -> str:
    """Of a diagnosis that names nothing: no gap beyond noise, too few pushes to know, or an error that nothing explains.

    `sources`: of the pushes, in their order; `first`: the push that would teach most of the maps, where these are not known well enough.
    """
    error = f"the mean error of {in_mm(account.before)} on held-out pushes"
    if account.is_unexplained:
        part = account["unexplained"]
        largest = int(np.nanargmax(account.per_push["unexplained"]))
        return (
            f"Nothing is named, but of {error}, {in_mm(part.mean)} remain unexplained ({_interval(part)}), most in {sources[largest]} "
            f"({in_mm(account.per_push['unexplained'][largest])}). Of the rest, {_known_parts(account)}."
            f"{sentence_of_more_pushes(account, first)}"
        )
    if account.maps_are_open:
        maps = account["maps"]
        return (
            f"Nothing is found, and the pushes are too few to know: {in_mm(maps.mean)} ({_interval(maps)}) of the "
            f"{in_mm(account.expected_error)} to be expected on held-out pushes come from maps that are not known yet."
            f"{sentence_of_more_pushes(account, first)} {_parts_of(account)}."
        )
    return f"No gap beyond noise: of {error}, {_known_parts(account)}; {_unexplained(account)}."


def sentence_of_no_change(account: Account) -> str:
    """Of a diagnosis against a reference that names nothing."""
    return f"No change since the reference is found. {_parts_of(account)}."


def sentence_of_effects(
    effects: Sequence[FoundEffect], confusion_sets: Mapping[str, Sequence[str]], account: Account, *, is_change: bool = False
) -> str:
    """Of a diagnosis that names causes; `is_change`: since a reference."""
    causes = "; and ".join(f"{_plain(e.name)} ({e.name}: {size_of(e)}{', by another law' if e.is_free else ''})" for e in effects)
    open_to = {name: [rival for rival in names if rival != SOMETHING_ELSE] for name, names in confusion_sets.items()}
    ties = "".join(f" These pushes cannot distinguish {name} from {' or '.join(names)}." for name, names in open_to.items() if names)
    begin = "Since the reference it has changed that" if is_change else "The simulation leaves out that"
    return f"{begin} {causes}{_share_of_effects(account)}.{ties} {_rest(account)}"


def sentence_of_free_law(law: FreeLaw, words: PatternWords, confusion_sets: Mapping[str, Sequence[str]], account: Account) -> str:
    """Of a diagnosis that names a mechanism by a free law."""
    open_to = [name for names in confusion_sets.values() for name in names]
    tie = f" These pushes cannot distinguish it from {' or '.join(name.replace('_', ' ') for name in open_to)}." if open_to else ""
    return (
        f"The simulation leaves out {_MECHANISM_IN_WORDS[law.mechanism]} ({law.mechanism.value}, by no formula of the catalogue): "
        f"{words.what}, {words.where}{_share_of_effects(account)}. Look for {words.look_for}.{tie} {_rest(account)}"
    )


def sentence_of_unknown(
    account: Account,
    words: PatternWords | None,
    probability: float,
    residuals: FrameResiduals,
    where: Mapping[str, Sequence[ResidualGroup]],
) -> str:
    """Of a diagnosis whose cause is not in the catalogue.

    `words`: the most probable pattern, None where patterns could not be looked for; `residuals`: beside all effects that could be named;
    `where`: residuals of the base model in groups.
    """
    begin = f"The simulation leaves out something that no effect of the catalogue explains (probability {probability:.2f})"
    if words is not None:
        share = _share_of_effects(account) if account.effects else ""
        text = f"{begin}, most probably {words.what}, {words.where}{share}. Look for {words.look_for}."
        return f"{text} {_rest(account)}" if share else f"{text} {_parts_of(account)}."
    _, by, name = max((max(group.rms), by, group.name) for by, groups in where.items() for group in groups)
    name = f"{int(name) + 1}" if by == "push" else name  # people count from 1
    ratio = residuals.residual_ratio()[0]
    return (
        f"{begin}: residuals are {np.sqrt(ratio):.1f} times as large as those of a correct model, and largest for {by.replace('_', ' ')} "
        f"{name}. {_parts_of(account)}."
    )


def sentence_of_doubt(words: PatternWords, probability: float) -> str:
    """Added to the sentence where an effect is named, but something else may act in its place."""
    return (
        f" Something outside the catalogue may act in its place (probability {probability:.2f}): {words.what}, {words.where}; "
        f"look for {words.look_for}."
    )


def sentence_of_remainder(words: PatternWords, probability: float, remainder: float) -> str:
    """Added to the sentence where effects are named and something else acts beside them; `remainder`: of the error on held-out pushes that
    neither they nor what is expected explain [m]."""
    explained = f", {in_mm(remainder)} of error" if remainder > 0.0 else ""
    return (
        f" Beside that, something remains that no effect explains (probability {probability:.2f}{explained}), most probably {words.what}, "
        f"{words.where}; look for {words.look_for}."
    )


def sentence_of_suspicion(probabilities: Probabilities) -> str:
    """Added to the sentence where no cause is detected although nothing at all is improbable: several causes have some evidence each."""
    likely = sorted(probabilities.effects.items(), key=lambda item: -item[1])[:3]
    causes = ", ".join(f"{name} ({value:.2f})" for name, value in likely)
    return f" No single cause is detected, but that nothing acts has a probability of {probabilities.nothing:.2f} only: look at {causes}."


def sentence_of_unsupported(name: str, pushes: Sequence[str]) -> str:
    """Added to the sentence where an effect is rejected because only one push supports it, or pushes contradict each other: of these none
    is given."""
    if not pushes:
        return f" Fits without some of the pushes contradict each other on {name}, which is therefore not reported: make more pushes."
    support, those = ("supports", "that push") if len(pushes) == 1 else ("support", "those pushes")
    return f" Only {' and '.join(pushes)} {support} {name}, so that it is not reported: repeat {those}."


def sentence_of_departing(pushes: Mapping[str, float]) -> str:
    """Added to the sentence where single pushes depart from the model much further than the others, at least one; by which factor."""
    named = " and ".join(f"{push} ({times:.0f} times)" for push, times in pushes.items())
    depart, those = ("departs", "that push") if len(pushes) == 1 else ("depart", "those pushes")
    return f" {named[0].upper()}{named[1:]} {depart} from the model much further than the others and counts less: look at {those}."


def sentence_of_negligible(effects: Sequence[FoundEffect]) -> str:
    """Added to the sentence where effects below the accuracy of a cell were detected, at least one."""
    detected = "; ".join(f"{_plain(e.name)} ({e.name}: {size_of(e)})" for e in effects)
    return f" Detected but negligible, below the accuracy of a cell: {detected}."


def size_of(effect: FoundEffect) -> str:
    """Sizes with their standard deviation, in everyday units."""
    parts = []
    for parameter in EFFECTS[effect.name].parameters:
        if not parameter.shape:
            factor, unit = _SHOWN_IN.get(parameter.unit, (1.0, parameter.unit))
            value, std = factor * effect.parameters[parameter.name], factor * effect.std[parameter.name]
            parts.append(_with_unit(f"{parameter.name} {value:.3g} ± {std:.2g}", unit))
    return ", ".join(parts)


def amplitude_of(law: FreeLaw) -> str:
    """The largest amplitude of a free law, in everyday units."""
    factor, unit = _SHOWN_IN.get(law.unit, (100.0, "%"))
    return f"up to {factor * law.largest:+.3g} ± {factor * law.std:.2g} {unit}"


def _with_unit(number: str, unit: str) -> str:
    return f"{number}{unit}" if unit == "°" else f"{number} {unit}".rstrip()


def detectable_size(name: str, smallest: float) -> str:
    """The smallest size of an effect that the pushes would show, in the units of `size_of`; empty where no size would."""
    if not np.isfinite(smallest):
        return ""
    factor, unit = _SHOWN_IN.get(EFFECTS[name].parameters[0].unit, (1.0, EFFECTS[name].parameters[0].unit))
    return _with_unit(f"{factor * smallest:.2g}", unit)


def sentence_of_more_pushes(account: Account, first: PlannedPush | None) -> str:
    """Added to the sentence: how many pushes would make the maps known, and which one first; empty where these are known."""
    n = account.more_pushes
    if n == 0:
        return ""
    described = "" if first is None else describe_push(first)
    if n is None:
        most = f" More than {account.policy.max_more_pushes} pushes like these would be needed, so push it differently"
        return f"{most}, first like this: {described}." if described else f"{most}."
    more = f" {n} more push{' like these' if n == 1 else 'es like these'} would make the maps known"
    return f"{more}; this one first: {described}." if described else f"{more}."


def in_mm(length: float) -> str:
    """A length [m] in millimetres, with its unit."""
    return f"{1e3 * length:.{_digits(length)}f} mm"


def describe_push(push: PlannedPush) -> str:
    """Where to touch, and how to push, to continue "the push": empty where nobody planned it."""
    plan = push.plan
    if plan is None:
        return ""
    x, y = (1e3 * float(value) for value in plan.contact_point)
    return (
        f"touch at ({x:.0f}, {y:.0f}) mm of the table, push {1e3 * plan.distance:.0f} mm towards {np.degrees(plan.direction):.0f}° at "
        f"{plan.speed:.2f} m/s"
    )


def _share_of_effects(account: Account) -> str:
    """How much of the error the effects account for, to continue the sentence that names them."""
    removed = account.before - account.after
    if not removed > 0.0:
        return _share_over_motion(account)
    parts = account.effects
    each = f" ({_interval(parts[0])})" if len(parts) == 1 else f" ({', '.join(f'{p.name} {in_mm(p.mean)}' for p in parts)})"
    which = "which accounts" if len(parts) == 1 else "which together account"
    return (
        f", {which} for {in_mm(removed)} of the mean error of {in_mm(account.before)} on held-out pushes{each}{_share_over_motion(account)}"
    )


def _share_over_motion(account: Account) -> str:
    """The same over the motion, to continue it: where that is more than at the end; a latency changes no end."""
    motion = account.gap.motion
    if motion is None:
        return ""
    before, after = float(np.mean(motion.before)), float(np.mean(motion.after))
    if not before - after > max(account.before - account.after, account.policy.negligible):
        return ""
    return f", and over the motion for {in_mm(before - after)} of {in_mm(before)} (root mean square over the frames)"


def _rest(account: Account) -> str:
    """What the error beside the effects is made of."""
    if account.after < account.before:
        return f"Of the other {in_mm(account.after)}, {_known_parts(account)}; {_unexplained(account)}."
    worse = f"Held-out pushes end no nearer to their prediction with it ({in_mm(account.after)}, {in_mm(account.before)} without)"
    return f"{worse}: {_known_parts(account)}; {_unexplained(account)}."


def _parts_of(account: Account) -> str:
    return f"The mean error is {in_mm(account.before)}: {_known_parts(account)}; {_unexplained(account)}"


def _known_parts(account: Account) -> str:
    noise, maps, model = (account[name].mean for name in ("noise", "maps", "model"))
    return (
        f"noise of the poses accounts for {in_mm(noise)}, maps that are not known yet for {in_mm(maps)} and the model's own discrepancy "
        f"for {in_mm(model)}"
    )


def _unexplained(account: Account) -> str:
    part = account["unexplained"]
    if part.mean < 0.0:
        better = AccountPart(part.name, -part.mean, (-part.interval[1], -part.interval[0]))
        chance = ", within chance" if account.is_within_chance else ""
        return f"the pushes were predicted {in_mm(better.mean)} better than expected{chance} ({_interval(better)})"
    chance = "" if account.is_unexplained else ", within chance"
    return f"{in_mm(part.mean)} remain unexplained{chance} ({_interval(part)})"


def _interval(part: AccountPart) -> str:
    low, high = part.interval
    digits = _digits(max(abs(low), abs(high), abs(part.mean)))
    return f"90 % interval {1e3 * low:.{digits}f} to {1e3 * high:.{digits}f} mm"


def _digits(length: float) -> int:
    """Decimals of a length in millimetres [m]."""
    return 1 if abs(length) >= 1e-3 else 2


def _plain(name: str) -> str:
    """What an effect is, to continue a sentence."""
    what = EFFECTS[name].what.rstrip(".")
    return what[0].lower() + what[1:]
