"""One case of the blind check: the diagnosis, how much there was to see, what the truth would have closed, and what simpler ways say."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.fits import fit_effects
from push_ident.diagnosis.held_out import Gap, measure_gap
from push_ident.diagnosis.policy import ValidationPolicy
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.scores import EffectInformation
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.fit import Fit
from push_ident.identification.next_push import PlannedPush
from push_ident.physics.effects import EFFECTS
from push_ident.types import PushRecord
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import SimObject
from push_ident_sim.studies.blind.cases import Truth
from push_ident_sim.studies.common.base import Json

__all__ = ["TWINS", "Ask", "score_case", "true_values"]

FloatArray = NDArray[np.float64]
Ask = Callable[[PlannedPush, int], PushRecord | None]

TWINS = {"tool_offset": "camera_translation", "camera_translation": "tool_offset"}
"""Effects that no push can tell apart: either name is right."""
_RESIDUAL_NAMES = {
    "push": "wear",
    "phase": "pusher_lag",
    "speed": "speed_dependent_friction",
    "heading_in_table": "table_tilt",
    "heading_in_body": "base_anisotropy",
    "table_region": "position_dependent_friction",
}
"""What one would guess from where residuals are largest."""
_MOST_ASKED = 2
"""Pushes that a diagnosis may ask for to settle what it left open."""
_FEW = 5
"""Frames that make a group."""
_TUNED = "pusher_friction"
"""The one existing parameter that the base model takes as given."""


def true_values(effects: InjectedEffects, name: str, put_down: FloatArray) -> FloatArray:
    """An injected effect with all its parameters, shape (n_parameters,).

    Args:
        effects: that were injected.
        name: of one of them.
        put_down: the centre of mass where the object was put down first [m], shape (2,); the anchor of a tether that states none.
    """
    given = effects[name]
    if len(given) < len(EFFECTS[name].parameters):
        return np.array([given[0], *(given[0] * put_down)])
    return np.array(given)


def score_case(
    records: Sequence[PushRecord],
    truth: Truth,
    thing: SimObject,
    settings: DiagnosisSettings,
    *,
    ask: Ask | None = None,
    make_plain: Callable[[], Sequence[PushRecord]] | None = None,
) -> Json:
    """Diagnose the pushes of a case; the truth is looked at afterwards.

    Args:
        records: the pushes.
        truth: what is in them.
        thing: what was pushed.
        settings: of the diagnosis.
        ask: makes a push that the diagnosis asks for; without it, nothing that is left open is settled.
        make_plain: makes the same pushes with the same noise without any effect; without it, nothing is said of how plainly effects show
            that no diagnosis has a name for.
    """
    start, wall = time.process_time(), time.perf_counter()
    found = diagnose(records, settings)
    seconds = {"seconds": time.process_time() - start, "wall_seconds": time.perf_counter() - wall}
    values = {**_outcome(found), **seconds, "truth": truth.as_json()}
    if found.selection is None or found.gap is None:
        return values
    base = found.selection.base
    if truth.names:
        pose = records[0].poses.pose[0]
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        centre = thing.mass @ thing.cells / thing.mass.sum()
        first = pose[:2] + np.array([cos * centre[0] - sin * centre[1], sin * centre[0] + cos * centre[1]])
        # What belongs to the base, as small errors of a camera do, is nothing to be found.
        names = [name for name in truth.names if name not in base.names]
        wanted = {name: true_values(truth.effects, name, first) for name in names}
        values["true_parameters"] = {name: v.tolist() for name, v in wanted.items()}
        if wanted:
            values["detectability"] = _detectability(found.selection.steps[0].information, wanted)
            values["oracle"] = _oracle(found, base, wanted)
    if truth.scenario.kind == "outside" and make_plain is not None:
        values["visibility"] = _visibility(base, make_plain())
    if truth.scenario.kind == "single" and ask is not None and _is_open(found):
        values["asked"] = _settle(found, list(records), settings, ask)
    values["baselines"] = _baselines(found, base)
    return values


def _is_open(found: Diagnosis) -> bool:
    """Whether more than one effect is left, twins apart."""
    first = found.effects[-1].name if found.effects else ""
    return any(name != TWINS.get(first) for name in found.confusion_set)


def _settle(found: Diagnosis, records: list[PushRecord], settings: DiagnosisSettings, ask: Ask) -> Json:
    """Make the pushes that the diagnosis asks for until nothing is left open."""
    n_asked, expected = 0, found.next_push is not None and found.next_push.resolves
    while _is_open(found) and n_asked < _MOST_ASKED and found.next_push is not None:
        more = ask(found.next_push.push, len(records))
        if more is None:
            break
        records.append(more)
        found = diagnose(records, settings)
        n_asked += 1
    return {
        "n": n_asked,
        "expected": expected,
        "verdict": found.verdict.value,
        "named": [effect.name for effect in found.effects],
        "confusable": list(found.confusion_set),
        "settled": len(found.effects) == 1 and not _is_open(found),
    }


def _outcome(found: Diagnosis) -> Json:
    return {
        "verdict": found.verdict.value,
        "sentence": found.sentence,
        "effects": [{"name": e.name, "parameters": e.parameters, "std": e.std, "evidence": e.log_bayes_factor} for e in found.effects],
        "confusable": list(found.confusion_set),
        "gap": None if found.gap is None else _gap(found.gap),
        # Enough to try other thresholds without fitting again.
        "steps": [] if found.selection is None else [_step(found.selection, i) for i in range(len(found.selection.steps))],
        "misfit": None if found.base_residuals is None else found.base_residuals.residual_ratio,
        "residual_ratio": found.residual_ratio,
        "excess_autocorrelation": found.excess_autocorrelation,
        "unknown_gain": None if found.wrench is None else found.wrench.log_bayes_factor,
        "failed_gates": [gate.found for gate in found.gates if not gate.passed],
    }


def _step(selection: Selection, number: int) -> Json:
    step = selection.steps[number]
    first = next((score for score in step.scores), None)
    return {
        "gains": {c.name: c.log_bayes_factor for c in step.candidates},
        "scores": {score.name: score.expected_log_bayes_factor for score in step.scores},
        "costs": {c.name: c.fit.end.cost for c in step.candidates},
        "best_score": None if first is None else first.name,
        # What would just have been seen; effects that cannot be seen at any size that makes sense are left out.
        "smallest": {score.name: score.smallest_detectable for score in step.scores if np.isfinite(score.smallest_detectable)},
    }


def _gap(gap: Gap) -> Json:
    low, high = gap.shrink_interval
    return {
        "before_m": float(np.mean(gap.before)),
        "after_m": float(np.mean(gap.after)),
        "noise_m": float(np.mean(gap.noise)),
        "above_noise": gap.is_above_noise,
        "shrink": gap.shrink if gap.is_above_noise else None,
        "shrink_interval": [low, high] if gap.is_above_noise else None,
    }


def _detectability(information: EffectInformation | None, wanted: Mapping[str, FloatArray]) -> Json:
    """How plainly the true effects show, each alone: noncentrality beside everything that the base model fits.

    `alone`: beside the base. `hardest`: also beside that rival of the catalogue which takes most of it away. `gain`: of log evidence that
    its true size brings on average.
    """
    if information is None:
        return {}
    places, precision = information.places, information.precision

    def place(name: str) -> NDArray[np.int64]:
        return places[name][[not p.shape for p in EFFECTS[name].parameters]]

    shown = {}
    for name, values in wanted.items():
        own = place(name)
        acting = [i for i, p in enumerate(EFFECTS[name].parameters) if not p.shape]
        size = np.array([(values[i] - EFFECTS[name].nominal[i]) / EFFECTS[name].parameters[i].scale for i in acting])
        held = precision[np.ix_(own, own)]
        fisher = held - np.eye(len(own))
        alone = float(size @ fisher @ size)
        hardest, rival = alone, ""
        for other in places:
            if other in (name, TWINS.get(name)):
                continue
            between = precision[np.ix_(own, place(other))]
            rest = fisher - between @ np.linalg.solve(precision[np.ix_(place(other), place(other))], between.T)
            if (left := float(size @ rest @ size)) < hardest:
                hardest, rival = left, other
        gain = 0.5 * alone - 0.5 * float(np.linalg.slogdet(held)[1])
        shown[name] = {"alone": alone, "hardest": max(hardest, 0.0), "rival": rival, "gain": gain}
    return shown


def _visibility(base: Fit, plain: Sequence[PushRecord]) -> float:
    """Noncentrality of all that effects did to the poses, beside everything that the base model fits.

    With the whitened derivative J of the fit and the precision P of its prior, d' (I - J (J'J + P)^-1 J') d of the whitened difference d.

    Args:
        base: fit to the pushes.
        plain: the same pushes without effects, by their order.
    """
    problem = base.problem
    jacobian = problem.jacobian(base.x)
    if jacobian is None:
        return float("nan")
    parts = []
    for record, seen in zip(problem.records, problem.observations, strict=True):
        with_it, without = (_nearest(r, seen.time) for r in (record, plain[record.order]))
        off = with_it - without
        off[:, 2] = wrap_angle(off[:, 2])
        parts.append(np.einsum("fij,fj->fi", seen.whitening, off).ravel())
    difference = np.concatenate(parts)
    precision = np.diag(np.r_[np.ones(base.unknowns.size), np.zeros(3 * len(parts))])
    taken_up = jacobian @ np.linalg.solve(jacobian.T @ jacobian + precision, jacobian.T @ difference)
    return float(difference @ (difference - taken_up))


def _nearest(record: PushRecord, time: FloatArray) -> FloatArray:
    """Poses that were reported nearest to some times, shape (n, 3)."""
    frames = np.abs(record.poses.time[:, None] - time).argmin(axis=0)
    return np.asarray(record.poses.pose[frames])


def _oracle(found: Diagnosis, base: Fit, wanted: Mapping[str, FloatArray]) -> Json:
    """The same machinery told the true effects; `apart`: noncentrality between a single one and the nearest of its rivals when both are
    fitted, which is less than their slopes at null tell."""
    assert found.gap is not None
    start = np.concatenate([(v - EFFECTS[name].nominal) / [p.scale for p in EFFECTS[name].parameters] for name, v in wanted.items()])
    fit = fit_effects(base, (*base.names, *wanted), np.concatenate([base.effect_unknowns, start]))
    is_found = {effect.name for effect in found.effects} == set(wanted)
    after = found.gap.after if is_found else measure_gap(fit, fit, ValidationPolicy()).before
    gap = replace(found.gap, after=after)
    own, first = fit.effects, found.selection.steps[0] if found.selection else None
    same = {*wanted, *(TWINS.get(name) for name in wanted)}
    rivals = {c.name: _apart(fit, c.fit) for c in first.candidates if c.name not in same} if first and len(wanted) == 1 else {}
    return {
        "gain": fit.log_evidence - base.log_evidence,
        "apart": min(rivals.values()) if rivals else None,
        "gap": _gap(gap),
        "parameters": {name: own.values[own.slice_of(name)].tolist() for name in wanted},
    }


def _apart(a: Fit, b: Fit) -> float:
    """Noncentrality between two fits of the same pushes: squared distance of what they say of all frames."""
    said = [[fit.problem.residual(m, push) for push, m in enumerate(fit.problem.simulate(fit.x))] for fit in (a, b)]
    return float(sum(np.sum((one - other) ** 2) for one, other in zip(*said, strict=True)))


def _baselines(found: Diagnosis, base: Fit) -> Json:
    """What simpler ways would name, and how far tuning what the model already has would come."""
    assert found.selection is not None and found.gap is not None
    first = found.selection.steps[0] if found.selection.steps else None
    refits = {c.name: c.fit.end.cost for c in first.candidates} if first else {}
    groups = [(max(group.rms), by) for by, members in found.where.items() for group in members if group.n >= _FEW]
    tuned_fit = fit_effects(base, (*base.names, _TUNED))
    tuned = measure_gap(tuned_fit, tuned_fit, ValidationPolicy())
    gap = replace(found.gap, after=tuned.before)
    return {
        "evidence": first.best.name if first and first.best else None,
        "training_fit": min(refits, key=lambda name: refits[name]) if refits else None,
        "largest_residual": _RESIDUAL_NAMES[max(groups)[1]] if groups else None,
        "tuned_gap": _gap(gap),
    }
