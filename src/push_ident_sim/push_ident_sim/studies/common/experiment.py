"""What an experiment is: cases that run alone, a summary of their results, tables and pictures of the summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from push_ident.identification.budget import Budget
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings

__all__ = ["Case", "CaseResult", "CaseSettings", "Experiment", "Json"]

Json = dict[str, Any]
"""What `json` can write; lengths in metres, times in seconds."""


@dataclass(frozen=True, slots=True)
class Case:
    """The smallest piece of an experiment: it runs alone, in any order, and gives the same result each time."""

    object_name: str
    model: int
    """Seed of the ground truth: `make_object(object_name, model)`."""
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


@dataclass(frozen=True, slots=True)
class CaseResult:
    """A case and what came out of it."""

    case: Case
    values: Json


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment. Tables and pictures are made of the summary alone, so that they can be made again from its file."""

    name: str
    title: str
    question: str
    """What is asked and how it is measured: a paragraph for the reader of the report."""
    variants: tuple[str, ...]
    run: Callable[[Case, CaseSettings], Json]
    """One case. May raise PushIdentError: the case then counts as failed."""
    summarise: Callable[[Sequence[CaseResult]], Json]
    """All results that are there, in one small object."""
    tables: Callable[[Json], str]
    """Markdown of a summary."""
    draw: Callable[[Json, Path], dict[str, str]]
    """Write pictures of a summary into a folder: file names and captions."""
    needs_truth: bool = True
    """Whether the ground-truth pushes of `CaseSettings.truth_folder` are made before the cases run."""
    stages: tuple[str, ...] = ("geometry", "physics", "identification")
    """Packages of the core that a result depends on: after a change there, cases run anew."""
    prepare: Callable[[Sequence[Case], Path], Json] | None = None
    """Called with all cases and the folder of results before any of them runs; what it returns stands in the summary as `sealed`."""
    once: tuple[str, ...] = ()
    """Variants that are one case, of the first object and ground truth."""
    fewer: Mapping[str, int] = field(default_factory=dict)
    """Variants of which so many ground truths of each object are enough, however many are asked for."""
    one_at_a_time: bool = False
    """Whether its cases run by themselves, however many processes are asked for: live nodes that share their cores fall behind."""
