"""What a benchmark is: pieces that are each measured in a fresh process, a summary, targets, tables and pictures of the summary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from push_ident_sim.studies.common.base import Json, Study

__all__ = ["Benchmark", "Piece", "Settings", "Target"]


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
    """One benchmark; `summarise` gets the results of the pieces, in their order."""

    pieces: Callable[[Settings], list[Piece]]
    targets: Callable[[Json], list[Target]]
    jobs: int = 1
    """Pieces measured side by side."""
