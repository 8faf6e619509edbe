"""The outcome of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from push_ident.diagnosis.account import Account
from push_ident.diagnosis.held_out import Gap, HeldOutFits
from push_ident.diagnosis.odds import Probabilities
from push_ident.diagnosis.policy import DecisionPolicy
from push_ident.diagnosis.residuals import FrameResiduals, ResidualGroup
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.something_else.evidence import SomethingElse
from push_ident.diagnosis.something_else.words import PatternWords
from push_ident.diagnosis.verdict import FoundEffect, FreeLaw, Gate, Verdict
from push_ident.diagnosis.wording import amplitude_of, size_of
from push_ident.identification.fitting.fit import Fit
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.pages.tables import html_table
from push_ident.simulators.gap import SimulatorGap


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The outcome."""

    def __repr__(self) -> str:
        named = ", ".join([*(effect.name for effect in self.effects), *([self.free_law.mechanism.value] if self.free_law else [])])
        return f"Diagnosis({self.verdict.value}{': ' if named else ''}{named}; {self.sentence})"

    def _repr_html_(self) -> str:
        """For notebooks: the verdict in words, the effects that were found, and what would resolve what is open."""
        rows = [(e.name, size_of(e), f"{e.log_bayes_factor:.1f}") for e in self.effects]
        if self.free_law:
            rows.append((self.free_law.mechanism.value, amplitude_of(self.free_law), f"{self.free_law.log_bayes_factor:.1f}"))
        failed = " ".join(f"{gate.finding}: {gate.remedy}" for gate in self.gates if not gate.passed)
        note = " ".join(text for text in (failed, *self.warnings, f"Without a push: {self.check}" if self.check else "") if text)
        columns = ("effect", "size", "log Bayes factor (5: odds of 150 to 1)")
        return html_table(f"{self.verdict.value}: {self.sentence}", columns, rows, note=note)

    verdict: Verdict
    sentence: str
    """A summary for an engineer, in a few sentences."""
    gates: tuple[Gate, ...]
    policy: DecisionPolicy = field(default_factory=DecisionPolicy)
    """Under which it was made."""
    effects: tuple[FoundEffect, ...] = ()
    free_law: FreeLaw | None = None
    """A mechanism that acts by no law of the catalogue, but by a smooth one; then no effect is named."""
    confusion_sets: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Of effects that were found, or of a mechanism with a free law: what may be there in their place."""
    gap: Gap | None = None
    """On held-out pushes; None where the diagnosis abstains, as the following."""
    account: Account | None = None
    """What the error on held-out pushes is made of."""
    selection: Selection | None = None
    held_out: HeldOutFits | None = None
    """Fits without some pushes, at which a diagnosis of these pushes and more may start."""
    where: dict[str, list[ResidualGroup]] = field(default_factory=dict)
    """Residuals of the base model in groups."""
    next_push: PlannedPush | None = None
    """Of the pushes that would make the maps known, where they are not (`Account.more_pushes`): the one that predictions gain most from."""
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
    simulator: SimulatorGap | None = None
    """The gap of somebody else's simulator on the same pushes, where one was given."""
    warnings: tuple[str, ...] = ()
    """What is wrong with the pushes, whatever the verdict says: contacts, clocks or forces that contradict each other (`checking/`)."""

    @property
    def confusion_set(self) -> tuple[str, ...]:
        """All effects that may be there in place of one that was found."""
        return tuple(dict.fromkeys(name for names in self.confusion_sets.values() for name in names))

    @property
    def fit(self) -> Fit | None:
        """Maps with the effects that were found."""
        return self.selection.fit if self.selection else None
