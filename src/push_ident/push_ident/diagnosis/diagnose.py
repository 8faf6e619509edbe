"""From pushes to a verdict: one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from push_ident.diagnosis.fits import EffectFit, fit_base
from push_ident.diagnosis.gates import Gate, check_data, check_fit, check_outline
from push_ident.diagnosis.held_out import Gap, measure_gap
from push_ident.diagnosis.next_push import NO_EFFECT, check_without_a_push, separating_push, without
from push_ident.diagnosis.residuals import Frames, correlation_in_motion, group_frames, left_over
from push_ident.diagnosis.seen import SEEN_OUTLINE, as_seen, is_off, odd_pushes, with_camera_in_question
from push_ident.diagnosis.selection import Selection, select_effects
from push_ident.diagnosis.settings import DiagnosisSettings, Thresholds
from push_ident.diagnosis.unknown import SmoothWrench, find_unknown
from push_ident.diagnosis.verdict import Diagnosis, FoundEffect, Verdict
from push_ident.diagnosis.wording import (
    sentence_of_effects,
    sentence_of_lone,
    sentence_of_nothing,
    sentence_of_odd,
    sentence_of_trifles,
    sentence_of_unknown,
)  # fmt: skip
from push_ident.errors import InputError
from push_ident.identification.observation import noise_correlation, observe_push
from push_ident.physics.effects import EFFECTS
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, PushRecord

__all__ = ["diagnose"]

Progress = Callable[[str], None]

_ENOUGH_PAIRS = 80
"""Pairs of neighbouring frames at rest from which the correlation of their errors is known to a tenth."""
_CHANCE = 0.005
"""Probability below which residuals are not those of a model that is right."""


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
    asked, is_seen = settings, settings.outline_is_seen or records[0].shape.traced_by_camera
    if is_seen:
        settings = as_seen(settings)
    gates = check_data(records, settings)
    pushes = [record for record in records if observe_push(record, settings.noise).touched]
    if not all(gate.passed for gate in gates):
        return _untrusted(gates)
    correlation = noise_correlation(records)
    if correlation > settings.noise.correlation:
        settings = replace(settings, noise=replace(settings.noise, correlation=correlation))
    rests_tell = bool(np.isfinite(noise_correlation(records, enough_pairs=_ENOUGH_PAIRS)))
    selection, found = _explain(pushes, settings, report, rests_tell=rests_tell)
    if selection is not None and is_seen and is_off(selection.fit, asked):
        report("the camera is less accurate than it should be: looking again")
        settings = with_camera_in_question(settings, asked)
        selection, found = _explain(pushes, settings, report, rests_tell=rests_tell)
    odd = odd_pushes(left_over(selection.fit)) if selection is not None and is_seen else ()
    set_aside = [pushes[push].source or f"push {push}" for push in odd]
    if odd:
        report(f"{' and '.join(set_aside)} set aside: looking again")
        pushes = [record for push, record in enumerate(pushes) if push not in odd]
        selection, found = _explain(pushes, settings, report, rests_tell=rests_tell)
    gates += found
    if selection is None:
        return _untrusted(gates)
    base = selection.base
    report("looking for what the catalogue leaves over")
    thresholds, frames = settings.thresholds, left_over(base)
    rest, unknown = frames if selection.fit is base else left_over(selection.fit), find_unknown(selection)
    # Errors of perceived poses depend on the pose, and last; so may those of others, where too few frames at rest tell.
    noise_is_known = rests_tell and not is_seen
    is_unknown = _is_more_there(frames, rest, thresholds, noise_is_known=noise_is_known)
    # What makes pushes held out worse is not believed, be it a wrench or a law.
    wrench = gap = lone = None
    if unknown is not None and unknown.gain > thresholds.unknown and (is_unknown or _explains_more(unknown, selection, thresholds)):
        gap = measure_gap(base, unknown.fit, report)
        wrench, gap = (unknown, gap) if gap.is_above_noise and not _vetoed(gap) else (None, None)
    is_unknown |= wrench is not None
    if is_unknown:
        selection = Selection(base, base, selection.steps)
    if gap is None:
        gap = measure_gap(base, selection.fit, report, between=selection.stages)
        believed, lone = _borne_out(selection, gap, thresholds)
        if believed is not selection:
            rest = left_over(believed.fit)
            is_unknown |= lone is not None and _is_more_there(frames, rest, thresholds, noise_is_known=noise_is_known)
            selection = Selection(base, base, selection.steps) if is_unknown else believed
            gap = measure_gap(base, selection.fit, report, between=selection.stages)
    effects = _found(selection, gap)
    doubts = _doubts(selection, thresholds)
    verdict = Verdict.UNKNOWN if is_unknown else _verdict(effects, doubts)
    where = group_frames(frames)
    if is_unknown:
        sentence = sentence_of_unknown(gap, wrench, rest, where)
    else:
        sentence = sentence_of_effects(effects, doubts, gap) if effects else sentence_of_nothing(gap)
    if not is_unknown and (trifles := _trifles(selection, settings)):
        sentence += sentence_of_trifles(trifles)
    if lone is not None:
        sentence += sentence_of_lone(lone.name, [pushes[push].source or f"push {push}" for push in lone.pushes])
    if set_aside:
        sentence += sentence_of_odd(set_aside)
    report("looking for the push that would settle it")
    explanations = _explanations(selection, thresholds)
    last = pushes[-1].poses.pose[-1]
    limits = push_settings or PushSettings(pusher_radius=pushes[-1].pusher.radius, workspace=(-1.0, 1.0, -1.0, 1.0))
    proposal = separating_push(explanations, np.array(last), limits) if len(explanations) > 1 else None
    return Diagnosis(
        verdict=verdict,
        sentence=sentence,
        effects=effects,
        doubts=doubts,
        gap=gap,
        gates=tuple(gates),
        selection=selection,
        where=where,
        next_push=proposal,
        check=check_without_a_push([*doubts, effects[-1].name]) if effects else "",
        unknown=wrench if is_unknown else unknown,
        frames=frames,
        leftover=rest.misfit[0],
        lasting=rest.persistence[0],
    )


def _explain(
    pushes: Sequence[PushRecord], settings: DiagnosisSettings, report: Progress, *, rests_tell: bool
) -> tuple[Selection | None, list[Gate]]:
    """The base model and what to add to it; None where a gate is not passed.

    Where frames at rest do not tell how errors of the poses last, those of the motions have to.
    """
    report("fitting the base model")
    base = fit_base(pushes, settings)
    if not rests_tell and (correlation := correlation_in_motion(base)) > settings.noise.correlation:
        base = fit_base(pushes, replace(settings, noise=replace(settings.noise, correlation=correlation)))
    gates = check_fit(base)
    if not all(gate.passed for gate in gates):
        return None, gates
    selection = select_effects(base, settings.thresholds, report)
    gates += check_outline(selection.fit) if SEEN_OUTLINE in base.names else []
    return (selection if all(gate.passed for gate in gates) else None), gates


def _untrusted(gates: list[Gate]) -> Diagnosis:
    failed = next(gate for gate in gates if not gate.passed)
    return Diagnosis(
        Verdict.NOT_TRUSTWORTHY,
        f"These data cannot be diagnosed: {failed.found}. {failed.remedy}",
        (), {}, None, tuple(gates), None, {}, None, failed.remedy,
    )  # fmt: skip


def _is_more_there(base: Frames, rest: Frames, thresholds: Thresholds, *, noise_is_known: bool) -> bool:
    """Whether what was named leaves more of the frames than noise does, or what goes on from frame to frame.

    Args:
        base: what the base model leaves.
        rest: what is left beside all that was named.
        thresholds: what counts.
        noise_is_known: how far errors of the poses last from frame to frame is known; else what lasts may be just these.
    """
    beyond = max(base.misfit[0] - 1.0, 0.0)
    (leftover, by_chance), (lasting, lasts_by_chance) = rest.misfit, rest.persistence
    if leftover > max(thresholds.leftover, 1.0 + thresholds.leftover_share * beyond) and by_chance < _CHANCE:
        return True
    return noise_is_known and lasting > thresholds.lasting + thresholds.lasting_share * beyond and lasts_by_chance < _CHANCE


def _explains_more(unknown: SmoothWrench, selection: Selection, thresholds: Thresholds) -> bool:
    """Whether a smooth wrench explains the pushes better than what was named.

    Than one law: clearly better, and by much, for no named law is quite that of the world, and a wrench that may have any shape fits the
    rest as well. Several laws of a catalogue easily imitate one that is not in it: they have to be clearly better than the wrench.
    """
    named = selection.fit.log_evidence - selection.base.log_evidence
    if len(selection.found) > 1:
        return unknown.gain > named - thresholds.apart
    return unknown.gain > max(named + thresholds.apart, named / thresholds.most)


def _vetoed(gap: Gap) -> bool:
    """Whether pushes held out are told no better with what was added, neither where they ended nor how probable they were."""
    return float(np.mean(gap.log_density_gain)) <= 0.0 and float(np.mean(gap.after)) >= float(np.mean(gap.before))


@dataclass(frozen=True, slots=True)
class _Lone:
    """Effects that one push, or those that were held out with it, alone speaks for."""

    name: str
    pushes: tuple[int, ...]


def _borne_out(selection: Selection, gap: Gap, thresholds: Thresholds) -> tuple[Selection, _Lone | None]:
    """What pushes bear out of what was found: nothing where it makes those held out worse. An effect that gains nothing without one of
    them came of that one, be it that something happened to it, or that it lies at an edge between sticking and sliding, where a trifle
    decides where the object goes."""
    if not selection.found:
        return selection, None
    if _vetoed(gap):
        return Selection(selection.base, selection.base, selection.steps), None
    found: set[str] = set()
    fits = [*selection.stages.values(), selection.fit]
    for stage, (fit, gains) in enumerate(zip(fits, gap.gain_without, strict=True)):
        fold = int(np.argmin(gains))
        names = [name for name in fit.names if name not in (*selection.base.names, *found)]
        if gains[fold] < thresholds.alone:
            return selection.until(stage), _Lone(" and ".join(names), gap.folds[fold])
        found |= set(names)
    return selection, None


def _found(selection: Selection, gap: Gap) -> tuple[FoundEffect, ...]:
    if not selection.found:
        return ()
    fit = selection.fit
    std = np.maximum(fit.posterior.effects_std, gap.effects_std)
    return tuple(_sized(fit, std, name, candidate.gain) for name, (_, candidate) in selection.added.items())


def _trifles(selection: Selection, settings: DiagnosisSettings) -> list[FoundEffect]:
    """What went to the base because it is too small to matter; the evidence for it is not told."""
    names = [name for name in selection.base.names if name not in settings.base_effects]
    return [_sized(selection.fit, selection.fit.posterior.effects_std, name, np.nan) for name in names]


def _sized(fit: EffectFit, std: Float64Array, name: str, evidence: float) -> FoundEffect:
    own = fit.effects.slice_of(name)
    names = [p.name for p in EFFECTS[name].parameters]
    values, deviations = (dict(zip(names, map(float, v[own]), strict=True)) for v in (fit.effects.values, std))
    return FoundEffect(name, values, deviations, evidence)


def _doubts(selection: Selection, thresholds: Thresholds) -> dict[str, tuple[str, ...]]:
    """Of effects that were found: names of those that may be there in their place."""
    doubts: dict[str, tuple[str, ...]] = {}
    for rival in selection.open_rivals(thresholds):
        doubts[rival.of] = (*doubts.get(rival.of, ()), rival.name)
    for name in selection.found:
        if twins := [twin for twin in EFFECTS[name].exact_twins if twin not in (*selection.found, *doubts.get(name, ()))]:
            doubts[name] = (*doubts.get(name, ()), *twins)
    return doubts


def _explanations(selection: Selection, thresholds: Thresholds) -> dict[str, EffectFit]:
    """What a push should tell apart, by name: first what may be there in place of the last effect, then of one before it."""
    if not selection.found:
        first = selection.steps[0] if selection.steps else None
        return {NO_EFFECT: selection.base, **({c.name: c.fit for c in first.candidates[:2]} if first else {})}
    rivals = [rival for rival in selection.open_rivals(thresholds) if rival.name not in EFFECTS[rival.of].exact_twins]
    if rivals:
        return {rivals[0].of: selection.fit, **{rival.name: rival.fit for rival in rivals if rival.of == rivals[0].of}}
    # Where nothing is open, the push that would show the last effect most clearly confirms it.
    step, last = list(selection.added.values())[-1]
    return {without(last.name): step.before, last.name: selection.fit}


def _verdict(effects: Sequence[FoundEffect], doubts: dict[str, tuple[str, ...]]) -> Verdict:
    if not effects:
        return Verdict.NO_GAP
    if len(effects) > 1:
        return Verdict.SEVERAL
    return Verdict.ONE_OF if doubts else Verdict.NAMED
