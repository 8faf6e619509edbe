"""From pushes to a verdict: one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from push_ident.diagnosis.fits import EffectFit, fit_base
from push_ident.diagnosis.gates import Gate, check_data, check_fit
from push_ident.diagnosis.held_out import Gap, measure_gap
from push_ident.diagnosis.next_push import SeparatingPush, check_without_a_push, separating_push
from push_ident.diagnosis.residuals import Frames, Group, group_frames, left_over
from push_ident.diagnosis.selection import Selection, select_effects
from push_ident.diagnosis.settings import DiagnosisSettings, Thresholds
from push_ident.diagnosis.unknown import SmoothWrench, find_unknown
from push_ident.errors import InputError
from push_ident.identification.observation import noise_correlation, observe_push
from push_ident.physics.effects import EFFECTS
from push_ident.pushing.push import PushSettings
from push_ident.types import PushRecord

__all__ = ["Diagnosis", "FoundEffect", "Verdict", "diagnose"]

Progress = Callable[[str], None]

_SAME = ({"tool_offset", "camera_translation"},)
"""Effects that no push can tell apart."""
_CHANCE = 0.005
"""Probability below which residuals are not those of a model that is right."""
_VETO = -2.0
"""Mean gain of held-out log density per push, in standard errors, below which an effect is not believed."""


class Verdict(Enum):
    """What the pushes say; the values are those of the JSON contract."""

    NO_GAP = "no_gap"
    NAMED = "named"
    ONE_OF = "one_of"
    SEVERAL = "several"
    UNKNOWN = "unknown"
    NOT_TRUSTWORTHY = "not_trustworthy"


@dataclass(frozen=True, slots=True)
class FoundEffect:
    """An effect that the pushes speak for."""

    name: str
    parameters: dict[str, float]
    std: dict[str, float]
    evidence: float
    """Gain of log evidence in the step in which it came, beside those found before it [nat]."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The outcome."""

    verdict: Verdict
    sentence: str
    """What an engineer needs to know, in one sentence."""
    effects: tuple[FoundEffect, ...]
    confusable: tuple[str, ...]
    """Effects that these pushes cannot tell from the last one found, or from any that was found if they are the same to all pushes."""
    gap: Gap | None
    """On pushes held out; None where nothing could be trusted."""
    gates: tuple[Gate, ...]
    selection: Selection | None
    where: dict[str, list[Group]]
    next_push: SeparatingPush | None
    check: str
    """What would settle it without a push."""
    unknown: SmoothWrench | None = None
    """What a smooth wrench of unknown cause explains, where there is a trace of one."""
    frames: Frames | None = None
    """What the base model leaves of every frame; `where` is this in groups. None where nothing could be trusted."""
    leftover: float = np.nan
    """Mean square of the residuals beside all that the catalogue explains, over that of a model that is right."""

    @property
    def fit(self) -> EffectFit | None:
        """Maps with the effects that were found."""
        return self.selection.fit if self.selection else None


def diagnose(
    records: Sequence[PushRecord],
    settings: DiagnosisSettings | None = None,
    *,
    push_settings: PushSettings | None = None,
    on_progress: Progress | None = None,
) -> Diagnosis:
    """Say where and why the simulation parts from pushes of one object.

    Args:
        records: the pushes, in the order in which they were made.
        settings: how.
        push_settings: limits of the push that is proposed.
        on_progress: told what is going on.

    Raises:
        InputError: no push, pushes of different objects, or an unknown effect in the base.
    """
    settings = settings or DiagnosisSettings()
    report = on_progress or (lambda text: None)
    if not records:
        raise InputError("There is no push to diagnose; give at least three.")
    if strange := [name for name in settings.base_effects if name not in EFFECTS]:
        raise InputError(f"There is no effect `{strange[0]}`; choose from {', '.join(EFFECTS)}.")
    gates = check_data(records, settings)
    pushes = [record for record in records if observe_push(record, settings.noise).touched]
    if not all(gate.passed for gate in gates):
        return _untrusted(gates)
    correlation = noise_correlation(records)
    if correlation > settings.noise.correlation:
        settings = replace(settings, noise=replace(settings.noise, correlation=correlation))
    report("fitting the base model")
    base = fit_base(pushes, settings)
    gates += check_fit(base)
    if not all(gate.passed for gate in gates):
        return _untrusted(gates)
    selection = select_effects(base, settings.thresholds, report)
    report("looking for what the catalogue leaves over")
    thresholds, frames = settings.thresholds, left_over(base)
    (leftover, by_chance), unknown = (frames if selection.fit is base else left_over(selection.fit)).misfit, find_unknown(selection)
    wrench = unknown if unknown is not None and unknown.gain > thresholds.unknown else None
    is_unknown = leftover > thresholds.leftover and by_chance < _CHANCE
    is_unknown |= wrench is not None and _explains_more(wrench, selection, thresholds)
    if is_unknown:
        selection = Selection(base, base, selection.steps)
    gap = measure_gap(base, wrench.fit if wrench is not None and is_unknown else selection.fit, report)
    if selection.found and _vetoed(gap):
        selection = Selection(base, base, selection.steps)
        gap = measure_gap(base, base, report)
    effects = _found(selection)
    confusable = _confusable(selection, settings)
    verdict = Verdict.UNKNOWN if is_unknown else _verdict(effects, confusable)
    where = group_frames(frames)
    report("looking for the push that would settle it")
    rivals = _rivals(selection, confusable)
    last = pushes[-1].poses.pose[-1]
    limits = push_settings or PushSettings(pusher_radius=pushes[-1].pusher.radius, workspace=(-1.0, 1.0, -1.0, 1.0))
    proposal = separating_push(rivals, np.array(last), limits) if len(rivals) > 1 else None
    return Diagnosis(
        verdict=verdict,
        sentence=_unknown_sentence(gap, wrench, leftover, where) if is_unknown else _sentence(verdict, effects, confusable, gap),
        effects=effects,
        confusable=confusable,
        gap=gap,
        gates=tuple(gates),
        selection=selection,
        where=where,
        next_push=proposal,
        check=check_without_a_push([*(e.name for e in effects[-1:]), *confusable]) if effects else "",
        unknown=wrench if is_unknown else unknown,
        frames=frames,
        leftover=leftover,
    )


def _untrusted(gates: list[Gate]) -> Diagnosis:
    failed = next(gate for gate in gates if not gate.passed)
    return Diagnosis(
        Verdict.NOT_TRUSTWORTHY,
        f"These data cannot be diagnosed: {failed.found}. {failed.remedy}",
        (), (), None, tuple(gates), None, {}, None, failed.remedy,
    )  # fmt: skip


def _explains_more(unknown: SmoothWrench, selection: Selection, thresholds: Thresholds) -> bool:
    """Whether a smooth wrench says clearly more than everything that was named, and that is not most of it: no named law is quite
    that of the world, and a wrench that may have any shape fits the rest as well."""
    named = selection.fit.log_evidence - selection.base.log_evidence
    return unknown.gain > max(named + thresholds.apart, named / thresholds.most)


def _vetoed(gap: Gap) -> bool:
    gain = gap.log_density_gain
    error = float(np.std(gain, ddof=1)) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return float(np.mean(gain)) < _VETO * error and float(np.mean(gap.after)) > float(np.mean(gap.before))


def _found(selection: Selection) -> tuple[FoundEffect, ...]:
    fit = selection.fit
    values, std = fit.effects.values, fit.posterior.effects_std
    effects = []
    for name, (_, candidate) in selection.added.items():
        own = fit.effects.slice_of(name)
        names = [p.name for p in EFFECTS[name].parameters]
        effects.append(
            FoundEffect(
                name,
                dict(zip(names, map(float, values[own]), strict=True)),
                dict(zip(names, map(float, std[own]), strict=True)),
                candidate.gain,
            )
        )
    return tuple(effects)


def _confusable(selection: Selection, settings: DiagnosisSettings) -> tuple[str, ...]:
    if not selection.found:
        return ()
    step, last = list(selection.added.values())[-1]
    thresholds = settings.thresholds
    apart = thresholds.apart if last.gain >= thresholds.sure else max(thresholds.apart, last.gain - 1.0)
    names = [c.name for c in step.rivals(last, apart) if c.gain > 1.0 and c.name not in selection.found]
    for same in _SAME:
        if same & set(selection.found):
            names += [name for name in sorted(same) if name not in (*selection.found, *names)]
    return tuple(names)


def _rivals(selection: Selection, confusable: Sequence[str]) -> dict[str, EffectFit]:
    """Explanations that are open, by name."""
    if not selection.found:
        first = selection.steps[0] if selection.steps else None
        return {"no effect": selection.base, **({c.name: c.fit for c in first.candidates[:2]} if first else {})}
    step, last = list(selection.added.values())[-1]
    open_ones = {c.name: c.fit for c in step.candidates if c is last or c.name in confusable}
    # Where nothing else is open, the push that would show the effect most clearly confirms it.
    return open_ones if len(open_ones) > 1 else {f"without {last.name}": step.before, **open_ones}


def _verdict(effects: Sequence[FoundEffect], confusable: Sequence[str]) -> Verdict:
    if not effects:
        return Verdict.NO_GAP
    if len(effects) > 1:
        return Verdict.SEVERAL
    return Verdict.ONE_OF if confusable else Verdict.NAMED


def _sentence(verdict: Verdict, effects: Sequence[FoundEffect], confusable: Sequence[str], gap: Gap) -> str:
    before, after, noise = _millimetres(gap)
    if verdict is Verdict.NO_GAP:
        share = f"and {noise:.1f} mm of that are the noise of the poses"
        if noise > before:
            share = f"less than the {noise:.1f} mm that the noise of the poses alone may make"
        return f"No gap beyond noise: pushes held out are predicted to {before:.1f} mm, {share}."
    sizes = " and ".join(_size(effect) for effect in effects)
    doubt = f" (or {', '.join(confusable)}: these pushes cannot tell)" if confusable else ""
    closed = f"; with it the error on pushes held out falls from {before:.1f} to {after:.1f} mm, noise is {noise:.1f} mm"
    return f"The simulation leaves out {sizes}{doubt}{closed}."


def _unknown_sentence(gap: Gap, wrench: SmoothWrench | None, leftover: float, where: dict[str, list[Group]]) -> str:
    before, after, noise = _millimetres(gap)
    if wrench is not None:
        return (
            f"The simulation leaves out something that is not in the catalogue: it {wrench.description}. A smooth wrench in its place "
            f"takes the error on pushes held out from {before:.1f} to {after:.1f} mm, noise is {noise:.1f} mm."
        )
    _, by, name = max((max(group.rms), by, group.name) for by, groups in where.items() for group in groups)
    return (
        f"The simulation leaves out something that is not in the catalogue, and no smooth force explains it either: residuals are "
        f"{np.sqrt(leftover):.1f} times those of a model that is right, most by {by.replace('_', ' ')} at {name}. Pushes held out are "
        f"predicted to {before:.1f} mm, noise is {noise:.1f} mm."
    )


def _millimetres(gap: Gap) -> tuple[float, float, float]:
    before, after, noise = (1e3 * float(np.mean(v)) for v in (gap.before, gap.after, gap.noise))
    return before, after, noise


def _size(effect: FoundEffect) -> str:
    shown = [p for p in EFFECTS[effect.name].parameters if not p.shape]
    values = ", ".join(f"{p.name} {effect.parameters[p.name]:.3g} ± {effect.std[p.name]:.2g} {p.unit}".rstrip() for p in shown)
    return f"{effect.name} ({values})"


def to_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """The outcome as the command-line contract has it; lengths in metres, angles in radians."""
    gap, selection, proposal = diagnosis.gap, diagnosis.selection, diagnosis.next_push
    first = selection.steps[0] if selection and selection.steps else None
    refitted = {c.name: c for c in first.candidates} if first else {}
    nan = float("nan")
    return {
        "verdict": diagnosis.verdict.value,
        "sentence": diagnosis.sentence,
        "effects": [{"name": e.name, "parameters": e.parameters, "std": e.std, "evidence": e.evidence} for e in diagnosis.effects],
        "confusable": list(diagnosis.confusable),
        "gap": {
            "before_m": float(np.mean(gap.before)) if gap else nan,
            "after_m": float(np.mean(gap.after)) if gap else nan,
            "noise_m": float(np.mean(gap.noise)) if gap else nan,
            "shrink": gap.shrink if gap else nan,
            "shrink_interval": list(gap.shrink_interval) if gap else [nan, nan],
            "before_per_push_m": gap.before.tolist() if gap else [],
            "after_per_push_m": gap.after.tolist() if gap else [],
        },
        "where": {
            by: [
                {
                    "name": g.name,
                    "n": g.n,
                    "along": g.rms[0],
                    "across": g.rms[1],
                    "rotation": g.rms[2],
                    "mean_m": g.mean_m,
                    "by_chance": dict(zip(("along", "across", "rotation"), g.by_chance, strict=True)),
                }
                for g in groups
            ]
            for by, groups in diagnosis.where.items()
        },
        "ranking": [
            {
                "name": score.name,
                "evidence": refitted[score.name].gain if score.name in refitted else score.gain,
                "refitted": score.name in refitted,
                "smallest": score.smallest,
                "unit": EFFECTS[score.name].parameters[0].unit,
            }
            for score in (first.scores if first else ())
        ],
        "next_push": None
        if proposal is None or proposal.push.plan is None
        else {
            "contact_point_m": proposal.push.plan.contact_point.tolist(),
            "direction_rad": float(proposal.push.plan.direction),
            "distance_m": proposal.push.plan.distance,
            "speed_mps": proposal.push.plan.speed,
            "frame": "table",
            "pose_object_in_table": proposal.push.pose_object_in_table.tolist(),
            "between": list(proposal.between),
            "distance2": proposal.distance2,
        },
        "check": diagnosis.check,
        "unknown": None
        if diagnosis.unknown is None
        else {
            "evidence": diagnosis.unknown.gain,
            "acts_on": diagnosis.unknown.acts_on,
            "varies_with": diagnosis.unknown.varies_with,
        },
        "gates": [{"passed": g.passed, "found": g.found, "remedy": g.remedy} for g in diagnosis.gates],
    }
