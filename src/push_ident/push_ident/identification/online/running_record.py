"""Predictions of each recorded push from the pushes before it, as an online identification makes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from push_ident.identification.observing.observation import NoiseModel, observe_push
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.predicting.scoring import PushScore, score_push
from push_ident.identification.unknowns.prior import Prior
from push_ident.types import PushRecord

__all__ = ["running_record"]


def running_record(
    records: Sequence[PushRecord],
    prior: Prior | None = None,
    *,
    noise: NoiseModel | None = None,
    on_push: Callable[[int], None] = lambda number: None,
) -> list[PushScore]:
    """Score every push that touches the object, in order, by the model of those before it; the first by the prior.

    Args:
        records: pushes of one object, at least one.
        prior: nominal values and their standard deviations.
        noise: of the observed poses.
        on_push: called with the number of each push before its prediction, from 1.
    """
    online = OnlineIdentifier(OnlineIdentifier.new(records[0].shape, prior), noise=noise)
    scores: list[PushScore] = []
    for record in records:
        if observe_push(record, noise).touched:
            on_push(len(scores) + 1)
            scores.append(score_push(online.posterior, record, len(scores) + 1, noise=noise))
            online.add(record)
    return scores
