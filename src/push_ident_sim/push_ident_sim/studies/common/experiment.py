"""What an experiment is: independent cases, a summary of their results, tables and pictures of the summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from push_ident.identification.fitting.budget import Budget
from push_ident_sim.objects import OBJECT_NAMES
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings
from push_ident_sim.studies.common.base import Json, Study

__all__ = ["Case", "CaseResult", "CaseSettings", "Experiment"]


@dataclass(frozen=True, slots=True)
class Case:
    """The smallest part of an experiment: independent of all others and of their order, with the same result each time."""

    object_name: str
    model: int
    """Seed of the ground truth, as in `make_object(object_name, model)`."""
    variant: str
    """What the experiment varies, one of `Experiment.variants`."""

    @property
    def truth(self) -> tuple[str, int]:
        """Which ground truth it is about."""
        return self.object_name, self.model

    @property
    def key(self) -> str:
        """Name of its file."""
        return f"{self.object_name}-{self.model:04d}-{self.variant}"


@dataclass(frozen=True, slots=True)
class CaseSettings:
    """What all cases of a run share."""

    truth_folder: Path
    budget: Budget
    """Of each solve."""
    truth: TruthSettings
    noise: CameraNoise
    recordings: Path = Path("../shared/data")
    """Of recorded scenes, for the experiments that use them."""
    minutes: float = 60.0
    """Duration of a case that runs for a given time [min]."""
    goals: int = 4
    """Of each object, for experiments that push to goals."""


@dataclass(frozen=True, slots=True)
class CaseResult:
    """A case and its result."""

    case: Case
    values: Json


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment(Study):
    """One experiment; `summarise` gets a `CaseResult` for each case that gave one."""

    objects: tuple[str, ...] = OBJECT_NAMES
    """Objects, or kinds of objects, that it can take."""
    variants: tuple[str, ...]
    run: Callable[[Case, CaseSettings], Json]
    """One case. May raise PushIdentError: the case then counts as failed."""
    needs_truth: bool = True
    """Whether the ground-truth pushes of `CaseSettings.truth_folder` are made before the cases run."""
    stages: tuple[str, ...] = ("geometry", "physics", "identification")
    """Packages of the core that a result depends on: after a change there, cases run anew."""
    prepare: Callable[[Sequence[Case], Path], Json] | None = None
    """Called with all cases and the folder of results before any of them runs; its result becomes `sealed` in the summary."""
    once: tuple[str, ...] = ()
    """Variants that are one case, of the first object and ground truth."""
    fewer: Mapping[str, int] = field(default_factory=dict)
    """Variants with a largest number of ground truths of each object, whatever number is requested."""
    every: Mapping[str, int] = field(default_factory=dict)
    """Variants that only every so manyth ground truth has, the first one included: those that take long, spread over the whole run."""
    find: Callable[[Path], tuple[str, ...]] | None = None
    """Finds the objects in `CaseSettings.recordings`, in place of `objects`: sets of recorded pushes; a seed is then that of a draw."""
    counts_goals: bool = False
    """Whether each object is pushed to `CaseSettings.goals` goals."""
    timed: bool = False
    """Whether cases run for `CaseSettings.minutes`."""
    headline: tuple[str, ...] = ()
    """Keys of the summary that also stand at the top of the result, for scripts."""
    one_at_a_time: bool = False
    """Whether its cases run in turn, whatever number of processes is requested: live nodes that share their cores fall behind."""
