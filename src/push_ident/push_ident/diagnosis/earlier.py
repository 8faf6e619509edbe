"""Fits of an earlier diagnosis of the first of the same pushes, at which those of a diagnosis of more pushes start."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from push_ident.identification.fitting.fit import Fit
from push_ident.types import Float64Array, PushRecord

_Key = tuple[tuple[str, ...], frozenset[int]]
"""Names of the effects of a fit, and the numbers of the pushes that it does not use."""


@dataclass(frozen=True, slots=True)
class EarlierFits:
    """Fits to pushes that are the first ones now."""

    n_pushes: int = 0
    """Number of these pushes."""
    fits: Mapping[_Key, Fit] = field(default_factory=dict)

    @classmethod
    def of(cls, records: Sequence[PushRecord], whole: Iterable[Fit], held_out: Iterable[tuple[Fit, Sequence[int]]]) -> EarlierFits:
        """Those of an earlier diagnosis; none where its pushes are not the first of the present ones.

        `whole`: fits to all of its pushes; `held_out`: fits without some of them, with their numbers.
        """
        fits: dict[_Key, Fit] = {(fit.names, frozenset(fold)): fit for fit, fold in held_out}
        fits |= {(fit.names, frozenset()): fit for fit in whole}
        previous = next((fit.problem.records for (_, fold), fit in fits.items() if not fold), [])
        if not previous or len(previous) > len(records) or not all(map(_is_same, previous, records)):
            return cls()
        return cls(len(previous), fits)

    def base(self, names: Sequence[str]) -> Fit | None:
        """The fit with these effects to all earlier pushes."""
        return self.fits.get((tuple(names), frozenset()))

    def start(self, fit: Fit, fold: Sequence[int]) -> Float64Array | None:
        """Unknowns at which a fit without some pushes may start, None where no earlier fit is like it.

        It knows nothing of these pushes, the `fold`: the earlier fit did not use them either. `fit`: to all present pushes.
        """
        previous = self.fits.get((fit.names, frozenset(push for push in fold if push < self.n_pushes)))
        n_new = sum(push not in fold for push in range(self.n_pushes, len(fit.problem.records)))
        n_z, n_per_push = fit.unknowns.size, fit.problem.unknowns_of_push
        if previous is None or previous.unknowns.size != n_z or previous.problem.unknowns_of_push != n_per_push:
            return None
        z = previous.z * previous.unknowns.amplitude_unit(previous.amplitude / fit.amplitude)
        return np.r_[z, previous.x[n_z:], np.zeros(n_per_push * n_new)]


def _is_same(a: PushRecord, b: PushRecord) -> bool:
    """Whether two records are of one push of one object."""
    if a is b:
        return True
    same_shape = a.shape.is_same_object(b.shape) and np.array_equal(a.shape.outline, b.shape.outline)
    pairs = ((a.poses.time, b.poses.time), (a.poses.pose, b.poses.pose), (a.pusher.position, b.pusher.position))
    return same_shape and a.order == b.order and all(np.array_equal(one, other) for one, other in pairs)
