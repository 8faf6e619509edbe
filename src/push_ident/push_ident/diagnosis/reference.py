"""What changed since a recording that was good: the reference, and the base model of pushes after it.

What two recordings of one cell share is no cause of their difference, whatever it is. The reference is fitted with all errors that pushes
may show, whose posterior, joint with that of the object, is the prior of the next recording; an effect is added to it as a change. The
discrepancy is expected to be as large as in the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.diagnosis.fits import at_its_discrepancy, fit_base, fit_effects, polished
from push_ident.diagnosis.gates import check_data
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.threads import map_in_threads
from push_ident.errors import InputError
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.fitting.levenberg_marquardt import minimise
from push_ident.identification.fitting.problem import FitProblem
from push_ident.identification.observing.observation import DiscrepancySize, noise_at_rest
from push_ident.identification.unknowns.spec import Reference
from push_ident.physics.effects import CAUSES, EFFECTS
from push_ident.types import PushRecord

SIZE_WIDTH: Final = 0.35
"""Standard deviation of the logarithm of the size of a discrepancy from one recording of a cell to the next [-]. Judgement: a factor of
1.4; halves of one recording differ by about as much as the accuracy of an estimate from seven pushes, 0.25."""
_OF_A_RECORDING: Final = ("wear",)
"""Effects that follow the order of the pushes of a recording, and say nothing of the next."""
_MAX_ITERATIONS: Final = 150
"""Of the base model, as in `fits`."""


def shared_effects() -> tuple[str, ...]:
    """Effects that two recordings of a cell may share: those of one form, each of exact twins once."""
    names: list[str] = []
    for name in CAUSES:
        has_one_form = not any(parameter.shape for parameter in EFFECTS[name].parameters)
        if has_one_form and name not in _OF_A_RECORDING and not any(twin in names for twin in EFFECTS[name].exact_twins):
            names.append(name)
    return tuple(names)


def fit_reference(records: Sequence[PushRecord], settings: DiagnosisSettings) -> Fit:
    """Pushes of a reference, fitted with all effects that the next recording may share.

    Raises InputError where they are too few or cannot be trusted.
    """
    failed = next((gate for gate in check_data(records, settings.noise, settings.policy.gates) if not gate.passed), None)
    if failed is not None:
        raise InputError(f"The reference cannot be used: {failed.finding}. {failed.remedy}")
    base = fit_base(records, replace(settings, noise=noise_at_rest(records, settings.noise)))
    return polished(fit_effects(base, tuple(dict.fromkeys((*base.names, *shared_effects())))))


def fit_after(reference: Fit, records: Sequence[PushRecord], settings: DiagnosisSettings) -> Fit:
    """The base model of pushes after a reference: nothing changed but the errors of the poses.

    Raises InputError where the object has other cells.
    """
    known = reference.unknowns
    unknowns = replace(known.with_effects(()), reference=Reference(known, reference.z, reference.covariance))
    before = reference.problem.noise
    assert before is not None, "a diagnosis has a noise model"
    size = DiscrepancySize(before.discrepancy_factor, before.frame_factor, SIZE_WIDTH)
    noise = replace(settings.noise, discrepancy_factor=size.shared, frame_factor=size.frames, usual_size=size)
    problem = FitProblem(records, unknowns, noise=noise, settings=settings.numerics, run_all=map_in_threads)
    start = np.r_[unknowns.of_reference(reference.z), np.zeros(problem.size - unknowns.size)]
    return at_its_discrepancy(Fit(problem, *minimise(problem, start, _MAX_ITERATIONS, relative=True), reference.amplitude), _MAX_ITERATIONS)
