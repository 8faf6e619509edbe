"""One case of the blind check: the diagnosis, the detectability of the truth, a fit of the true effects, and simpler baselines."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.fits import fit_effects
from push_ident.diagnosis.held_out import Gap, measure_gap
from push_ident.diagnosis.odds import SOMETHING_ELSE, Probabilities
from push_ident.diagnosis.policy import ValidationPolicy
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.scores import EffectInformation
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.physics.effects import EFFECTS
from push_ident.types import PushRecord
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import SimObject
from push_ident_sim.studies.blind.cases import Truth
from push_ident_sim.studies.common.base import Json

__all__ = ["MakePush", "score_case", "true_values", "twins_of"]

FloatArray = NDArray[np.float64]
MakePush = Callable[[PlannedPush, int], PushRecord | None]
"""Makes a requested push after a number of others; None where that is not possible."""

_RESIDUAL_NAMES = {
    "push": "wear",
    "phase": "pusher_lag",
    "speed": "speed_dependent_friction",
    "heading_in_table": "table_tilt",
    "heading_in_body": "base_anisotropy",
    "table_region": "position_dependent_friction",
}
"""Effect that one would guess from the group with the largest residuals."""
_MAX_REQUESTED = 2
"""Largest number of pushes that a diagnosis may request to resolve its confusion set."""
_FEW = 5
"""Smallest number of frames in a group."""
_TUNED = "pusher_friction"
"""The existing parameter that the base model does not fit."""


def twins_of(name: str) -> tuple[str, ...]:
    """Effects that no push can distinguish from one; none for a name outside the catalogue."""
    return EFFECTS[name].exact_twins if name in EFFECTS else ()


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
    make_push: MakePush | None = None,
    make_plain: Callable[[], Sequence[PushRecord]] | None = None,
) -> Json:
    """Diagnose the pushes of a case and compare the result with the truth.

    Args:
        records: the pushes.
        truth: of the case.
        thing: what was pushed.
        settings: of the diagnosis.
        make_push: makes a push that the diagnosis requests; without it, confusion sets stay as they are.
        make_plain: makes the same pushes with the same noise without any effect; without it, the visibility of effects outside the
            catalogue is not computed.
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
        # An effect of the base model, such as a small error of a camera, is not to be found.
        names = [name for name in truth.names if name not in base.names]
        wanted = {name: true_values(truth.effects, name, first) for name in names}
        values["true_parameters"] = {name: v.tolist() for name, v in wanted.items()}
        if wanted:
            values["detectability"] = _detectability(found.selection.steps[0].information, wanted)
            values["oracle"] = _oracle(found, base, wanted)
    if truth.scenario.kind == "outside" and make_plain is not None:
        values["visibility"] = _visibility(base, make_plain())
    if truth.scenario.kind == "single" and make_push is not None and _is_open(found):
        values["asked"] = _settle(found, list(records), settings, make_push)
    values["baselines"] = _baselines(found, base)
    return values


def _is_open(found: Diagnosis) -> bool:
    """Whether the confusion set has an effect that is no exact twin of the named one."""
    first = found.effects[-1].name if found.effects else ""
    return any(name not in twins_of(first) for name in found.confusion_set)


def _settle(found: Diagnosis, records: list[PushRecord], settings: DiagnosisSettings, make_push: MakePush) -> Json:
    """Make the pushes that the diagnosis requests until its confusion set is resolved."""
    n_requested, expected = 0, found.next_push is not None and found.next_push.resolves
    while _is_open(found) and n_requested < _MAX_REQUESTED and found.next_push is not None:
        more = make_push(found.next_push.push, len(records))
        if more is None:
            break
        records.append(more)
        found = diagnose(records, settings)
        n_requested += 1
    return {
        "n": n_requested,
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
        # Enough to try another policy without fitting again.
        "steps": [] if found.selection is None else [_step(found.selection, i) for i in range(len(found.selection.steps))],
        "misfit": None if found.base_residuals is None else found.base_residuals.residual_ratio,
        "residual_ratio": found.residual_ratio,
        "excess_autocorrelation": found.excess_autocorrelation,
        "unknown_gain": None if found.something_else is None else found.something_else.log_bayes_factor,
        "probabilities": None if found.probabilities is None else _probabilities(found.probabilities),
        "failed_gates": [gate.found for gate in found.gates if not gate.passed],
    }


def _probabilities(found: Probabilities) -> Json:
    return {**found.effects, SOMETHING_ELSE: found.something_else, "nothing": found.nothing}


def _step(selection: Selection, number: int) -> Json:
    step = selection.steps[number]
    first = next((score for score in step.scores), None)
    return {
        "gains": {c.name: c.log_bayes_factor for c in step.candidates},
        "scores": {score.name: score.expected_log_bayes_factor for score in step.scores},
        "costs": {c.name: c.fit.end.cost for c in step.candidates},
        "best_score": None if first is None else first.name,
        # Without effects that are not detectable at any plausible size.
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
    """Detectability of each true effect: its noncentrality beside everything that the base model fits.

    `alone`: beside the base. `hardest`: also beside the rival of the catalogue that reduces it most. `gain`: mean increase of the log
    evidence at its true size.
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
        beside_base = float(size @ fisher @ size)
        hardest, rival = beside_base, ""
        for other in places:
            if other in (name, *twins_of(name)):
                continue
            between = precision[np.ix_(own, place(other))]
            rest = fisher - between @ np.linalg.solve(precision[np.ix_(place(other), place(other))], between.T)
            if (reduced := float(size @ rest @ size)) < hardest:
                hardest, rival = reduced, other
        gain = 0.5 * beside_base - 0.5 * float(np.linalg.slogdet(held)[1])
        shown[name] = {"alone": beside_base, "hardest": max(hardest, 0.0), "rival": rival, "gain": gain}
    return shown


def _visibility(base: Fit, plain: Sequence[PushRecord]) -> float:
    """Noncentrality of the change of the poses by all effects, beside everything that the base model fits.

    With the whitened derivative J of the fit and the precision P of its prior, d' (I - J (J'J + P)^-1 J') d of the whitened difference d.

    Args:
        base: fit to the pushes.
        plain: the same pushes without effects, by their order.
    """
    problem = base.problem
    linear = problem.linearise(base.x)
    if linear is None:
        return float("nan")
    parts = []
    for record, observed in zip(problem.records, problem.observations, strict=True):
        with_it, without = (_nearest(r, observed.time) for r in (record, plain[record.order]))
        change = with_it - without
        change[:, 2] = wrap_angle(change[:, 2])
        parts.append(np.einsum("fij,fj->fi", observed.whitening, change).ravel())
    difference = np.concatenate(parts)
    jacobian, precision = linear.by_poses, np.diag(problem.unit_prior)
    absorbed = jacobian @ np.linalg.solve(jacobian.T @ jacobian + precision, jacobian.T @ difference)
    return float(difference @ (difference - absorbed))


def _nearest(record: PushRecord, time: FloatArray) -> FloatArray:
    """Poses that were reported nearest to some times, shape (n, 3)."""
    frames = np.abs(record.poses.time[:, None] - time).argmin(axis=0)
    return np.asarray(record.poses.pose[frames])


def _oracle(found: Diagnosis, base: Fit, wanted: Mapping[str, FloatArray]) -> Json:
    """The same computation with the true effects given. `apart`: noncentrality between a single one and the nearest of its rivals when
    both are fitted, which is less than their derivatives at null give."""
    assert found.gap is not None
    start = np.concatenate([(v - EFFECTS[name].nominal) / [p.scale for p in EFFECTS[name].parameters] for name, v in wanted.items()])
    fit = fit_effects(base, (*base.names, *wanted), np.concatenate([base.effect_unknowns, start]))
    is_found = {effect.name for effect in found.effects} == set(wanted)
    after = found.gap.after if is_found else measure_gap(fit, fit, ValidationPolicy()).before
    gap = replace(found.gap, after=after)
    own, first = fit.effects, found.selection.steps[0] if found.selection else None
    same = {*wanted, *(twin for name in wanted for twin in twins_of(name))}
    rivals = {c.name: _separation(fit, c.fit) for c in first.candidates if c.name not in same} if first and len(wanted) == 1 else {}
    return {
        "gain": fit.log_evidence - base.log_evidence,
        "apart": min(rivals.values()) if rivals else None,
        "gap": _gap(gap),
        "parameters": {name: own.values[own.slice_of(name)].tolist() for name in wanted},
    }


def _separation(a: Fit, b: Fit) -> float:
    """Noncentrality between two fits of the same pushes: squared distance of their standardized residuals in all frames."""
    residuals = [[fit.problem.residual(fit.x, m, push) for push, m in enumerate(fit.problem.simulate(fit.x))] for fit in (a, b)]
    return float(sum(np.sum((one - other) ** 2) for one, other in zip(*residuals, strict=True)))


def _baselines(found: Diagnosis, base: Fit) -> Json:
    """Names that simpler rules give, and the gap after tuning a parameter that the model already has."""
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
