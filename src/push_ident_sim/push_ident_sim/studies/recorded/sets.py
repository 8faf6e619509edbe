"""Sets of recorded pushes in a folder: bags of the contract, and files of the formats that an importer reads."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.importers import ImportReport, import_cmu_icra16, import_cmu_mocap, import_mit, mit_sets
from push_ident.errors import InputError
from push_ident.offline.loading import load_pushes
from push_ident.types import PushRecord
from push_ident_sim.studies.common.measuring import ends_of

__all__ = ["Drawn", "RecordedSet", "draw_pushes", "find_sets", "known_of"]

_KNOWN: Final = "known.json"
"""Beside the recordings: what their authors measured."""
_BAG_FILES: Final = (".mcap", ".db3")


@dataclass(frozen=True, slots=True)
class RecordedSet:
    """Pushes of one object on one surface."""

    name: str
    """Its place in the folder, such as `plywood-rect1`."""
    paths: tuple[Path, ...]
    """A bag, or files in order of their names."""
    read: Callable[[tuple[Path, ...], Path], ImportReport] | None = None
    """Makes a bag of such paths; None where they are a bag."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """Some pushes of a set, in the order in which they were made."""

    records: list[PushRecord]
    n_all: int
    """Pushes, or files, of the set."""
    mass: float | None
    """Of the object, where it was published [kg]."""


def find_sets(folder: Path) -> dict[str, RecordedSet]:
    """All sets in a folder and the folders in it, by name.

    A folder with a file of a ROS 2 bag is one set, and so is each file `*.txt` (CMU, ICRA 2016) and `*.bag` (CMU, motion capture). Files of
    the MIT pushing dataset are one set for each object on each surface.

    Raises InputError where there is none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give --recordings DIR, the folder of the recordings.")
    bags = sorted({path.parent for path in folder.rglob("*") if path.suffix in _BAG_FILES})
    sets = [RecordedSet(_name(bag, folder), (bag,)) for bag in bags]
    for suffix, read in ((".txt", import_cmu_icra16), (".bag", import_cmu_mocap)):
        sets += [RecordedSet(_name(path, folder), (path,), _of_one_file(read)) for path in sorted(folder.rglob(f"*{suffix}"))]
    sets += [RecordedSet(f"{surface}-{shape}", paths, import_mit) for (surface, shape), paths in mit_sets(folder).items()]
    if not sets:
        raise InputError(f"{folder}: no recording in it; expected bags, files *.txt or *.bag of CMU, or files of the MIT pushing dataset.")
    return {one.name: one for one in sets}


def draw_pushes(recorded: RecordedSet, n: int, rng: np.random.Generator, *, ends_only: bool = False, with_forces: bool = True) -> Drawn:
    """Random pushes of a set.

    Args:
        recorded: the set.
        n: how many; all where it has fewer.
        rng: draws them.
        ends_only: whether only the poses at rest before and after a push are kept.
        with_forces: whether measured forces are kept.

    Raises:
        PushIdentError: the set cannot be read.
    """
    is_one_file = len(recorded.paths) == 1
    paths = recorded.paths if is_one_file else _some(recorded.paths, n, rng)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        report = None if recorded.read is None else recorded.read(paths, bag)
        loaded = load_pushes([paths[0] if report is None else bag]).records
    records = list(_some(tuple(loaded), n, rng)) if is_one_file else loaded
    if ends_only:
        records = [ends_of(record) for record in records]
    if not with_forces:
        records = [replace(record, wrench=None) for record in records]
    return Drawn(records, len(loaded) if is_one_file else len(recorded.paths), None if report is None else report.mass)


def known_of(folder: Path, name: str) -> dict[str, Any]:
    """What the authors of a recording measured, by `known.json` in its folder: an object that has patterns of names as keys, and for each
    `friction` and `source`, as far as they are known. Empty where it says nothing of a set.

    Raises InputError for a file of another form.
    """
    file = folder / _KNOWN
    if not file.is_file():
        return {}
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read as JSON ({error}).") from None
    if not isinstance(content, dict) or not all(isinstance(value, dict) for value in content.values()):
        raise InputError(f"{file}: expected an object of objects, a pattern of set names as each key.")
    return next((value for pattern, value in content.items() if fnmatch(name, pattern)), {})


def _name(path: Path, folder: Path) -> str:
    parts = path.relative_to(folder).with_suffix("").parts
    return "-".join(parts) or folder.resolve().name


def _some(items: tuple[Any, ...], n: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """At most `n` of them, in their order."""
    return tuple(items[i] for i in np.sort(rng.permutation(len(items))[:n]))


def _of_one_file(read: Callable[[Path, Path], ImportReport]) -> Callable[[tuple[Path, ...], Path], ImportReport]:
    return lambda paths, bag: read(paths[0], bag)
