"""How far equal cells and the identified model miss the end of each push."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.result import Identification
from push_ident.types import Float64Array, PushRecord

__all__ = ["PushErrors", "push_errors"]


@dataclass(frozen=True, slots=True)
class PushErrors:
    """Cell errors of some pushes, see `held_out_errors`; NaN where a push could not be simulated."""

    pushes: tuple[int, ...]
    """Their numbers, from 0 over all pushes."""
    uniform: Float64Array
    """Of equal cells with nominal values [m], shape (n,)."""
    scalar: Float64Array
    """Of equal cells with fitted scalars [m], shape (n,)."""
    identified: Float64Array
    """[m], shape (n,)"""


def push_errors(result: Identification, records: Sequence[PushRecord], pushes: Sequence[int]) -> PushErrors:
    """Cell errors of some of the pushes under equal cells, fitted equal cells and the identified model.

    Args:
        result: of the identification.
        records: all pushes of the object.
        pushes: numbers of those that are asked for, from 0.
    """
    chosen = [records[i] for i in pushes]
    observed = [observe_push(record) for record in chosen]
    uniform, scalar = (held_out_errors(m, chosen, observed=observed) for m in (result.uniform, result.scalar))
    identified = held_out_errors(result.model, chosen, effects=result.posterior.effects, observed=observed)
    return PushErrors(tuple(pushes), uniform, scalar, identified)
