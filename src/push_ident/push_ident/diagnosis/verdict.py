"""What a diagnosis says."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from push_ident.diagnosis.fits import EffectFit
from push_ident.diagnosis.gates import Gate
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.next_push import SeparatingPush
from push_ident.diagnosis.residuals import Frames, Group
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.unknown import SmoothWrench

__all__ = ["Diagnosis", "FoundEffect", "Verdict"]


class Verdict(Enum):
    """What the pushes say; the values are those of the JSON contract."""

    NO_GAP = "no_gap"
    NAMED = "named"
    ONE_OF = "one_of"
    SEVERAL = "several"
    UNKNOWN = "unknown"
    NOT_TRUSTWORTHY = "not_trustworthy"


@dataclass(frozen=True, slots=True)
class FoundEffect:
    """An effect that the pushes speak for."""

    name: str
    parameters: dict[str, float]
    std: dict[str, float]
    evidence: float
    """Gain of log evidence in the step in which it came, beside those found before it [nat]."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The outcome."""

    verdict: Verdict
    sentence: str
    """What an engineer needs to know, in one sentence."""
    effects: tuple[FoundEffect, ...]
    doubts: dict[str, tuple[str, ...]]
    """Of effects that were found: those that these pushes cannot tell from them."""
    gap: Gap | None
    """On pushes held out; None where nothing could be trusted."""
    gates: tuple[Gate, ...]
    selection: Selection | None
    where: dict[str, list[Group]]
    next_push: SeparatingPush | None
    check: str
    """What would settle it without a push."""
    unknown: SmoothWrench | None = None
    """What a smooth wrench of unknown cause explains, where there is a trace of one."""
    frames: Frames | None = None
    """What the base model leaves of every frame; `where` is this in groups. None where nothing could be trusted."""
    leftover: float = np.nan
    """Mean square of the residuals beside all that the catalogue explains, over that of a model that is right."""
    lasting: float = np.nan
    """What of it lasts from frame to frame, which noise does not."""

    @property
    def confusable(self) -> tuple[str, ...]:
        """All effects that these pushes cannot tell from one that was found."""
        return tuple(dict.fromkeys(name for names in self.doubts.values() for name in names))

    @property
    def fit(self) -> EffectFit | None:
        """Maps with the effects that were found."""
        return self.selection.fit if self.selection else None
