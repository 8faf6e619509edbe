"""What a study is: independent parts, a summary of their results, and tables and figures that are made from the summary alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident.identification.fitting.budget import Budget
from push_ident_sim.objects import OBJECT_NAMES
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings

Json = dict[str, Any]
"""What `json` can write; lengths in metres, times in seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """One question and its measurement."""

    name: str
    """On the command line and of its files."""
    title: str
    """Of its page."""
    question: str
    """What is asked and how it is measured: a paragraph for the reader of the page."""
    summarise: Callable[[Sequence[Any]], Json]
    """The results of all parts, in one small object."""
    tables: Callable[[Json], str]
    """Markdown of a summary."""
    draw: Callable[[Json, Path], dict[str, str]] = lambda summary, folder: {}
    """Write figures of a summary into a folder: file names and captions."""


# --- experiments: cases that leave a file each


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
    """Of recorded pushes, for the experiment `recorded`."""
    goals: int = 4
    """Of each object, for experiments that push to goals."""


@dataclass(frozen=True, slots=True)
class CaseResult:
    """A case and its result."""

    case: Case
    values: Json


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment(Study):
    """A study of cases; `summarise` gets a `CaseResult` for each case that gave one."""

    answer: Callable[[Json], str]
    """The answer in one sentence, with its numbers, for the list of results."""
    objects: tuple[str, ...] = OBJECT_NAMES
    """Objects, or kinds of objects, that it can take."""
    variants: tuple[str, ...]
    run: Callable[[Case, CaseSettings], Json]
    """One case. May raise PushIdentError: the case then counts as failed."""
    needs_truth: bool = False
    """Whether the ground-truth pushes of `CaseSettings.truth_folder` are made before the cases run."""
    stages: tuple[str, ...] = ("geometry", "physics", "identification")
    """Packages of the core that a result depends on: after a change there, cases run anew."""
    prepare: Callable[[Sequence[Case], Path], Json] | None = None
    """Called with all cases and the folder of results before any of them runs; its result becomes `sealed` in the summary."""
    most_models: Mapping[str, int] = field(default_factory=dict)
    """Variants with a largest number of ground truths of each object, whatever number is requested."""
    every: Mapping[str, int] = field(default_factory=dict)
    """Variants that only every n-th ground truth has, the first one included, so that long ones are spread over the run."""
    find_objects: Callable[[Path], tuple[str, ...]] | None = None
    """Finds the objects in `CaseSettings.recordings`, in place of `objects`: sets of recorded pushes; a seed is then that of a draw."""
    counts_goals: bool = False
    """Whether each object is pushed to `CaseSettings.goals` goals."""
    headline: tuple[str, ...] = ()
    """Keys of the summary that also stand at the top of the result, for scripts."""
    one_at_a_time: bool = False
    """Whether its cases run in turn, whatever number of processes is requested: live nodes that share their cores fall behind."""


# --- benchmarks: pieces that are each measured in a fresh process


@dataclass(frozen=True, slots=True)
class Settings:
    """What all benchmarks of a run share."""

    quick: bool = False
    """Few and small cases: to see that everything runs, not to measure."""
    seed: int = 0
    """Of maps, pushes and noise."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of a benchmark. Measurements that are compared belong to one piece and take turns."""

    label: str
    measure: Callable[..., Json]
    """A function of a module, so that another process finds it."""
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Target:
    """An aim and the measurement."""

    what: str
    aim: str
    measured: str
    met: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Benchmark(Study):
    """A study of times; `summarise` gets the results of the pieces, in their order."""

    pieces: Callable[[Settings], list[Piece]]
    targets: Callable[[Json], list[Target]]


def failures(run: Json) -> list[str]:
    """What failed in a run, a text for each error: its cases, at most two of them by name, and the error."""
    cases: dict[str, list[str]] = {}
    for failure in run["failed"]:
        cases.setdefault(failure["error"], []).append(failure["case"])
    return [f"{', '.join(of[:2])}{f' and {len(of) - 2} more' if of[2:] else ''}: {error}" for error, of in cases.items()]


def write_json(path: Path, content: Json) -> None:
    """Write whole or not at all. Raises PushIdentError where it cannot be written, ValueError for numbers that are not finite."""
    write_whole(path, json.dumps(content, separators=(",", ":"), allow_nan=False) + "\n", "the result")


def read_json(path: Path) -> Json:
    """Read a result. Raises InputError where it cannot be read."""
    try:
        content: Json = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the result {path}: {error}; delete it and run the study again.") from None
    return content
