"""Mutated bags: a source and a list of mutations give the same bag again, so that lists can be made shorter.

Mutations work on messages (decoded, changed, encoded again), on the records of MCAP, on the tables of sqlite3, on metadata.yaml, and on
bytes. A mutation that does not apply to a format changes nothing.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from push_ident_sim.fuzz import mutate_file, mutate_recorded
from push_ident_sim.fuzz.bag_sources import read_messages, write_mcap, write_sqlite

__all__ = ["LEVELS", "Mutation", "Recipe", "draw", "make"]

LEVELS: Final[dict[str, dict[str, Callable[..., None]]]] = {
    "messages": mutate_recorded.MUTATIONS,
    "mcap": mutate_file.MCAP,
    "sqlite3": mutate_file.SQLITE,
    "metadata": mutate_file.METADATA,
    "bytes": mutate_file.BYTES,
}
"""Level -> name of a mutation -> what it does."""
_LEVELS_OF: Final = {
    "mcap": ("messages", "messages", "messages", "mcap", "metadata", "bytes"),
    "sqlite3": ("messages", "sqlite3", "sqlite3", "metadata", "bytes"),
    "depth": ("messages", "messages", "mcap", "bytes"),
    "rosbag1": ("bytes",),
    "mocap": ("bytes",),
    "icra16": ("bytes",),
}
_SHARES: Final = {"mcap": 0.45, "sqlite3": 0.2, "depth": 0.15, "rosbag1": 0.1, "mocap": 0.05, "icra16": 0.05}
"""How often each source is drawn."""


@dataclass(frozen=True, slots=True)
class Mutation:
    """One change of a bag."""

    level: str
    name: str
    seed: int


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a mutated bag is made. Mutations of messages come first, those of bytes last."""

    source: str
    mutations: tuple[Mutation, ...]


def draw(seed: int, number: int) -> Recipe:
    """The recipe of one mutant: 1 to 4 mutations of a source."""
    rng = np.random.default_rng([seed, number])
    source = str(rng.choice(list(_SHARES), p=list(_SHARES.values())))
    chosen = []
    for _ in range(int(rng.choice([1, 1, 1, 2, 2, 3, 4]))):
        level = str(rng.choice(_LEVELS_OF[source]))
        chosen.append(Mutation(level, str(rng.choice(list(LEVELS[level]))), int(rng.integers(1 << 31))))
    order = list(LEVELS)
    return Recipe(source, tuple(sorted(chosen, key=lambda mutation: order.index(mutation.level))))


def make(recipe: Recipe, source: Path, folder: Path) -> Path:
    """Write the mutated bag to a new folder; returns the path to give to a command: the folder, or for other formats its file."""
    inner = [m for m in recipe.mutations if m.level == "messages"]
    if inner and recipe.source in ("mcap", "sqlite3", "depth"):
        messages = read_messages(source)
        for mutation in inner:
            mutate_recorded.MUTATIONS[mutation.name](messages, np.random.default_rng(mutation.seed))
        messages = [message for message in messages if 0 <= message.stamp_ns < 2**63]
        (write_sqlite if recipe.source == "sqlite3" else write_mcap)(folder, messages)
    else:
        shutil.copytree(source, folder)
    _apply(recipe.mutations, folder)
    files = sorted(folder.glob("*.bag")) + sorted(folder.glob("*.txt"))
    return files[0] if files else folder


def _apply(mutations: Sequence[Mutation], folder: Path) -> None:
    for mutation in mutations:
        if mutation.level != "messages":
            LEVELS[mutation.level][mutation.name](folder, np.random.default_rng(mutation.seed))
