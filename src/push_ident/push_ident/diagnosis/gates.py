"""Is there anything to diagnose? Data and numerics come first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from push_ident.diagnosis.fits import EffectFit
from push_ident.diagnosis.seen import SEEN_OUTLINE
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.observation import noise_correlation, observe_push
from push_ident.identification.problem import FitProblem
from push_ident.types import BoolArray, Float64Array, PushRecord, SolveStatus

__all__ = ["Gate", "check_data", "check_fit", "check_outline"]

_FEWEST = 3
_LARGEST_STEP_EFFECT = 2e-4
"""Mean difference of end positions that half the time step may make [m]."""
_LARGEST_OUTLINE_ERROR = 1.5e-3
"""[m]"""
_CORRELATED = 0.8
_DROPPED = 0.3
_JUMP = np.array([0.02, 0.02, 0.35])
"""Beyond noise, from which a pose that comes back has jumped [m, m, rad]: at a frame more than any push moves an object."""
_JUMPING = 0.02


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
    """Pushes, dropped frames, poses that jump, and errors that last from frame to frame at rest."""
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
    gates += [_jumps(records), _correlated(records)]
    return gates


def _jumps(records: Sequence[PushRecord]) -> Gate:
    """Poses that leave those around them and come back: no object does that."""
    share = float(np.mean(np.concatenate([_leaves_its_neighbours(record) for record in records])))
    return Gate.of(
        share < _JUMPING,
        f"{100 * share:.1f} % of the poses jump away from those before and after them",
        "The tracker takes the object for another pose now and then (turned by half a turn, most likely): give it a shape or marks "
        "without that symmetry, or let it refuse such frames.",
    )


def _leaves_its_neighbours(record: PushRecord) -> BoolArray:
    """Of each pose, whether it is far from most of the two before and the two after it, shape (n_frames,)."""
    pose = record.poses.pose
    if len(pose) < 5:
        return np.zeros(len(pose), dtype=bool)
    around = sliding_window_view(np.pad(pose, ((2, 2), (0, 0)), mode="edge"), 5, axis=0) - pose[:, :, None]
    around[:, 2] = wrap_angle(around[:, 2])
    deviation = np.sqrt(np.diagonal(record.poses.covariance, axis1=1, axis2=2))
    far = np.any(np.abs(around) > (_JUMP + 8.0 * deviation)[:, :, None], axis=1)
    return np.asarray(far.sum(axis=1) >= 3)


def _correlated(records: Sequence[PushRecord]) -> Gate:
    correlation = noise_correlation(records)
    found = f"errors of neighbouring frames at rest correlate by {correlation:.2f}"
    return Gate.of(
        not correlation >= _CORRELATED,
        found if np.isfinite(correlation) else "too few frames at rest to tell how their errors correlate",
        "The poses are filtered or drift: publish unfiltered poses with their covariance.",
    )


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


def check_outline(fit: EffectFit) -> list[Gate]:
    """Of an outline that was seen, how far off it is beside all effects that were found: a camera that works is not that far off."""
    (offset,) = fit.effects.values[fit.effects.slice_of(SEEN_OUTLINE)]
    return [
        Gate.of(
            abs(float(offset)) < _LARGEST_OUTLINE_ERROR,
            f"the surface that the pusher met lies {1e3 * float(offset):+.2f} mm outside the outline",
            "Measure the radius of the pusher; calibrate the camera; look at the outline beside the object.",
        )
    ]


def _ends(problem: FitProblem, x: Float64Array) -> list[Float64Array]:
    return [motion.pose[-1] for motion in problem.simulate(x)]
