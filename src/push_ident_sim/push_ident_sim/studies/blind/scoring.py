"""One case of the blind check: the diagnosis, and the detectability of the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.diagnosis_json import to_json
from push_ident.diagnosis.fits import fit_effects, polished
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.odds import SOMETHING_ELSE
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.identification.fitting.discrepancy import LinearPushes
from push_ident.identification.fitting.fit import Fit
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array, PushRecord
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import SimObject
from push_ident_sim.studies.blind.cases import Truth
from push_ident_sim.studies.common.study import Json


def twins_of(name: str) -> tuple[str, ...]:
    """Effects that no push can distinguish from one; none for a name outside the catalogue."""
    return EFFECTS[name].exact_twins if name in EFFECTS else ()


def true_values(effects: InjectedEffects, name: str, put_down: Float64Array) -> Float64Array:
    """An injected effect with all its parameters, shape (n_parameters,).

    A tether that states no anchor has it at `put_down`, the centre of mass where the object was put down first [m], shape (2,).
    """
    given = effects[name]
    if len(given) < len(EFFECTS[name].parameters):
        return np.array([given[0], *(given[0] * put_down)])
    return np.array(given)


def score_case(
    records: Sequence[PushRecord],
    truth: Truth,
    sim_object: SimObject,
    settings: DiagnosisSettings,
    *,
    make_plain: Callable[[], Sequence[PushRecord]] | None = None,
) -> Json:
    """Diagnose the pushes of a case and compare the result with the truth.

    `make_plain` makes the same pushes with the same noise without any effect; without it, the visibility of effects outside the catalogue
    is not computed.
    """
    start = time.process_time()
    diagnosis = diagnose(records, settings)
    values = {**_outcome(diagnosis), "seconds": time.process_time() - start, "truth": truth.as_json()}
    if diagnosis.selection is None or diagnosis.gap is None:
        return values
    base = diagnosis.selection.base
    if truth.names:
        centre = sim_object.mass @ sim_object.cells / sim_object.mass.sum()
        put_down = transform_points(records[0].poses.pose[0], centre[None])[0]
        # An effect of the base model, such as a small error of a camera, is not to be named.
        wanted = {name: true_values(truth.effects, name, put_down) for name in truth.names if name not in base.names}
        values["true_parameters"] = {name: v.tolist() for name, v in wanted.items()}
        if wanted:
            values["detectability"] = _detectability(base, wanted)
    if truth.scenario.kind in ("foreign", "outside") and make_plain is not None:
        values["visibility"] = _visibility(base, make_plain())
    return values


def _outcome(diagnosis: Diagnosis) -> Json:
    probabilities = diagnosis.probabilities
    return {
        "verdict": diagnosis.verdict.value,
        "sentence": diagnosis.sentence,
        "effects": to_json(diagnosis)["effects"],
        "confusable": list(diagnosis.confusion_set),
        "gap": None if diagnosis.gap is None else _gap(diagnosis.gap),
        "account_holds": account_holds(diagnosis),
        "probabilities": None
        if probabilities is None
        else {**probabilities.effects, SOMETHING_ELSE: probabilities.something_else, "nothing": probabilities.nothing},
        "failed_gates": [gate.finding for gate in diagnosis.gates if not gate.passed],
    }


def account_holds(diagnosis: Diagnosis) -> bool | None:
    """Whether noise, maps and discrepancy explain the error on held-out pushes beside all that is named, within the interval at 90 %; None
    without a verdict."""
    if diagnosis.account is None:
        return None
    low, high = diagnosis.account["unexplained"].interval
    return low <= 0.0 <= high


def _gap(gap: Gap) -> Json:
    means = {f"{key}_m": float(np.mean(getattr(gap, key))) for key in ("before", "after", "noise")}
    return {**means, "shrink": gap.shrink if gap.is_above_noise else None}


def _detectability(base: Fit, wanted: Mapping[str, Float64Array]) -> Json:
    """Detectability of each true effect beside all others that are fitted: `gain` of the log evidence for mean noise, and `certain_gain`,
    which nine of ten draws of the noise exceed.

    In the linear range of the fit that is given all true effects, with pushes as it predicts them at the true sizes. Without an effect, a
    discrepancy that the pushes size grows by what it explains of it.
    """
    acting = {name: [not p.shape for p in EFFECTS[name].parameters] for name in wanted}
    sizes = {
        name: np.array([(v - n) / p.scale for v, n, p in zip(values, EFFECTS[name].nominal, EFFECTS[name].parameters, strict=True)])
        for name, values in wanted.items()
    }
    fit = polished(fit_effects(base, (*base.names, *wanted), np.concatenate([base.effect_unknowns, *sizes.values()])))
    first, hessian, x = fit.unknowns.slices["effects"].start, fit.end.hessian, np.array(fit.z)
    at = {name: first + np.arange(*fit.effects.slice_of(name).indices(len(fit.effects.values)))[acting[name]] for name in wanted}
    for name, index in at.items():
        x[index] = sizes[name][acting[name]]
    shown, pushes = {}, LinearPushes.of(fit.problem, fit.x, hessian, fit.end.gradient)
    for name, index in at.items():
        others = np.setdiff1d(np.arange(len(hessian)), index)
        between = hessian[np.ix_(others, index)]
        held = hessian[np.ix_(index, index)] - between.T @ np.linalg.solve(hessian[np.ix_(others, others)], between)
        noncentrality = float(x[index] @ (held - np.eye(len(index))) @ x[index])
        least, at_least = max(0.0, 1.0 - 1.2816 / np.sqrt(max(noncentrality, 1e-9))), np.array(x)  # lowest tenth of a normal distribution
        at_least[index] *= least
        shown[name] = {"gain": pushes.expected_gain(x, index), "certain_gain": pushes.expected_gain(at_least, index)}
    return shown


def _visibility(base: Fit, plain: Sequence[PushRecord]) -> float:
    """Noncentrality of the change of the poses by all effects, from the same pushes without them, beside all that the base model fits.

    With the whitened derivative J of the fit and the precision P of its prior, d' (I - J (J'J + P)^-1 J') d of the whitened difference d.
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
    jacobian, precision = linear.by_poses, np.diag(problem.prior_precision)
    absorbed = jacobian @ np.linalg.solve(jacobian.T @ jacobian + precision, jacobian.T @ difference)
    return float(difference @ (difference - absorbed))


def _nearest(record: PushRecord, time: Float64Array) -> Float64Array:
    """Poses that were reported nearest to some times, shape (n, 3)."""
    frames = np.abs(record.poses.time[:, None] - time).argmin(axis=0)
    return np.asarray(record.poses.pose[frames])
