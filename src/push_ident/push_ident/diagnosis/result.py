"""The outcome of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from push_ident.diagnosis.account import Account
from push_ident.diagnosis.held_out import Gap, HeldOutFits
from push_ident.diagnosis.next_push import SeparatingPush
from push_ident.diagnosis.odds import Probabilities
from push_ident.diagnosis.policy import DecisionPolicy
from push_ident.diagnosis.residual_groups import ResidualGroup
from push_ident.diagnosis.residuals import FrameResiduals
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.something_else.evidence import SomethingElse
from push_ident.diagnosis.something_else.words import PatternWords
from push_ident.identification.fit import Fit
from push_ident.identification.next_push import PlannedPush

__all__ = ["Diagnosis", "FoundEffect", "Gate", "Verdict"]


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
    found: str
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


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The outcome."""

    def __repr__(self) -> str:
        named = ", ".join(effect.name for effect in self.effects)
        return f"Diagnosis({self.verdict.value}{': ' if named else ''}{named}; {self.sentence})"

    def _repr_html_(self) -> str:
        """For notebooks: the verdict and the effects that were found."""
        from push_ident.diagnosis.report.summary_table import summary_table

        return summary_table(self)

    verdict: Verdict
    sentence: str
    """A summary for an engineer, in a few sentences."""
    gates: tuple[Gate, ...]
    policy: DecisionPolicy = field(default_factory=DecisionPolicy)
    """Under which it was made."""
    effects: tuple[FoundEffect, ...] = ()
    confusion_sets: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Of effects that were found: those that may be there in their place."""
    gap: Gap | None = None
    """On held-out pushes; None where the diagnosis abstains, as the following."""
    account: Account | None = None
    """What the error on held-out pushes is made of."""
    first_push: PlannedPush | None = None
    """Of the pushes that would make the maps known, where they are not (`Account.more_pushes`): the one that predictions gain most from."""
    selection: Selection | None = None
    held_out: HeldOutFits | None = None
    """Fits without some pushes, at which a diagnosis of these pushes and more may start."""
    where: dict[str, list[ResidualGroup]] = field(default_factory=dict)
    """Residuals of the base model in groups."""
    next_push: SeparatingPush | None = None
    """The push that would resolve what is open; None where no safe push would."""
    check: str = ""
    """What would resolve it without a push."""
    probabilities: Probabilities | None = None
    """Of everything that may be there; None where the diagnosis abstains."""
    something_else: SomethingElse | None = None
    """Structure in the residuals that no effect explains, probable or not."""
    pattern: PatternWords | None = None
    """The most probable such structure in words."""
    base_residuals: FrameResiduals | None = None
    """Residuals of the base model in every frame; `where` is this in groups."""
    residual_ratio: float = np.nan
    """Of the residuals beside all effects that were named."""
    excess_autocorrelation: float = np.nan
    """Of the same residuals."""

    @property
    def confusion_set(self) -> tuple[str, ...]:
        """All effects that may be there in place of one that was found."""
        return tuple(dict.fromkeys(name for names in self.confusion_sets.values() for name in names))

    @property
    def fit(self) -> Fit | None:
        """Maps with the effects that were found."""
        return self.selection.fit if self.selection else None
