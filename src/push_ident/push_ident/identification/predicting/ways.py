"""The ways in which a push may end, where the drawn models disagree: it turns left under some of them, right under others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.geometry.cells import cell_displacement
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.predicting.prediction import Prediction
from push_ident.types import CellGrid, Float64Array

__all__ = ["Way", "ways_of"]

_RARE: Final = 0.1
"""Least chance of a way that is reported [1]: a rarer one lies outside the 90 % region of the prediction."""
_APART: Final = 2.0
"""Standard deviations about its mean to which a way reaches; ways that overlap are one."""


@dataclass(frozen=True, slots=True)
class Way:
    """One of them."""

    chance: float
    """[1]"""
    end: Float64Array
    """Mean last pose, table frame, shape (3,)."""


def ways_of(cells: CellGrid, prediction: Prediction) -> list[Way]:
    """One way, or two that are clearly apart, the likelier first; none where the prediction failed.

    The last poses under the drawn models are cut in two along the direction in which they differ most, where the variance within both
    parts is least (Otsu's threshold, IEEE Trans. SMC 9, 1979). Distances are root mean squares over the cells;
    ways that poses cannot tell apart are one.

    Args:
        cells: of the object.
        prediction: with its draws.
    """
    ends = prediction.ends
    if len(ends) == 0:
        return []
    # Headings are counted from that of the prediction, so that none wraps.
    ends = np.column_stack([ends[:, :2], prediction.pose[-1, 2] + wrap_angle(ends[:, 2] - prediction.pose[-1, 2])])
    metric = cell_displacement(cells, float(prediction.pose[-1, 2]))
    offset = (ends - ends.mean(axis=0)) @ metric.T
    score = offset @ np.linalg.svd(offset, full_matrices=False)[2][0]
    order = np.argsort(score)
    least = max(1, int(np.ceil(_RARE * len(ends))))
    cuts = range(least, len(ends) - least + 1)
    if not cuts:
        return [Way(1.0, ends.mean(axis=0))]
    cut = min(cuts, key=lambda n: np.var(score[order[:n]]) * n + np.var(score[order[n:]]) * (len(ends) - n))
    parts = [order[:cut], order[cut:]]
    gap = float(np.mean(score[parts[1]]) - np.mean(score[parts[0]]))
    floor = metric @ NoiseModel().floor @ metric.T
    reach = sum(float(np.sqrt(np.var(score[part]) + np.trace(floor))) for part in parts)
    if gap <= _APART * reach:
        return [Way(1.0, ends.mean(axis=0))]
    ways = [Way(len(part) / len(ends), ends[part].mean(axis=0)) for part in parts]
    return sorted(ways, key=lambda way: -way.chance)
