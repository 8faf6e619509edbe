"""The state of a diagnosis: what is known after a stage. Every stage takes one and returns a new one."""

from __future__ import annotations

from dataclasses import dataclass, field

from push_ident.diagnosis.account import Account
from push_ident.diagnosis.earlier import EarlierFits
from push_ident.diagnosis.held_out import Gap, HeldOutFits
from push_ident.diagnosis.odds import Probabilities
from push_ident.diagnosis.residuals import FrameResiduals
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.something_else.evidence import Pattern, SomethingElse
from push_ident.diagnosis.verdict import FoundEffect, FreeLaw, Gate, Verdict
from push_ident.identification.fitting.fit import Fit
from push_ident.types import PushRecord


@dataclass(frozen=True, slots=True)
class UnsupportedEffect:
    """An effect that only one push, or those that were held out with it, supports, or on which pushes contradict each other."""

    name: str
    """Of the effect; of several that were added at once, joined by "and"."""
    pushes: tuple[int, ...]
    """Numbers of the pushes that support it; none where they contradict each other."""


@dataclass(frozen=True, slots=True)
class Validation:
    """What held-out pushes confirm."""

    selection: Selection
    """Effects that held-out pushes support; none where something without a law of the catalogue acts in their place."""
    gap: Gap
    """With those effects, or with the patterns in their place."""
    account: Account
    """Of that gap."""
    base_residuals: FrameResiduals
    """Of the base model."""
    residuals: FrameResiduals
    """Beside all effects that were found."""
    probabilities: Probabilities
    names_no_effect: bool = False
    """Whether a free law or something else acts in place of all effects that were found."""
    free_law: Pattern | None = None
    """The free law that acts in their place; None where the cause is unknown then."""
    something_else: SomethingElse | None = None
    """Structure in the residuals; None where it could not be looked for."""
    unsupported: UnsupportedEffect | None = None
    held_out: HeldOutFits | None = None
    departing: dict[int, float] = field(default_factory=dict)
    """Pushes that depart from the model much further than the others, by their numbers: how many times as far."""


@dataclass(frozen=True, slots=True)
class Decision:
    """The verdict and what it names."""

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    negligible: tuple[FoundEffect, ...]
    """Detected, but below the accuracy of a cell: part of the base model."""
    confusion_sets: dict[str, tuple[str, ...]]
    """Of effects that were found, or of a mechanism with a free law: what may be there in their place."""
    free_law: FreeLaw | None = None


@dataclass(frozen=True, slots=True)
class DiagnosisState:
    """Pushes, settings in force, and the results of the stages so far."""

    records: tuple[PushRecord, ...]
    """Pushes that the diagnosis uses."""
    requested: DiagnosisSettings
    """As the caller gave them."""
    settings: DiagnosisSettings
    """In force: adapted to a camera and to the noise of the poses."""
    from_camera: bool = False
    """Whether poses and outline come from a camera."""
    rest_noise_known: bool = False
    """Whether frames at rest show how the errors of neighbouring frames are correlated."""
    rest_correlation_std: float = float("inf")
    """Standard error of that correlation [1]."""
    reference: tuple[PushRecord, ...] = ()
    """Pushes of a recording that was good; where there are some, an effect is a change since."""
    earlier: EarlierFits = field(default_factory=EarlierFits)
    """Of a diagnosis of the first of these pushes."""
    data_gates: tuple[Gate, ...] = ()
    fit_gates: tuple[Gate, ...] = ()
    contradictions: tuple[str, ...] = ()
    """Between contacts, clocks and forces of the pushes, one sentence each."""
    base: Fit | None = None
    selection: Selection | None = None
    validation: Validation | None = None
    decision: Decision | None = None

    @property
    def gates(self) -> tuple[Gate, ...]:
        """All that were checked so far."""
        return (*self.data_gates, *self.fit_gates)

    @property
    def abstains(self) -> bool:
        """Whether a gate was not passed, so that no verdict can be given."""
        return not all(gate.passed for gate in self.gates)

    def source_of(self, push: int) -> str:
        """Where a push, by its number, comes from."""
        return (*self.records, *self.reference)[push].source or f"push {push}"
