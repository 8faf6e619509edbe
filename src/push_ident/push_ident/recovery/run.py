"""The self-test of a recording, within a budget of time."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.diagnosis.base_fit import fit_base_model
from push_ident.diagnosis.diagnose import initial_state
from push_ident.diagnosis.gates import check_pushes
from push_ident.diagnosis.policy import DecisionPolicy, NextPushPolicy, UnknownPolicy
from push_ident.diagnosis.settings import DiagnosisSettings, Progress
from push_ident.diagnosis.state import DiagnosisState
from push_ident.errors import InputError
from push_ident.identification.fitting.fit import Fit, FitOptions
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.recovery.effects import Proof, VisibleEffect, prove, visible_effects, worth_proving
from push_ident.recovery.maps import MapTest, Recovery, recoveries_of, try_maps
from push_ident.types import PushRecord, short_repr

_QUICK: Final = DecisionPolicy(unknown=UnknownPolicy(draws=200), next_push=NextPushPolicy(candidates=24, references=8))
"""Fewer draws and candidate pushes than a diagnosis has by default: no next push is wanted, and causes are clear."""
_MAPS_SHARE: Final = 0.5
"""Of the budget until which objects are begun [1]; the rest is for effects."""


@dataclass(frozen=True, slots=True)
class SelfTestOptions:
    """How much is tried."""

    seconds: float = 60.0
    """Wall time after which nothing more is begun [s]; what was begun ends."""
    maps: int = 4
    """Objects drawn from the prior."""
    seed: int = 0
    """Of the objects and of the noise."""


@dataclass(frozen=True, slots=True)
class SelfTest:
    """What the pushes of a recording can tell, and what not."""

    __repr__ = short_repr

    n_pushes: int
    options: SelfTestOptions
    discrepancy: float
    """Of the pushes from the model by travel, which the twins have, too; the default where no base model was fitted [1]."""
    tests: tuple[MapTest, ...]
    quantities: tuple[Recovery, ...]
    effects: tuple[VisibleEffect, ...]
    """The most visible one for its typical size first."""
    proofs: tuple[Proof, ...]
    left_out: tuple[str, ...] = ()
    """What was not tried, and why."""
    seconds: float = 0.0
    """Wall time [s]."""


class _Trial:
    """Work in a budget of time."""

    def __init__(self, state: DiagnosisState, options: SelfTestOptions, report: Progress, start: float) -> None:
        """`start`: of the time, by `perf_counter` [s]."""
        self.state, self.options, self.report, self._start = state, options, report, start
        self.noise = state.settings.noise if state.base is None else state.base.problem.noise or NoiseModel()
        self.left_out: list[str] = []

    @property
    def elapsed(self) -> float:
        """Wall time [s]."""
        return time.perf_counter() - self._start

    def objects(self, records: Sequence[PushRecord], prior: Prior, nuisances: Sequence[str]) -> list[MapTest]:
        """Up to `SelfTestOptions.maps` objects while their share of the time lasts, at least one."""
        tests: list[MapTest] = []
        fits, longest = FitOptions(threads=len(os.sched_getaffinity(0))), 0.0
        for k in range(self.options.maps):
            if tests and self.elapsed + longest > _MAPS_SHARE * self.options.seconds:
                self.left_out.append(f"{self.options.maps - k} of {self.options.maps} objects: no time")
                break
            self.report(f"object {k + 1} of {self.options.maps} drawn from the prior")
            start = self.elapsed
            try:
                tests.append(try_maps(records, prior, nuisances, self.noise, np.random.default_rng([self.options.seed, k]), fits))
            except InputError as error:
                self.left_out.append(f"object {k + 1}: {error}")
            longest = max(longest, self.elapsed - start)
        return tests

    def proofs(self, base: Fit, effects: Sequence[VisibleEffect], settings: DiagnosisSettings) -> list[Proof]:
        """Of effects that are worth it, while the time lasts for another one like the last."""
        proofs: list[Proof] = []
        chosen, longest = worth_proving(effects), 0.0
        for k, effect in enumerate(chosen):
            if self.elapsed + longest > self.options.seconds:
                self.left_out.append(f"proof of {', '.join(one.name for one in chosen[k:])}: no time")
                break
            self.report(f"putting {effect.name} into the pushes and diagnosing them")
            start = self.elapsed
            try:
                proofs.append(
                    prove(self.state.records, base, effect, self.noise, settings, np.random.default_rng([self.options.seed, 100 + k]))
                )
            except InputError as error:
                self.left_out.append(f"proof of {effect.name}: {error}")
            longest = max(longest, self.elapsed - start)
        return proofs


def selftest(
    records: Sequence[PushRecord],
    settings: DiagnosisSettings | None = None,
    *,
    nuisances: Sequence[str] = (),
    options: SelfTestOptions | None = None,
    on_progress: Progress | None = None,
) -> SelfTest:
    """Put known maps and known effects into simulated twins of recorded pushes, and look whether they are recovered.

    Args:
        records: pushes of one object.
        settings: prior and base model, as for an identification and a diagnosis of the recording.
        nuisances: effects that identification fits with the maps, see `LoadedPushes.nuisances`.
        options: how much is tried.
        on_progress: called with what is under way.

    Raises:
        InputError: no push, pushes of different objects, or an unknown effect in the base model.
    """
    start, report = time.perf_counter(), on_progress or (lambda text: None)
    settings, options = replace(settings or DiagnosisSettings(), policy=_QUICK), options or SelfTestOptions()
    state = fit_base_model(check_pushes(initial_state(records, settings)), report)
    trial, base = _Trial(state, options, report, start), None if state.abstains else state.base
    if base is None:
        trial.left_out.append(f"effects: {'; '.join(gate.finding for gate in state.gates if not gate.passed)}")
    report("sizes of effects that would be visible")
    effects = [] if base is None else visible_effects(base, state.settings.policy.selection)
    tests = trial.objects(state.records or records, settings.prior, nuisances)
    proofs = [] if base is None else trial.proofs(base, effects, settings)
    known = recoveries_of(tests, prior_posterior(records[0].shape, settings.prior))
    return SelfTest(
        len(records), options, float(trial.noise.model_discrepancy[0]), tuple(tests), known, tuple(effects), tuple(proofs),
        tuple(trial.left_out), trial.elapsed,
    )  # fmt: skip
