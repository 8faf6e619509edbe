"""What a benchmark is: pieces that are measured each in a fresh process, a summary, targets, tables and pictures of the summary."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["Benchmark", "Json", "Piece", "Settings", "Target"]

Json = dict[str, Any]
"""What `json` can write; lengths in metres, times in seconds."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What all benchmarks of a run share."""

    truth_folder: Path
    """Of ground-truth pushes; they are simulated when they are not there."""
    quick: bool = False
    """Few and small cases: to see that everything runs, not to measure."""
    seed: int = 0
    """Of maps, pushes and noise."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of a benchmark. What is compared with each other is measured in one piece, by turns."""

    label: str
    measure: Callable[..., Json]
    """A function of a module, so that another process finds it."""
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Target:
    """What was aimed at, and what came out."""

    what: str
    aim: str
    measured: str
    met: bool


@dataclass(frozen=True, slots=True)
class Benchmark:
    """One benchmark. Targets, tables and pictures are made of the summary alone, so that they can be made again from its file."""

    name: str
    title: str
    question: str
    """What is measured and how: a paragraph for the reader of the report."""
    pieces: Callable[[Settings], list[Piece]]
    summarise: Callable[[Sequence[Json]], Json]
    """Results of the pieces, in their order."""
    targets: Callable[[Json], list[Target]]
    tables: Callable[[Json], str]
    """Markdown of a summary."""
    draw: Callable[[Json, Path], dict[str, str]]
    """Write pictures of a summary into a folder: file names and captions."""
    jobs: int = 1
    """Pieces measured side by side."""
