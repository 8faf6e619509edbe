"""Fits of the maps together with some effects, for a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.diagnosis.earlier import EarlierFits
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.fitting.contacts import freed, in_contact
from push_ident.identification.fitting.discrepancy import usual_size, with_size
from push_ident.identification.fitting.fit import AMPLITUDES, Fit, fit_amplitudes
from push_ident.identification.fitting.levenberg_marquardt import minimise
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.unknowns.prior import GIVEN_STD
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.effect_values import EffectValues, effect_values
from push_ident.physics.effects import EFFECTS, FORCE_CAUSES
from push_ident.threads import map_in_threads
from push_ident.types import Float64Array, PushRecord

BASE_WITH_FORCES: Final = tuple(name for name in FORCE_CAUSES if EFFECTS[name].delays_forces)
"""Effects that belong to the base model where forces are measured: contacts that give delay them, and nothing is wrong."""


@dataclass(frozen=True, slots=True)
class _FitSettings:
    """When fits of a diagnosis end, and where they start."""

    max_iterations: int = 40
    """Of a fit that starts from another one."""
    max_base_iterations: int = 150
    """Of the base model, which has to converge even where a strong effect acts on the pushes."""
    max_held_out_iterations: int = 15
    """Of a fit to fewer pushes, which converges within ten where the model is right. Where a strong effect is missing it creeps along
    kinks, and its errors on held-out pushes are known to a few percent after as many."""
    coarse_tolerance: float = 0.05
    """Tolerance of fits that are only compared with each other, where whole units of log evidence decide [nat]."""
    fine_tolerance: float = 5e-3
    """Of others [nat]."""
    held_out_start: float = 0.8
    """Factor of the unknowns at which a fit to fewer pushes starts [-]; see `without_pushes`."""
    rough_iterations: int = 10
    """Of fits that only show the size of the discrepancy."""
    max_size_rounds: int = 4
    """Fits at most until the size of the discrepancy is that of the pushes."""
    promised_by_size: float = 2.0
    """Gain of log evidence that another size of the discrepancy may promise a candidate without being tried [nat]."""
    size_gain: float = 0.5
    """The same where fits are repeated until there is none [nat]."""
    second_start_gain: float = 1.0
    """Expected gain of log evidence above which a fit that gains nothing gets a second start [nat]."""
    second_start: float = 0.4
    """Distance of the second start, relative to the first: a linear guess may overshoot [-]."""


_SETTINGS: Final = _FitSettings()


def fit_base(records: Sequence[PushRecord], settings: DiagnosisSettings, earlier: EarlierFits | None = None) -> Fit:
    """The base model, under the amplitude of the maps' prior with the highest log evidence.

    It starts at an earlier one of the first of the pushes, where there is one.

    Raises InputError where there is no push, or pushes of different objects.
    """
    # Errors of a force sensor are looked for at their own size, not at that which a tare leaves.
    effect_std = {name: [p.scale for p in EFFECTS[name].parameters] for name in FORCE_CAUSES} | settings.effect_std
    # Smooth maps, and the friction of the pusher given.
    max_modes = min(settings.prior.max_modes, settings.max_modes)
    prior = replace(settings.prior, max_modes=max_modes, pusher_friction_std=GIVEN_STD).without_pressure().with_force_offset(records)
    late = [name for name in BASE_WITH_FORCES if prior.force_offset_std > 0 and name not in settings.base_effects]
    unknowns = UnknownsSpec.of(records[0].shape, prior, effects=[*settings.base_effects, *late], effect_std=effect_std)

    problem = FitProblem(records, unknowns, noise=settings.noise, settings=settings.numerics, run_all=map_in_threads)
    previous = earlier.base(unknowns.effects.names) if earlier else None
    starts = [previous.minimum_at(amplitude) for amplitude in AMPLITUDES] if previous else []
    start = np.zeros(problem.size)
    problem, start = _roughly_sized(problem, start)
    fits = fit_amplitudes(lambda amplitude: problem.of(unknowns.at_amplitude(amplitude)), start, _SETTINGS.max_base_iterations, starts)
    return at_its_discrepancy(max(fits, key=lambda fit: fit.log_evidence), _SETTINGS.max_base_iterations, sets_rest=True)


def fit_with_reference(records: Sequence[PushRecord], reference: Sequence[PushRecord], settings: DiagnosisSettings) -> Fit:
    """The base model of pushes and of those of a reference: nothing has changed between them.

    Raises InputError where there is no push, or pushes of different objects.
    """
    known = fit_base(reference, settings)
    unknowns = replace(known.unknowns.with_effects(()), shared=effect_values(known.names))
    problem = FitProblem(
        [*records, *reference], unknowns, noise=settings.noise, settings=settings.numerics, run_all=map_in_threads,
    ).beside_reference(len(reference))  # fmt: skip
    start = np.r_[known.unknowns.layout.moved(known.z, unknowns.layout), np.zeros(problem.size - unknowns.size)]
    start[unknowns.slices["shared_effects"]] = known.effect_unknowns
    problem, start = _roughly_sized(problem, start)
    fit = Fit(problem, *minimise(problem, start, _SETTINGS.max_base_iterations, relative=True), known.amplitude)
    return at_its_discrepancy(fit, _SETTINGS.max_base_iterations, sets_rest=True)


def with_shared(fit: Fit, name: str, start: Float64Array) -> Fit:
    """Fit with one more effect that pushes of a reference have, too; it starts at `start`, shape (n_values,)."""
    before = fit.unknowns
    assert before.shared is not None, "only pushes beside a reference share effects"
    unknowns = replace(before, shared=effect_values((*before.shared.names, name)))
    problem = fit.problem.of(unknowns)
    x0 = fit.problem.layout.moved(fit.x, problem.layout)
    x0[problem.layout.slices["shared_effects"]] = np.r_[fit.z[before.slices["shared_effects"]], start]
    end = minimise(problem, x0, _SETTINGS.max_iterations, tolerance=_SETTINGS.coarse_tolerance)
    return Fit(problem, *end, fit.amplitude)


def _roughly_sized(problem: FitProblem, start: Float64Array) -> tuple[FitProblem, Float64Array]:
    """The problem under the size of the discrepancy that a rough fit shows: nothing needs to be fitted more exactly, nor simulated so."""
    if problem.noise is None or problem.noise.discrepancy_modes == 0:
        return problem, start
    problem, start = in_contact(problem, start)
    rough = Fit(problem, *minimise(problem, start, _SETTINGS.rough_iterations, relative=True))
    rough = at_its_discrepancy(rough, _SETTINGS.rough_iterations, sets_rest=True)
    return rough.problem, rough.x


def at_its_discrepancy(
    fit: Fit, max_iterations: int = _SETTINGS.max_iterations, *, tolerance: float = _SETTINGS.fine_tolerance, sets_rest: bool = False
) -> Fit:
    """The fit repeated, with other contacts where they are better, until its discrepancy has the size that the pushes show; `sets_rest` as
    of `with_size`."""
    for number in range(_SETTINGS.max_size_rounds):
        # Another size hardly brings other contacts: fits that are only compared look for them once.
        looks = number == 0 or tolerance < _SETTINGS.coarse_tolerance
        if looks and (x := freed(fit.problem, fit.x)) is not fit.x:
            problem = fit.problem.of(fit.unknowns)
            fit = Fit(problem, *minimise(problem, x, max_iterations, tolerance=tolerance, relative=True), fit.amplitude)
        if fit.discrepancy_size.log_evidence_gain < _SETTINGS.size_gain:
            break
        problem, x = with_size(fit.problem.of(fit.unknowns), fit.x, fit.discrepancy_size, sets_rest=sets_rest)
        fit = Fit(problem, *minimise(problem, x, max_iterations, tolerance=tolerance, relative=True), fit.amplitude)
    return fit


def fit_effects(
    base: Fit,
    names: Sequence[str],
    start: Float64Array | None = None,
    expected: float = np.inf,
    required: float = -np.inf,
    *,
    under_usual: bool = False,
) -> Fit:
    """Fit other effects to the same pushes under the same prior, precisely enough for a comparison with other fits; see `polished`.

    The maps start at those of `base`; the effects, all `names`, at `start`, shape (n_values,), else at those of `base`, else at zero.
    `expected`: gain of log evidence [nat]; a second start, nearer to zero, is tried where the first gains nothing although it should.
    `required`: least gain at which the fit matters [nat]; a fit that cannot reach it ends early.
    `under_usual`: start under a discrepancy of the usual size: what these effects do has become discrepancy in the fit without them, and
    while that is as large, little is left for them.
    """
    unknowns = base.unknowns.with_effects(names)
    guess = _effects_of({name: base for name in names if name in base.names}, unknowns.effects)
    first = guess if start is None else start
    if under_usual:
        rough = _under_usual(base, unknowns, first)
        return at_its_discrepancy(rough, _SETTINGS.rough_iterations, tolerance=_SETTINGS.coarse_tolerance)
    needed_cost = base.end.cost - required
    fits = [_refit(base, unknowns, first, needed_cost)]
    if start is not None and expected > _SETTINGS.second_start_gain and fits[0].end.cost > base.end.cost - 1.0:
        fits.append(_refit(base, unknowns, guess + _SETTINGS.second_start * (start - guess), needed_cost))
    best = max(fits, key=lambda fit: fit.log_evidence)
    # Another size of the discrepancy promises that gain in the linear range only.
    return (
        at_its_discrepancy(best, tolerance=_SETTINGS.coarse_tolerance)
        if best.discrepancy_size.log_evidence_gain > _SETTINGS.promised_by_size
        else best
    )


def under_usual_discrepancy(fit: Fit) -> Fit:
    """A rough fit of the same effects under a discrepancy of the usual size, which leaves to absent ones what they do."""
    return _under_usual(fit, fit.unknowns, fit.effect_unknowns)


def with_another(fit: Fit, old: str, new: str, other: Fit) -> Fit:
    """Fit with the effect `new` in the place of `old`; `other`: a fit that has it, where its values start."""
    names = [*(name for name in fit.names if name != old), new]
    unknowns = fit.unknowns.with_effects(names)
    return _refit(fit, unknowns, _effects_of({name: other if name == new else fit for name in names}, unknowns.effects))


def polished(fit: Fit) -> Fit:
    """The same fit, converged to full tolerance."""
    problem = fit.problem.of(fit.unknowns)
    return at_its_discrepancy(Fit(problem, *minimise(problem, fit.x, _SETTINGS.max_iterations, start=fit.end), fit.amplitude))


def without_pushes(fit: Fit, pushes: Sequence[int], start: Float64Array | None = None) -> Fit:
    """Fit of the same model to all pushes but some.

    It starts at some distance from the fit to all: the cost has kinks (stick and slip), and from that fit it would stay in those that the
    held-out pushes selected, and predict them too well. Only where it does not even come down to the cost there, a second one starts there.
    `start`: unknowns that know nothing of these pushes either, shape (size,).
    """
    problem, of_others = fit.problem.without(pushes), np.delete(fit.problem.push_unknowns(fit.x), pushes, axis=0).ravel()

    def from_start(x0: Float64Array) -> Fit:
        # As of the base model: where the pushes are explained badly, hundreds of nat apart, a creep of a few decides nothing.
        end = minimise(problem, x0, _SETTINGS.max_held_out_iterations, tolerance=_SETTINGS.coarse_tolerance, relative=True)
        return Fit(problem, *end, fit.amplitude)

    rest = from_start(np.r_[_SETTINGS.held_out_start * fit.z, of_others] if start is None else start)
    of_all = np.r_[fit.z, of_others]
    if rest.end.cost <= problem.cost(of_all):
        return rest
    return min(rest, from_start(of_all), key=lambda one: one.end.cost)


def _effects_of(sources: dict[str, Fit], effects: EffectValues) -> Float64Array:
    """Unknowns of effects, each from the fit that has it, zero where no fit is given; shape (n_values,)."""
    start = np.zeros(len(effects))
    for name, fit in sources.items():
        start[effects.slice_of(name)] = fit.z[fit.unknowns.slice_of_effect(name)]
    return start


def _under_usual(base: Fit, unknowns: UnknownsSpec, effects: Float64Array) -> Fit:
    """A rough fit from the maps and scales of `base` under a discrepancy of the usual size."""
    problem, noise = base.problem.of(unknowns), base.problem.noise
    assert noise is not None, "its discrepancy has a size"
    x0 = base.problem.layout.moved(base.x, problem.layout)
    x0[problem.layout.slices["effects"]] = effects
    x0[unknowns.size :] = 0.0
    usual, x0 = with_size(problem, x0, usual_size(noise, len(problem.records)))
    end = minimise(usual, x0, _SETTINGS.rough_iterations, tolerance=_SETTINGS.coarse_tolerance, relative=True)
    return Fit(usual, *end, base.amplitude)


def _refit(base: Fit, unknowns: UnknownsSpec, effects: Float64Array, needed_cost: float = np.inf) -> Fit:
    """Fit other effects from the maps, scales and first poses of `base`."""
    problem = base.problem.of(unknowns)
    x0 = base.problem.layout.moved(base.x, problem.layout)
    x0[problem.layout.slices["effects"]] = effects
    end = minimise(problem, x0, _SETTINGS.max_iterations, tolerance=_SETTINGS.coarse_tolerance, needed_cost=needed_cost)
    return Fit(problem, *end, base.amplitude)
