"""Where the gap lies: residuals grouped by everything that a cause could depend on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from push_ident.diagnosis.policy import ResidualPolicy
from push_ident.diagnosis.residuals import PHASES, FrameResiduals
from push_ident.types import Float64Array

__all__ = ["N_SECTORS", "ResidualGroup", "group_residuals"]

N_SECTORS = 8
"""Of headings, of 45 degrees each."""
_SPEEDS = ("at rest", "slow", "medium", "fast")
_REGIONS = ("x low, y low", "x low, y high", "x high, y low", "x high, y high")


@dataclass(frozen=True, slots=True)
class ResidualGroup:
    """Frames that share a property."""

    name: str
    n: int
    """Number of frames."""
    rms: tuple[float, float, float]
    """Root mean square of the standardized residual along, across and in rotation: about 1 where the model is right."""
    mean_m: float
    """Mean distance of the simulated object from the observed one [m]."""
    p_value: tuple[float, float, float]
    """Probability of each root mean square, or of a larger one, under the model."""


def group_residuals(frames: FrameResiduals, policy: ResidualPolicy) -> dict[str, list[ResidualGroup]]:
    """Residuals by push, phase, speed, heading in table and object, and table region."""
    moving = frames.speed > policy.rest_speed
    quantiles = np.quantile(frames.speed[moving], [1 / 3, 2 / 3]) if np.any(moving) else np.zeros(2)
    speeds = np.where(moving, 1 + np.searchsorted(quantiles, frames.speed), 0)
    middle = np.median(frames.position, axis=0)
    quarter = (frames.position[:, 0] > middle[0]) * 2 + (frames.position[:, 1] > middle[1])
    pushes = np.unique(frames.push)
    return {
        "push": _grouped(frames, frames.push, [str(int(push)) for push in pushes], pushes),
        "phase": _grouped(frames, frames.phase, PHASES, range(4)),
        "speed": _grouped(frames, speeds, _SPEEDS, range(4)),
        "heading_in_table": _sectors(frames, frames.heading_in_table),
        "heading_in_body": _sectors(frames, frames.heading_in_object),
        "table_region": _grouped(frames, quarter, _REGIONS, range(4)),
    }


def _sectors(frames: FrameResiduals, heading: Float64Array) -> list[ResidualGroup]:
    sector = np.floor((heading + np.pi / N_SECTORS) / (2 * np.pi / N_SECTORS)).astype(int) % N_SECTORS
    return _grouped(frames, sector, [f"{360 * i // N_SECTORS} deg" for i in range(N_SECTORS)], range(N_SECTORS))


def _grouped(frames: FrameResiduals, key: Float64Array, names: Sequence[str], values: Sequence[Any] | Float64Array) -> list[ResidualGroup]:
    """Groups of the frames whose `key` has each of the values; groups without a frame are left out."""
    groups = []
    for name, value in zip(names, values, strict=True):
        chosen = key == value
        if np.any(chosen):
            rms = np.sqrt(np.mean(frames.standardized[chosen] ** 2, axis=0))
            distance = float(np.mean(np.linalg.norm(frames.difference[chosen, :2], axis=1)))
            p_value = np.mean(np.sqrt(np.mean(frames.null_draws[:, chosen] ** 2, axis=1)) >= rms, axis=0)
            groups.append(ResidualGroup(name, int(chosen.sum()), _triple(rms), distance, _triple(p_value)))
    return groups


def _triple(values: Float64Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
