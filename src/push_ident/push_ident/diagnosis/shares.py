"""What each cause closes of the gap on held-out pushes, at their end and over their motion, and what remains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from push_ident.diagnosis.held_out import Gap
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class Closed:
    """Part of an error on held-out pushes."""

    mean: float
    """[m]; below 0 where the error grows."""
    interval: tuple[float, float]
    """Contains it with the probability of the policy [m], by bootstrap over the pushes."""
    share: float
    """Of the error without any cause [1]."""


@dataclass(frozen=True, slots=True)
class ClosedByCause:
    """What a cause closes beside those before it."""

    names: tuple[str, ...]
    """Of the effect; of several that were added together."""
    at_end: Closed
    over_motion: Closed | None
    """None where only ends are known."""


def closed_by_cause(gap: Gap) -> tuple[ClosedByCause, ...]:
    """Of each cause of a gap, in the order in which they were added; none where nothing was added."""
    at_end = removed_by_cause(gap, gap.before, gap.stages, gap.after)
    motion = gap.motion
    over_motion = {} if motion is None else removed_by_cause(gap, motion.before, motion.stages, motion.after)
    return tuple(
        ClosedByCause(names, _closed(gap, values, gap.before), _closed(gap, over_motion[names], motion.before) if motion else None)
        for names, values in at_end.items()
    )


def removed_by_cause(
    gap: Gap, before: Float64Array, stages: Mapping[str, Float64Array], after: Float64Array
) -> dict[tuple[str, ...], Float64Array]:
    """Error of each push that the effects of each stage remove [m], shape (n_pushes,), by their names."""
    if not gap.names:
        return {}
    known: set[str] = set()
    removed = {}
    names_of = [*(key.split(", ") for key in stages), gap.names]
    for names, one, other in zip(names_of, [before, *stages.values()], [*stages.values(), after], strict=True):
        removed[tuple(name for name in names if name not in known)] = one - other
        known |= set(names)
    return removed


def _closed(gap: Gap, values: Float64Array, before: Float64Array) -> Closed:
    return Closed(float(np.mean(values)), gap.mean_interval(values), float(np.mean(values) / np.mean(before)))
