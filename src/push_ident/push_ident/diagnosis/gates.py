"""Is there anything to diagnose? Data and numerics come first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from push_ident.diagnosis.fits import EffectFit
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.observation import observe_push
from push_ident.identification.problem import FitProblem
from push_ident.types import Float64Array, PushRecord, SolveStatus

__all__ = ["Gate", "check_data", "check_fit"]

_FEWEST = 3
_LARGEST_STEP_EFFECT = 2e-4
"""Mean difference of end positions that half the time step may make [m]."""
_CORRELATED = 0.8
_DROPPED = 0.3


class Gate(tuple[bool, str, str]):
    """(whether it is passed, what was checked with its number, what to do where it is not)."""

    @classmethod
    def of(cls, passed: bool, found: str, remedy: str) -> Gate:
        """One check."""
        return cls((passed, found, remedy))

    @property
    def passed(self) -> bool:
        return self[0]

    @property
    def found(self) -> str:
        return self[1]

    @property
    def remedy(self) -> str:
        return self[2]


def check_data(records: Sequence[PushRecord], settings: DiagnosisSettings) -> list[Gate]:
    """Pushes, dropped frames, and errors that last from frame to frame at rest."""
    touched = [record for record in records if observe_push(record, settings.noise).touched]
    gates = [
        Gate.of(
            len(touched) >= _FEWEST,
            f"{len(touched)} of {len(records)} pushes touch the object",
            f"Record at least {_FEWEST} pushes that move the object; 8 to 14 from different sides tell much more.",
        )
    ]
    gaps = [np.diff(r.poses.time) for r in records if len(r.poses.time) > 5]
    if gaps:
        share = float(np.mean([np.mean(g > 1.8 * np.median(g)) for g in gaps]))
        gates.append(
            Gate.of(
                share < _DROPPED, f"{100 * share:.0f} % of the frames are missing", "Find out why the camera drops frames; record again."
            )
        )
    correlation = _correlation_at_rest(records)
    if np.isfinite(correlation):
        gates.append(
            Gate.of(
                bool(correlation < _CORRELATED),
                f"errors of neighbouring frames at rest correlate by {correlation:.2f}",
                "The poses are filtered or drift: publish unfiltered poses with their covariance.",
            )
        )
    return gates


def _correlation_at_rest(records: Sequence[PushRecord]) -> float:
    """Lag-one autocorrelation of the poses before the pusher moves the object; NaN where too few frames are at rest."""
    products = squares = 0.0
    n = 0
    for record in records:
        speed = np.linalg.norm(np.gradient(record.poses.pose[:, :2], axis=0), axis=1)
        rest = int(np.argmax(speed > 3 * np.median(speed[:5]) + 1e-4)) if len(speed) > 5 else 0
        if rest < 6:
            continue
        off = record.poses.pose[:rest] - record.poses.pose[:rest].mean(axis=0)
        scale = off.std(axis=0) + 1e-12
        off = off / scale
        products += float(np.sum(off[1:] * off[:-1]))
        squares += float(np.sum(off**2)) * (rest - 1) / rest
        n += rest
    return products / squares if n >= 20 else float("nan")


def check_fit(fit: EffectFit) -> list[Gate]:
    """Convergence, and whether half the time step would say otherwise."""
    problem = fit.problem
    finer = replace(problem.settings, step=0.5 * problem.settings.step, smoothing_speed=0.5 * problem.settings.smoothing_speed)
    off = [
        a - b
        for a, b in zip(
            _ends(problem, fit.x),
            _ends(FitProblem(problem.records, fit.parameters, noise=problem.noise, settings=finer), fit.x),
            strict=True,
        )
    ]
    change = float(np.median([np.linalg.norm(o[:2]) for o in off]))
    return [
        Gate.of(
            fit.status in (SolveStatus.CONVERGED, SolveStatus.STALLED),
            f"the fit of the base model ended: {fit.status.name.lower()}",
            "Look at the pushes with the largest residuals; poses may have jumped.",
        ),
        Gate.of(
            change < _LARGEST_STEP_EFFECT,
            f"half the time step moves the ends by {1e3 * change:.2f} mm",
            "Diagnose with a shorter time step.",
        ),
    ]


def _ends(problem: FitProblem, x: Float64Array) -> list[Float64Array]:
    return [motion.pose[-1] for motion in problem.simulate(x)]
