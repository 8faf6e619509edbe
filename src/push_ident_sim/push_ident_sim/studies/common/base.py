"""What experiments and benchmarks have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["Json", "Study"]

Json = dict[str, Any]
"""What `json` can write; lengths in metres, times in seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """One study. Tables and pictures are made from the summary alone, so that they can be made again from its file."""

    name: str
    """On the command line and of its files."""
    place: int
    """In the report: studies are sorted by it."""
    title: str
    question: str
    """What is asked and how it is measured: a paragraph for the reader of the report."""
    summarise: Callable[[Sequence[Any]], Json]
    """The results of all parts, in one small object."""
    tables: Callable[[Json], str]
    """Markdown of a summary."""
    draw: Callable[[Json, Path], dict[str, str]]
    """Write pictures of a summary into a folder: file names and captions."""
