"""The parts of a verdict: what is concluded, the checks before it, and the effects that the pushes support."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from push_ident.physics.effect import Mechanism


class Verdict(Enum):
    """The conclusion; the values are those of the JSON contract."""

    NO_GAP = "no_gap"
    NAMED = "named"
    ONE_OF = "one_of"
    SEVERAL = "several"
    UNKNOWN = "unknown"
    NOT_TRUSTWORTHY = "not_trustworthy"


@dataclass(frozen=True, slots=True)
class Gate:
    """A check that data or numerics have to pass before a verdict is given."""

    passed: bool
    finding: str
    """What was checked, with its number."""
    remedy: str
    """What to do where it is not passed."""


@dataclass(frozen=True, slots=True)
class FoundEffect:
    """An effect that the pushes support, with its size."""

    name: str
    parameters: dict[str, float]
    std: dict[str, float]
    log_bayes_factor: float
    """In the step in which it was added, beside the effects found before it [nat]; NaN for a negligible one."""
    is_free: bool = False
    """Whether the mechanism acts by another law than that of the effect, whose parameters are then the nearest ones."""


@dataclass(frozen=True, slots=True)
class FreeLaw:
    """A mechanism that the pushes support by no law of the catalogue, but by a smooth one."""

    mechanism: Mechanism
    largest: float
    """Amplitude of the law where it is largest: a displacement [m], or a share of the friction of the object or of a cell [1]."""
    std: float
    log_bayes_factor: float
    """Over the base model [nat]."""
    unit: str
    """Of the amplitude; "" for a share."""
